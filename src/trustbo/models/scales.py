"""Scales on which people report trust: intervals of trust plus noise, or numbers."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np
from scipy import special

from trustbo.answers import levels_of
from trustbo.errors import TrustboError, require_whole
from trustbo.models.families.terms import GAUSSIAN, INTERVAL, NONE

_SPREAD = 0.5  # sd of the log width of a level, relative to the others
_NORMAL = np.ones((1, 2))
_LOGISTIC = np.array(
    [[0.252201, 0.585225, 0.162574], np.sqrt(3.0) / np.pi / [0.90793, 0.577787, 0.364038]]
).T.copy()


class Scale(NamedTuple):
    """Scale of reports: "unit", or so many levels with cut points that are fixed or free.

    With a report of level j, 0 to n - 1, trust plus noise lies between cut points j and j + 1.
    Fixed ones are halfway between the levels j / (n - 1); of free ones the first and last are
    fixed, as these set the unit, and the widths between are in proportion exp(s e_j), e a standard
    normal vector orthogonal to 1. On the unit scale reports of 0 and 1 are limits.
    """

    levels: int = 0
    """Number of levels; 0 on the unit scale."""
    free: bool = False

    @classmethod
    def named(cls, name: object) -> Self:
        """Scale "unit", "likert7" or "ordinal7", with any number of levels from 2 (4 if ordinal).

        TrustboError: the name is none of these.
        """
        levels, free = levels_of(name), str(name).startswith("ordinal")
        return cls(require_whole("levels of an ordinal scale", levels, 4) if free else levels, free)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scores of free cut points."""
        return tuple(f"cut_{j + 1}" for j in range(self.levels - 3)) if self.free else ()

    @property
    def noise(self) -> np.ndarray:
        """Noise of a report as a mixture of normals: weights, and sds in units of delta_v.

        Shape (component, 2). Logistic noise of levels, whose tails hold a slip, is within 1e-3 a
        mixture of three (Monahan and Stefanski 1992).
        """
        return _LOGISTIC if self.levels else _NORMAL

    @property
    def n_cases(self) -> int:
        """Number of intervals."""
        return self.levels or 2

    def draw_noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """Noise in units of delta_v."""
        if not self.levels:
            return rng.standard_normal(shape)
        component = rng.choice(len(self.noise), shape, p=self.noise[:, 0] / self.noise[:, 0].sum())
        return self.noise[component, 1] * rng.standard_normal(shape)

    def terms(self, y: np.ndarray, n_ticks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Kind of each report's term, and the index of its interval, of the shape of y."""
        seen = ~np.isnan(y)
        if not self.levels:
            cut = (y <= 0.0) | (y >= 1.0)
            kind = np.where(seen, np.where(cut, INTERVAL, GAUSSIAN), NONE)
            return kind, np.where(y >= 1.0, 1, 0)
        level = np.round(np.where(seen, y, 0.0) * (self.levels - 1)).astype(int)
        return np.where(seen, INTERVAL, NONE), level

    def cuts(self, theta: Mapping[str, Any]) -> np.ndarray:
        """Cut points between levels (point, levels - 1), at scores of free ones (point,)."""
        n = self.levels - 1
        even = (np.arange(n) + 0.5) / n
        if not self.free:
            return even[None]
        e = np.stack([np.asarray(theta[name]) for name in self.names], axis=1)
        widths = np.exp(_SPREAD * e @ _contrasts(n - 1).T)
        widths *= (even[-1] - even[0]) / widths.sum(1, keepdims=True)
        inner = even[0] + np.cumsum(widths, axis=1)
        return np.concatenate([np.full((len(e), 1), even[0]), inner], axis=1)

    def limits(self, theta: Mapping[str, Any]) -> np.ndarray:
        """Limits of each interval (point, case, 2), of hyperparameters (point,)."""
        n = len(theta["beta0"]) if "beta0" in theta else 1
        if not self.levels:
            ends = np.array([[-np.inf, 0.0], [1.0, np.inf]])
        else:
            cuts = self.cuts(theta)
            far = np.full((len(cuts), 1), np.inf)
            cuts = np.concatenate([-far, cuts, far], axis=1)
            ends = np.stack([cuts[:, :-1], cuts[:, 1:]], axis=2)
        return np.array(np.broadcast_to(ends, (n, self.n_cases, 2)))

    def require(self, y: np.ndarray, n_ticks: np.ndarray) -> None:
        """Refuse reports that are not on the scale: TrustboError."""
        wanted = self.levels - 1.0 if self.levels else np.nan
        bad = ~np.isnan(y) & ~np.isclose(n_ticks, wanted, equal_nan=True)
        if bad.any():
            ours, theirs = (
                "in [0, 1]" if np.isnan(steps) else f"on {int(steps) + 1} levels"
                for steps in (wanted, n_ticks[bad][0])
            )
            raise TrustboError(
                f"the model is of reports {ours}, but the missions' are {theirs}: give the same "
                "scale to read_reports and to HumanTrust, or n_ticks = levels - 1."
            )

    def record(self, trust: np.ndarray, theta: Mapping[str, Any]) -> np.ndarray:
        """Reports of trust plus noise (point, ...), in [0, 1]."""
        if not self.levels:
            return np.clip(trust, 0.0, 1.0)
        cuts = self.cuts(theta)
        cuts = cuts.reshape(len(cuts), *(1,) * (trust.ndim - 1), -1)
        level = (trust[..., None] > cuts).sum(-1) / (self.levels - 1)
        return np.where(np.isnan(trust), np.nan, level)


def _contrasts(n: int) -> np.ndarray:
    """Orthonormal columns (n, n - 1), orthogonal to 1 (Helmert's)."""
    rows = np.tril(np.ones((n, n)), -1)[1:] - np.diag(np.arange(n))[1:]
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).T


def normal_between(
    a: np.ndarray, b: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log of Phi(b) - Phi(a), and the quantile at a share of a standard normal between a and b."""
    mirror = a > -b
    a, b = np.where(mirror, -b, a), np.where(mirror, -a, b)
    with np.errstate(divide="ignore"):
        log_b = special.log_ndtr(b)
        gap = np.minimum(special.log_ndtr(a) - log_b, -1e-300)
        log_p = log_b + np.log(-np.expm1(gap))
        z = special.ndtri_exp(log_b + np.log(np.exp(gap) * (1.0 - share) + share))
    z = np.clip(z, a, b)
    return log_p, np.where(mirror, -z, z)
