"""Simulated drives of a vehicle with seven cameras, as COLMAP models of any size. ``python -m benchmarks.drives``."""
