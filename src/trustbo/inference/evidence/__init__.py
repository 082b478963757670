"""Likelihoods of contact rates, latent trust integrated out."""
