"""[O] to the letter, plain and slow: what the program's clustering and selection are measured against."""
