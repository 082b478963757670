"""Effects on the drift of trust, as groups of columns with Gaussian coefficients."""
