"""A rendered street with exact ground truth, and the program that renders it."""
