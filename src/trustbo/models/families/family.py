"""The interface of a family of observations.

Where latent trust does not integrate out, it is sampled with the parameters, as a smooth function
of standard normal innovations conditioned on the data. The remaining factor of the density is a
weight. So the innovations stay close to standard normal a posteriori, NUTS meets no funnel, and the
mean weight over innovations is the likelihood of a mission with its trust integrated out: all
families can be compared.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, random
from numpy import ndarray
from numpy.random import Generator

from trustbo.models.families.terms import Terms
from trustbo.models.state_space.scalar import ScalarSSM
from trustbo.models.state_space.vector import VectorSSM

SSM = ScalarSSM | VectorSSM
Moments = tuple[ndarray, ndarray, ndarray]
N_IMPORTANCE = 32
"""Trajectories to average the likelihood over where trust does not integrate out."""


class Observed(NamedTuple):
    """Measured data, bound first: axes (bound, mission, robot)."""

    y: Array
    """Contact rates; NaN where not measured."""
    n_ticks: Array
    """Ticks of the bound; NaN where not known."""
    linearisation: Array | None = None
    """Linearisation point: trust around which a likelihood is fitted by a Gaussian."""

    @classmethod
    def of(cls, y: Array, n_ticks: Array | None = None, linearisation: Array | None = None) -> Self:
        """Put the bound first in rates and ticks of shape (mission, bound, robot)."""
        n_ticks = jnp.full_like(y, jnp.nan) if n_ticks is None else n_ticks
        return cls(jnp.swapaxes(y, 0, 1), jnp.swapaxes(n_ticks, 0, 1), linearisation)


@dataclass(frozen=True)
class Family(ABC):
    """A family of observations; without state, so that compiled code takes it as static."""

    name: ClassVar[str]
    """Name that users give."""
    integrates_out: ClassVar[bool] = False
    """Whether latent trust integrates out in closed form: rates are linear in it, and Gaussian."""
    needs_ticks: ClassVar[bool] = False
    """Whether each measured rate needs its number of ticks."""
    rounds: ClassVar[bool] = True
    """Whether delta_v is the sd of a rate, recorded to the resolution of its ticks."""
    observes_trust: ClassVar[bool] = False
    """Whether `observe` maps moments of trust, not of the rate before clipping."""
    correlates: ClassVar[bool] = True
    """Whether observation noise may be correlated between robots."""

    log_constant: ClassVar[float] = 0.0
    """Term that the log density of `observe` lacks, nats."""
    expected_rate: ClassVar[str] = "identity"
    """Form of E[rate | trust] in compiled planning: `"identity"` (trust itself), `"logistic"`, or
    `"clipped"` (of a normal with sd delta_v, cut to [0, 1]); the mean of `rate_moments`."""

    @abstractmethod
    def log_density(self, ssm: SSM, observed: Observed, e: Array, complete: bool = False) -> Array:
        """Log density of the rates, latent trust integrated out or weighted given innovations.

        Its exponential's mean over standard normal innovations is the marginal likelihood.

        Args:
            ssm: State space.
            observed: Rates.
            e: Innovations, standard normal, shape (bound, mission, robot); not read if trust
                integrates out.
            complete: Whether no rate is missing before the last of a mission.

        Returns:
            Nats, shape (mission, robot) where robots are independent, else (mission, 1).
        """

    @abstractmethod
    def measure(self, key: Array, ssm: SSM, trust: Array, y: Array, n_ticks: Array) -> Array:
        """Contact rates given simulated trust, and given the linear Gaussian rates `y` of it."""

    @abstractmethod
    def draw_rates(
        self, rng: Generator, trust: ndarray, y: ndarray, noise_sd: ndarray, n_ticks: ndarray
    ) -> ndarray:
        """`measure` in NumPy; `noise_sd` is delta_v, all arrays broadcast to trust."""

    @abstractmethod
    def observe(
        self, mean: ndarray, var: ndarray, y: ndarray, n_ticks: ndarray, noise_sd: ndarray
    ) -> Moments:
        """Moments given a rate that was predicted N(mean, var), and its log probability or density.

        Moments are of the rate before clipping, noise included, or of trust where `observes_trust`.
        Arrays broadcast; `y` is not NaN.
        """

    @abstractmethod
    def probabilities(
        self, trust: np.ndarray, noise_sd: np.ndarray, y: np.ndarray, n_ticks: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities of a rate below y, and of one up to y, given trust; arrays broadcast."""

    @abstractmethod
    def terms(self, y: np.ndarray, n_ticks: np.ndarray) -> Terms:
        """Terms of measured rates of any shape, for expectation propagation; see `ep.terms`."""

    @abstractmethod
    def is_density(self, y: np.ndarray) -> np.ndarray:
        """Mask of the measured rates that have a density, not a probability."""

    @abstractmethod
    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """Mean of a rate given trust, its slope in trust, and the variance of the rate.

        `noise_sd` is delta_v, broadcast to trust. For counts, the number of ticks is that of a rate
        recorded to .005.
        """

    @property
    def line_of_sight(self) -> tuple[float, float]:
        """Trust equivalent of a line of sight of 1, and the line of sight of trust 0."""
        return 1.0, 0.0

    def priors(self) -> dict[str, Any]:
        """Default priors that differ from those of `Priors()`, by name."""
        return {}

    def refine(self, ssm: SSM, observed: Observed) -> Observed:
        """Find the linearisation point, if the family has one."""
        return observed

    def marginal_log_likelihood(self, ssm: SSM, observed: Observed, key: Array) -> Array:
        """Log p(rates of each mission), latent trust integrated out, shape (mission,), nats.

        Exact where trust integrates out; else by importance sampling with antithetic innovations.
        """
        if self.integrates_out:
            return self.log_density(ssm, observed, jnp.zeros_like(observed.y)).sum(1)
        observed = self.refine(ssm, observed)
        half = random.normal(key, (N_IMPORTANCE // 2, *observed.y.shape), observed.y.dtype)

        weights = jax.vmap(lambda e: self.log_density(ssm, observed, e))(
            jnp.concatenate([half, -half])
        )
        # Over innovations first, sequence by sequence: these are independent.
        return (jax.nn.logsumexp(weights, axis=0) - np.log(len(weights))).sum(1)

    def log_resolution(self, y: np.ndarray, n_ticks: np.ndarray) -> np.ndarray:
        """Log ratio of the probability of a count of ticks to the density of its rate.

        A density covers 1/N per tick. Shape of `y`; 0 where not measured or where the rate itself
        has a probability, NaN where the number of ticks is unknown.
        """
        is_density = ~np.isnan(y) & self.is_density(y)
        return np.where(is_density, -np.log(np.where(is_density, n_ticks, 1.0)), 0.0)
