"""Samplers of a trust model's posterior."""
