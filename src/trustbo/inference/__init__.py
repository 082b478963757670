"""Inference for trust models: posteriors, predictions, model comparison and filters."""

from trustbo.models import backend as backend  # imported first because it loads numpyro

# isort: split
from trustbo.inference.by_rate import by_rate
from trustbo.inference.compare import compare
from trustbo.inference.filter import TrustFilter
from trustbo.inference.fit import fit
from trustbo.inference.learner import add_latent, params_of
from trustbo.inference.loo import loo
from trustbo.inference.prior_draws import sample_prior
from trustbo.inference.reports import predict_reports
from trustbo.inference.score import score

__all__ = [
    "TrustFilter",
    "add_latent",
    "by_rate",
    "compare",
    "fit",
    "loo",
    "params_of",
    "predict_reports",
    "sample_prior",
    "score",
]
__dir__ = __all__.copy  # tab completion lists only public names
