"""Reports on an ordinal scale: trust plus logistic noise, divided into levels by cut points."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.random import Generator
from scipy import special

from trustbo.models.backend import special_functions
from trustbo.models.families.family import Array, Drawn, Family, Moments, Near
from trustbo.models.families.moments import draw_between, match_interval
from trustbo.statespace.matrices import namespace

_LEAST_P = 1e-300  # smallest probability of a report, so that its log is finite
_SHARES = np.array([0.252201, 0.585225, 0.162574])
_SDS = np.sqrt(3.0) / np.pi / np.array([0.90793, 0.577787, 0.364038])
"""Weights and sds of a normal mixture that is within 1e-3 of a logistic distribution with sd 1
(Monahan and Stefanski 1992). The heavy tails of the logistic distribution allow for mistaken
reports."""


@dataclass(frozen=True)
class Levels(Family):
    """Reports of level j = 0, ..., n - 1 as rates j / (n - 1), with cut points halfway between."""

    levels: int = 7
    name: ClassVar[str] = "levels"
    adds_noise: ClassVar[bool] = False

    def cuts(self, y: Array) -> tuple[Array, Array]:
        """Return the cut points below and above each report."""
        xp = namespace(y)
        n = self.levels - 1
        level = xp.round(y * n)
        low = xp.where(level < 0.5, -np.inf, (level - 0.5) / n)
        high = xp.where(level > n - 0.5, np.inf, (level + 0.5) / n)
        return low, high

    def sample(self, trust: Array, sd: Array, N: Array, rng: Generator) -> Array:
        """See `Family.sample`."""
        n = self.levels - 1
        shape = np.broadcast(trust, sd, N).shape
        noise = rng.choice(_SDS, shape, p=_SHARES / _SHARES.sum()) * rng.standard_normal(shape)
        return np.clip(np.round((trust + sd * noise) * n), 0.0, n) / n

    def log_prob(self, y: Array, N: Array, trust: Array, sd: Array) -> Array:
        """See `Family.log_prob`."""
        xp = namespace(trust)
        ndtr = special_functions(trust).ndtr
        low, high = (end - trust for end in self.cuts(xp.asarray(y)))

        # Mirror intervals above 0, because differences are more accurate in the lower tail.
        mirror = low > 0.0
        low, high = xp.where(mirror, -high, low), xp.where(mirror, -low, high)

        def p_below(end: Array, of_one: float) -> Array:
            is_infinite = xp.isinf(end)  # JAX has no derivative of such an end divided by sd
            p = ndtr(xp.where(is_infinite, 0.0, end) / (of_one * sd))
            return xp.where(is_infinite, end > 0.0, p)

        total = 0.0
        for share, of_one in zip(_SHARES, _SDS, strict=True):
            total = total + share * (p_below(high, of_one) - p_below(low, of_one))
        return xp.log(xp.maximum(total, _LEAST_P))

    def _match(self, y: Array, N: Array, m: Array, v: Array, sd: Array) -> Moments:
        """See `Family._match`; a mixture of normals between two cut points."""
        log_p, mean, var = self._components(y, m, v, sd)
        total: Any = special.logsumexp(log_p, axis=0)
        w = np.exp(log_p - total)

        center = (w * mean).sum(0)
        spread = (w * (var + (mean - center) ** 2)).sum(0)
        return total, center, spread

    def _draw(
        self, y: Array, N: Array, m: Array, v: Array, sd: Array, rng: Generator, near: Near
    ) -> Drawn:
        """Draw the mixture component, the report before rounding and f; all draws are exact."""
        log_p = self._components(y, m, v, sd)[0]
        noise = _SDS[np.argmax(log_p + rng.gumbel(size=log_p.shape), axis=0)] * sd

        total = np.sqrt(v + noise**2)
        low, high = self.cuts(y)
        e = draw_between((low - m) / total, (high - m) / total, rng)

        white = rng.standard_normal(m.shape)
        f = m + v / total * e + np.sqrt(v) * noise / total * white
        return f, special.logsumexp(log_p, axis=0)

    def _components(self, y: Array, m: Array, v: Array, sd: Array) -> Moments:
        """Compute the moments (component, ...) of each mixture component, weighted by its share."""
        parts = [match_interval(*self.cuts(y), m, v, of_one * sd) for of_one in _SDS]
        log_p, mean, var = (np.stack(moments) for moments in zip(*parts, strict=True))
        return log_p + np.log(_SHARES).reshape(-1, *(1,) * np.ndim(y)), mean, var
