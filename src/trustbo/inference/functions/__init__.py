"""Models that are NumPyro functions: their data, draws, sampler and posterior."""
