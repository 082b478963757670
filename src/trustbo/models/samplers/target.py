"""The log posterior that NUTS samples: a model's priors, and the likelihood in its fastest form.

The numpyro model itself stays plain. Here its sample statements of the parameters stand with a
likelihood that knows the weight of each mission, whether missions are complete, the sums that take
the place of rates, and the linearisation point.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import numpyro
from jax import Array, random
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import constrain_fn, potential_energy

from trustbo.models.likelihood import gram_jax
from trustbo.models.likelihood.contact_rate import ContactRate
from trustbo.models.likelihood.families import Observed
from trustbo.models.likelihood.gram_jax import Spectrum
from trustbo.models.model import TrustModel, sample_innovations
from trustbo.models.params import Params

Sites = dict[str, Array]


class NutsData(NamedTuple):
    """Missions and their weights, or the sums over them, as arguments of compiled code."""

    awareness: Array | np.ndarray  # (mission, bound, robot, feature)
    contact_rate: Array | np.ndarray  # (mission, bound, robot)
    n_ticks: Array | np.ndarray  # (mission, bound, robot)
    weight: Array | np.ndarray  # (mission,)
    spectrum: Spectrum | None = None
    """Sums over pooled Gaussian missions without gaps, which take the rates' place."""
    means: tuple[Array | np.ndarray, ...] | None = None
    """Mean rate, mean awareness (feature,) and the rates' sd, which go with the sums."""


class Target:
    """Log posterior of a model's sample sites, each on its own real line.

    Attributes:
        start: Flat vector of the priors' means, to start a search from.
        unravel: Sites by name from a flat vector.
        inverse: Transform from the real line to each site's support.
        linearisation: Linearisation point, once `linearise` was called.
    """

    def __init__(self, model: TrustModel, data: NutsData, *, complete: bool) -> None:
        """Trace the sites of the parameters.

        Args:
            model: Trust model.
            data: Missions.
            complete: Whether no rate is missing before the last of a mission.
        """
        self.model, self.data, self.complete = model, data, complete
        self._sizes = data.awareness.shape[2:]
        self.linearisation: Array | None = None
        seeded = handlers.seed(model.sample_params, random.key(0))
        trace = handlers.trace(seeded).get_trace(*self._sizes)
        sites = {name: site["fn"] for name, site in trace.items() if site["type"] == "sample"}
        self.inverse = {name: biject_to(prior.support) for name, prior in sites.items()}
        start = {name: _start(self.inverse[name], prior) for name, prior in sites.items()}
        self.start, self.unravel = ravel_pytree(start)

    def values(self, site: Sites) -> Sites:
        """Sites on their priors' supports."""
        return {name: self.inverse[name](site[name]) for name in self.inverse}

    def params(self, values: Sites) -> Params:
        """Parameters assembled from sites on their supports."""
        return handlers.substitute(self.model.sample_params, values)(*self._sizes)  # pyright: ignore

    def potential(self, site: Sites) -> Array:
        """Minus the log posterior density of sites, `innovations` among them if needed."""
        return potential_energy(self._program, (), {}, site)  # pyright: ignore[reportReturnType]

    def constrain(self, site: Sites) -> Sites:
        """The model's parameters, by name."""
        args = (self.model.sample_params, self._sizes, {}, site)
        values = constrain_fn(*args, return_deterministic=True)
        return {name: values[name] for name in self.model.dims}

    def log_likelihood(
        self, params: Params, innovations: Array | None = None, *, complete: bool = False
    ) -> Array:
        """Log density of each mission and independent sequence, unweighted."""
        observed = self._observed()
        innovations = jnp.zeros_like(observed.y) if innovations is None else innovations
        ssm = params.ssm(self.data.awareness, self.model.lag)  # pyright: ignore[reportArgumentType]
        return self.model.family.log_density(ssm, observed, innovations, complete)

    def linearise(self, site: Sites) -> None:
        """Move the linearisation point to the most likely trust at these parameters."""
        params, observed = self.params(self.values(site)), self._observed()
        ssm = params.ssm(self.data.awareness, self.model.lag)  # pyright: ignore[reportArgumentType]
        self.linearisation = self.model.family.refine(ssm, observed).linearisation

    def _program(self) -> None:
        params = self.model.sample_params(*self._sizes)
        if self.data.spectrum is not None:
            sums = gram_jax.log_likelihood(params, self.data.spectrum, self.model.lag)  # pyright: ignore
            numpyro.factor("contact_rate", sums)
            return
        joint = not self.model.family.integrates_out
        innovations = sample_innovations(innovations_shape(self.data)) if joint else None
        rates = _WeightedRates(self, params, innovations)
        numpyro.sample("contact_rate", rates, obs=self.data.contact_rate)  # pyright: ignore

    def _observed(self) -> Observed:
        rates, ticks = self.data.contact_rate, self.data.n_ticks
        return Observed.of(rates, ticks, self.linearisation)  # pyright: ignore[reportArgumentType]


class _WeightedRates(ContactRate):
    """`ContactRate` with the likelihood of a target, times the weight of each mission."""

    def __init__(self, target: Target, params: Params, innovations: Array | None) -> None:
        super().__init__(params, target.data.awareness, innovations=innovations)  # pyright: ignore
        self.target = target

    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        complete = self.target.complete
        each = self.target.log_likelihood(self.params, self.innovations, complete=complete)
        return each.sum(1) * self.target.data.weight


def innovations_shape(data: NutsData) -> tuple[int, int, int]:
    """Shape (bound, mission, robot)."""
    n_missions, n_bounds, n_robots = data.contact_rate.shape
    return (n_bounds, n_missions, n_robots)


def _start(transform, prior) -> Array:
    """Prior mean on the real line, or 0 there if it has none, such as a Cauchy."""
    try:
        mean = jnp.asarray(prior.mean, dtype=float)
    except NotImplementedError:  # LKJCholesky: no correlation
        return transform.inv(jnp.eye(prior.event_shape[-1]))
    z = transform.inv(jnp.broadcast_to(mean, prior.shape()))
    return jnp.where(jnp.isfinite(z), z, 0.0)
