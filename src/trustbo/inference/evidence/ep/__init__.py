"""Expectation propagation for rates that are no linear function of trust; see `joint`."""
