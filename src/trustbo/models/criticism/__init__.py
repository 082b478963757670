"""Tests of a fitted trust model against what may be wrong with it."""
