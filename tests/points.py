"""Fits of NumPyro functions without NUTS, whose compilation takes most of their time."""

from contextlib import contextmanager

import numpy as np
import pytest

from trustbo.inference.diagnostics import FIELDS
from trustbo.inference.functions.nuts import Sampler, Samples, free_shapes
from trustbo.models.backend import own_settings

_SD = 0.3
"""Standard deviation of the points in unconstrained space."""


def _points(self, data, sites, start, warmup, draws, **options):
    """Random points of the variables in place of draws from their posterior."""
    rng = np.random.default_rng(0)
    size = len(start.x), draws
    with own_settings():
        free = free_shapes(self.model, sites, data)
    z = {name: _SD * rng.standard_normal((*size, *zero.shape)) for name, zero in free.items()}
    fields = {name: np.zeros(size) for name in FIELDS}
    fields["diverging"] = np.zeros(size, dtype=bool)
    return Samples(z, fields, step_size=0.1)


@contextmanager
def without_nuts():
    """Fit functions inside; for tests of all that is done with draws, whatever they are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sampler, "sample", _points)
        yield
