"""Reports on a scale of levels: trust plus logistic noise lies between two cut points."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy import ndarray
from numpy.random import Generator
from scipy import special

from trustbo.models.backend import namespace
from trustbo.models.families.family import Family, Moments, draw_between, match_interval

_SHARES = np.array([0.252201, 0.585225, 0.162574])
_SDS = np.sqrt(3.0) / np.pi / np.array([0.90793, 0.577787, 0.364038])
"""Weights and sds of a mixture of normals within 1e-3 of a logistic of sd 1, whose tails hold slips
(Monahan and Stefanski 1992)."""


@dataclass(frozen=True)
class Levels(Family):
    """Reports of level j of n, as rates j / (n - 1); cut points lie halfway between the levels."""

    levels: int = 7
    name: ClassVar[str] = "levels"
    rounds: ClassVar[bool] = False
    correlates: ClassVar[bool] = False
    expected_rate: ClassVar[str] = "clipped"

    def cuts(self, y: Any) -> tuple[Any, Any]:
        """Cut points below and above reports."""
        xp, n = namespace(y), self.levels - 1
        level = xp.round(y * n)
        low = xp.where(level < 0.5, -np.inf, (level - 0.5) / n)
        return low, xp.where(level > n - 0.5, np.inf, (level + 0.5) / n)

    def sample(self, trust: ndarray, delta_v: ndarray, n_ticks: ndarray, rng: Generator) -> ndarray:
        """See `Family.sample`."""
        shape, n = np.broadcast(trust, delta_v, n_ticks).shape, self.levels - 1
        noise = rng.choice(_SDS, shape, p=_SHARES / _SHARES.sum()) * rng.standard_normal(shape)
        return np.clip(np.round((trust + delta_v * noise) * n), 0.0, n) / n

    def log_prob(self, y: Any, n_ticks: Any, trust: Any, delta_v: Any) -> Any:
        """See `Family.log_prob`."""
        if namespace(trust) is np:
            return self.match(y, n_ticks, trust, 1e-12 * np.ones(np.shape(trust)), delta_v)[0]
        (low, high), total = self.cuts(jnp.asarray(y)), 0.0
        for share, sd in zip(_SHARES, _SDS, strict=True):
            below, above = (
                jax.scipy.special.ndtr((end - trust) / (sd * delta_v)) for end in (low, high)
            )
            total = total + share * (above - below)
        return jnp.log(jnp.maximum(total, 1e-300))

    def match(
        self, y: ndarray, n_ticks: ndarray, m: ndarray, v: ndarray, delta_v: ndarray
    ) -> Moments:
        """See `Family.match`: of a mixture of normals between two numbers."""
        y, m, v = np.broadcast_arrays(y, m, v)
        seen = ~np.isnan(y)
        log_p, mean, var = self._components(np.where(seen, y, 0.0), m, v, delta_v)
        total = special.logsumexp(log_p, axis=0)
        w = np.exp(log_p - total)
        center = (w * mean).sum(0)
        spread = (w * (var + (mean - center) ** 2)).sum(0)
        return np.where(seen, total, 0.0), np.where(seen, center, m), np.where(seen, spread, v)  # pyright: ignore[reportArgumentType, reportCallIssue]

    def draw(
        self,
        y: ndarray,
        n_ticks: ndarray,
        m: ndarray,
        v: ndarray,
        delta_v: ndarray,
        rng: Generator,
    ) -> tuple[ndarray, ndarray]:
        """See `Family.draw`: of the component, the number before rounding, the signal; exact."""
        y, m, v, delta_v = np.broadcast_arrays(y, m, v, delta_v)
        seen = ~np.isnan(y)
        at = np.where(seen, y, 0.0)
        log_p = self._components(at, m, v, delta_v)[0]
        noise = _SDS[np.argmax(log_p + rng.gumbel(size=log_p.shape), axis=0)] * delta_v
        total, (low, high) = v + noise**2, self.cuts(at)
        e = draw_between((low - m) / np.sqrt(total), (high - m) / np.sqrt(total), rng)
        white = rng.standard_normal(m.shape)
        f = m + v / np.sqrt(total) * e + np.sqrt(v) * noise / np.sqrt(total) * white
        blind = m + np.sqrt(v) * white
        return np.where(seen, f, blind), np.where(seen, special.logsumexp(log_p, axis=0), 0.0)  # pyright: ignore[reportArgumentType, reportCallIssue]

    def _components(self, y: ndarray, m: ndarray, v: ndarray, delta_v: ndarray) -> Any:
        """Moments (component, ...) of each normal of the mixture, log shares in the first."""
        low, high = self.cuts(y)
        parts = [match_interval(low, high, m, v, sd * delta_v) for sd in _SDS]
        log_p, mean, var = (np.stack(moments) for moments in zip(*parts, strict=True))
        return log_p + np.log(_SHARES).reshape(-1, *(1,) * np.ndim(y)), mean, var

    def probabilities(
        self, trust: ndarray, noise_sd: ndarray, y: ndarray, n_ticks: ndarray
    ) -> tuple[ndarray, ndarray]:
        """See `Family.probabilities`."""
        low, high = self.cuts(y)
        return tuple(
            sum(
                share * special.ndtr((end - trust) / (sd * noise_sd))
                for share, sd in zip(_SHARES, _SDS, strict=True)
            )
            for end in (low, high)
        )  # pyright: ignore[reportReturnType]

    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """See `Family.rate_moments`: of all levels."""
        levels = np.arange(self.levels) / (self.levels - 1)
        shape = (*np.shape(trust), 1)
        below, above = self.probabilities(
            np.reshape(trust, shape),
            np.broadcast_to(noise_sd, np.shape(trust))[..., None],
            levels,
            levels,
        )
        p = above - below
        mean = p @ levels
        inside = p[..., 1:-1].sum(-1)
        return mean, inside, np.maximum(p @ levels**2 - mean**2, 1e-12)
