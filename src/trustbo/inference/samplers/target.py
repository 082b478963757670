"""The log posterior that NUTS samples: a model's priors, and the likelihood in its fastest form.

The numpyro model itself stays plain. Here its sample statements of the parameters stand with a
likelihood that takes the weight of each mission, whether missions are complete, sums in place of
rates, and the linearisation point.
"""

from typing import NamedTuple, cast

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import Array, random
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import constrain_fn, potential_energy

from trustbo.inference.evidence import gram_jax, place_marginal
from trustbo.inference.evidence.gram_jax import Spectrum
from trustbo.inference.evidence.place_marginal import Linear, PlaceHyper, PlaceIndex
from trustbo.models.families import Observed
from trustbo.models.model import TrustModel, sample, sample_innovations
from trustbo.models.params import Params
from trustbo.models.place import PlaceEffect
from trustbo.models.state_space.contact_rate import ContactRate
from trustbo.models.state_space.scalar import ScalarSSM

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
    places: PlaceIndex | None = None
    """Visited places, where these have effects."""


class Target:
    """Log posterior of a model's unconstrained sample sites.

    Attributes:
        start: Flat vector of the priors' means, to start a search from.
        unravel: Sites by name from a flat vector.
        inverse: Transform from the real line to each site's support.
        linearisation: Linearisation point, once `linearise` was called.
        integrated: Sites that integrate out with the effects of places, at 0.
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
        priors, pooled = model.priors, model.robot_sets == "all" and model.family.integrates_out
        normal = all(isinstance(prior, dist.Normal) for prior in (priors.beta, priors.b))
        zeros = {"beta": jnp.zeros(self._sizes[1]), "b": jnp.zeros(())}
        self.integrated = zeros if data.places is not None and pooled and normal else {}
        trace = handlers.trace(handlers.seed(self._sample, random.key(0))).get_trace()
        sites = {
            name: site["fn"]
            for name, site in trace.items()
            if site["type"] == "sample" and name not in self.integrated
        }
        self.inverse = {name: biject_to(prior.support) for name, prior in sites.items()}
        start = {name: _start(self.inverse[name], prior) for name, prior in sites.items()}
        self.start, self.unravel = ravel_pytree(start)

    def values(self, site: Sites) -> Sites:
        """Sites on their priors' supports."""
        return {name: self.inverse[name](site[name]) for name in self.inverse}

    def params(self, values: Sites) -> Params:
        """Parameters assembled from sites on their supports."""
        return handlers.substitute(self._sample, values)()[0]  # pyright: ignore

    def potential(self, site: Sites) -> Array:
        """Minus the log posterior density of sites, `innovations` among them if needed."""
        return potential_energy(self._program, (), {}, site)  # pyright: ignore[reportReturnType]

    def constrain(self, site: Sites) -> Sites:
        """The model's parameters, by name, but for integrated ones."""
        values = constrain_fn(self._sample, (), {}, site, return_deterministic=True)
        extra = ("place_unit",) if self._samples_effects else ()
        return {name: values[name] for name in (*self.model.dims, *extra) if name in values}

    @property
    def _samples_effects(self) -> bool:
        """Whether effects of places are sampled with the parameters, and not integrated out."""
        return self.data.places is not None and not self.model.family.integrates_out

    def _sample(self) -> tuple[Params, PlaceHyper | None]:
        """Sample statements; effects of places that are sampled are in the intercepts.

        Integrated sites are 0, and their priors are in the likelihood.
        """
        fixed = self.integrated
        with handlers.block(hide=list(fixed)), handlers.substitute(data=fixed):
            params = self.model.sample_params(*self._sizes)
        if self.data.places is None:
            return params, None
        hyper = sample_hyper(cast(PlaceEffect, self.model.place))
        if self._samples_effects:
            white = sample("place_white", dist.Normal(0.0, 1.0), (len(self.data.places.cell_of),))
            effect = place_marginal.prior_factor(hyper, self.data.places) @ white
            numpyro.deterministic("place_unit", effect)
            params = params._replace(b=params.b + effect[self.data.places.unit])  # pyright: ignore
        return params, hyper

    def draw_effects(self, values: Sites, key: Array) -> Sites:
        """One exact draw of units' effects and integrated sites, given parameters."""
        params, hyper = handlers.substitute(self._sample, values)()  # pyright: ignore
        effects, c = place_marginal.draw_effects(
            *self._rates(params), hyper, self.data.places, key, self._linear(params)  # pyright: ignore
        )  # fmt: skip
        integrated = {"beta": c[:-1], "b": c[-1]} if self.integrated else {}
        return {"place_unit": effects, **integrated}

    def _rates(self, params: Params) -> tuple[ScalarSSM, Array, Array]:
        ssm = params.ssm(self.data.awareness, self.model.lag)  # pyright: ignore
        return ssm, self.data.contact_rate, self.data.weight  # pyright: ignore

    def _linear(self, params: Params) -> Linear | None:
        """Features of the integrated sites, and their priors."""
        if not self.integrated:
            return None
        awareness, priors = self.data.awareness, self.model.priors
        columns = jnp.concatenate([awareness, jnp.ones((*awareness.shape[:3], 1))], 3)
        weights, intercept = priors.weights(params.beta0), priors.intercept(params.beta0)  # pyright: ignore

        def moment_of(name: str) -> Array:
            of_beta = jnp.broadcast_to(getattr(weights, name), (columns.shape[3] - 1,))
            return jnp.append(of_beta, getattr(intercept, name))

        return Linear(columns, moment_of("loc"), moment_of("scale"))

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
        params, hyper = self._sample()
        if hyper is not None and not self._samples_effects:
            fixed = *self._rates(params), hyper, self.data.places, self._linear(params)
            numpyro.factor("contact_rate", place_marginal.log_likelihood(*fixed))  # pyright: ignore
            return
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
        log_p = self.target.log_likelihood(self.params, self.innovations, complete=complete)
        return log_p.sum(1) * self.target.data.weight


def sample_hyper(place: PlaceEffect) -> PlaceHyper:
    """Sample statements of the hyperparameters of places."""
    values = {}
    if place.cells:
        values["tau_s"] = sample("tau_s", dist.HalfNormal(place.tau_s))
        scale = jnp.log(place.length_scale), place.length_scale_sd
        values["length_scale"] = sample("length_scale", dist.LogNormal(*scale))
    if place.bounds:
        values["tau_e"] = sample("tau_e", dist.HalfNormal(place.tau_e))
    return PlaceHyper.of(values)


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
