"""Searches for the best admissible path."""
