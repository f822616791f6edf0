"""Other ways to cluster and select views, written from their papers and sources, on the program's input."""
