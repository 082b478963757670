"""Baselines of the benchmark by other packages, one file each."""
