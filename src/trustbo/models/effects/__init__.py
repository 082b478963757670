"""Effects on the drift of trust: groups of columns with Gaussian coefficients."""
