"""NUTS on a model's sample statements, for what no evidence integrates out.

These are coupled robots and priors without quantiles, all of Gaussian rates. The
numpyro model itself stays plain: here its sample statements stand with a likelihood that takes the
weight of each mission. The unknowns are the sites on the real line, but for the noises and the
intercept: data fix the total of the noises well and their ratio badly, and the mean level of trust,
b + beta0 mean(y) + beta . mean(z), better than its parts. The logs of total and ratio, and the
level, stand in their places, with Jacobian 1. Start and metric are those of a Gaussian fit at the
mode (Laplace).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from jax import Array, lax, random
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions import constraints
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import constrain_fn, potential_energy

from trustbo.inference.samplers.laplace import inverse_hessian, newton
from trustbo.inference.samplers.nuts import Chain, run_nuts
from trustbo.inference.samplers.partial_centring import RobotFit, centre, fit_robots
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.inference.samplers.watching import Watch
from trustbo.models.effects.sampled import SampledDrift
from trustbo.models.model import TrustModel
from trustbo.models.params import Params
from trustbo.models.state_space.vector import VectorSSM
from trustbo.stacking import MissionBatch

Sites = dict[str, Array]
_NOISES = ("delta_w", "delta_v")
_AUTOREGRESSIONS = ("beta0", "B0_diagonal")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SitesInJax:
    """Log posterior density of a model's unconstrained sample sites.

    Attributes:
        model: Model.
        batch: Missions, padded.
        weight: Weight of each mission, (mission,).
        means: Mean rate () and awareness (robot, feature), where the level replaces `b`.
        robots: Fit of each robot's likelihood, once it is known, where robots are partially pooled.
        drift: Sampled effects of places.
        complete: Whether no rate is missing before the last of a mission.
    """

    learns: ClassVar[bool] = True
    model: TrustModel
    batch: MissionBatch
    weight: Array | np.ndarray
    means: tuple[Array | np.ndarray, Array | np.ndarray] | None = None
    robots: RobotFit | None = None
    drift: SampledDrift | None = field(default=None, metadata={"static": True})
    complete: bool = field(default=False, metadata={"static": True})

    @classmethod
    def of(
        cls,
        model: TrustModel,
        batch: MissionBatch,
        weight: np.ndarray,
        drift: SampledDrift | None = None,
    ) -> "SitesInJax":
        """Density of a model given missions."""
        seen = ~np.isnan(batch.contact_rate)
        together = (seen.any(2) == seen.all(2)).all()
        over = (np.diff(seen.any(2).astype(int), axis=1) <= 0).all()
        means = None
        linear = model.robot_sets != "pooled" and model.memory == "level"
        if linear and model.priors.b.support is constraints.real:
            n = np.maximum(seen.sum((0, 1)), 1)[:, None]
            z = np.where(seen[..., None], batch.awareness, 0.0).sum((0, 1)) / n
            means = np.asarray(batch.contact_rate[seen].mean()), z
        return cls(model, batch, weight, means, drift=drift, complete=bool(together and over))

    @property
    def has_level(self) -> bool:
        """Whether a level takes the intercept's place: linear models."""
        return self.means is not None

    @cached_property
    def _priors(self) -> dict[str, Any]:
        """Prior of each site."""
        trace = handlers.trace(handlers.seed(self._params, random.key(0))).get_trace()
        return {name: site["fn"] for name, site in trace.items() if site["type"] == "sample"}

    @cached_property
    def _flat(self) -> tuple[Array, Any]:
        """Vector of the priors' means, and the function from a vector to sites."""
        return ravel_pytree({name: _mean(prior) for name, prior in self._priors.items()})

    def sites(self, theta: Array) -> tuple[Sites, Array]:
        """Unconstrained sites of a vector of unknowns, and the log Jacobian."""
        site, none = self._flat[1](theta), jnp.zeros(())
        if site.keys() >= set(_NOISES):
            total, ratio = (site[name] for name in _NOISES)
            site |= {
                name: total + 0.5 * jax.nn.log_sigmoid(sign * ratio)
                for name, sign in zip(_NOISES, (2.0, -2.0), strict=True)
            }
        if self.has_level:
            site |= {"b": site["b"] - self._level(site)}
        if self.robots is None:
            return site, none
        moved, log_jacobian = centre(self._values(site), self._support, self.robots)
        return site | moved, log_jacobian

    def _level(self, site: Sites) -> Array:
        """Mean level of trust without an intercept, of the shape of `b`."""
        none = {"b": jnp.zeros_like(site["b"])}
        params: Any = handlers.substitute(self._of_model, self._values(site) | none)()
        y, z = self.means  # pyright: ignore[reportGeneralTypeIssues]
        ssm = params.ssm(z[None, None])
        carried = ssm.B0.sum(-1) if isinstance(ssm, VectorSSM) else ssm.beta0
        level = carried * y + ssm.drift[0, 0]
        return level if site["b"].ndim else level.mean()

    def potential(self, site: Sites) -> Array:
        """See `nuts.Density`."""
        others = {name: site[name] for name in site if name != "theta"}
        full, log_jacobian = self.sites(site["theta"])
        energy: Any = potential_energy(self._program, (), {}, full | others)
        return energy - log_jacobian

    def named(self, theta: Array) -> Sites:
        """The model's parameters by name, and coefficients of sampled effects."""
        sites, _ = self.sites(theta)
        values = constrain_fn(self._params, (), {}, sites, return_deterministic=True)
        names = (*self.model.dims, *(self.drift.names if self.drift else ()))
        return {name: values[name] for name in names if name in values}

    def centred(self) -> tuple["SitesInJax", Chain]:
        """The density around the mode, and Laplace's fit there.

        As the noises go to 0 around a perfect fit, a density of few data grows without bound, but
        holds no mass: each location parameter takes a power of the noise away. That is added for
        the search, as in REML.
        """

        def cost(density: SitesInJax, theta: Array) -> Array:
            energy, noise = density.potential({"theta": theta}), density._flat[1](theta)
            total = noise.get("delta_w", jnp.zeros(()))
            return energy - (len(theta) - 2 * total.size) * total.mean()

        density: SitesInJax = self
        modes, hessians = lax.map(
            lambda start: newton(lambda theta: cost(self, theta), start), self._starts
        )
        costs = jax.vmap(lambda mode: cost(self, mode))(modes)
        best = jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))  # of failed searches none
        mode, hessian = modes[best], hessians[best]
        means = (self.model.priors.beta, self.model.priors.b)
        pooled = self.model.robot_sets == "pooled" and all(
            prior.support is constraints.real for prior in means
        )
        if pooled:
            values = self._values(self.sites(mode)[0])
            robots = fit_robots(values, self._support, self._of_robots)
            density = replace(density, robots=robots)
            mode, hessian = newton(lambda theta: cost(density, theta), self._flat[0])
        return density, Chain(mode, jnp.linalg.cholesky(inverse_hessian(jnp, hessian, 0.1)))

    @property
    def _starts(self) -> Array:
        """Points to search the mode from, (start, unknown): the priors' means, and further ones.

        These have noises of the rates' scatter, and several autoregressions.
        """
        start, unravel = self._flat
        site, names = unravel(start), _AUTOREGRESSIONS
        if not self.has_level or not site.keys() >= set(_NOISES):
            return start[None]
        unit = self._support is constraints.unit_interval
        values = (-4.0, -1.5, 2.0) if unit else (-0.2, 0.2, 0.8)  # logits, or values
        scatter = jnp.log(jnp.maximum(jnp.nanstd(self.batch.contact_rate), 0.005)) - 1.0
        noise = {"delta_w": scatter, "delta_v": 0.0}  # logs of total and ratio
        further = [
            {n: jnp.full_like(site[n], v) for n, v in (noise | dict.fromkeys(names, value)).items()
             if n in site}
            for value in values
        ]  # fmt: skip
        return jnp.stack([start, *(ravel_pytree(site | moved)[0] for moved in further)])

    @property
    def _support(self) -> Any:
        return self.model.priors.beta0.support

    def _values(self, sites: Sites) -> Sites:
        """Sites on their priors' supports."""
        return {n: biject_to(prior.support)(sites[n]) for n, prior in self._priors.items()}

    def _params(self) -> Params:
        """Sample statements of the parameters, sampled effects in the intercept."""
        params = self._of_model()
        return params if self.drift is None else params._replace(b=params.b + self.drift(params))

    def _of_model(self) -> Any:
        return self.model.sample_params(*self.batch.awareness.shape[2:])

    def _ssm(self, params: Params) -> Any:
        return params.ssm(self.batch.awareness)  # pyright: ignore

    def _at(self, values: Sites) -> Any:
        return self._ssm(handlers.substitute(self._params, values)())  # pyright: ignore

    def _of_robots(self, values: Sites) -> Array:
        """Log density of each robot's rates."""
        return self.weight @ self._at(values).log_likelihood(self._rates)  # pyright: ignore

    @property
    def _rates(self) -> Array:
        """Contact rates, (bound, mission, robot)."""
        return jnp.swapaxes(self.batch.contact_rate, 0, 1)

    def _program(self) -> None:
        log_p = self._ssm(self._params()).log_likelihood(self._rates, complete=self.complete)
        numpyro.factor("contact_rate", log_p.sum(1) @ self.weight)  # pyright: ignore


def run_nuts_of_sites(
    settings: NutsSettings, seed: int, density: SitesInJax, watch: Watch
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws and statistics, each (chain, draw, ...); in a float64 scope. See `nuts.run_nuts`."""
    density, chain = _centred(density)
    rng = [np.random.default_rng([seed, i]) for i in range(settings.n_chains)]
    # Overdispersed starts (1.5 Laplace sd), so that R-hat means something.
    starts = [{"theta": jnp.asarray(1.5 * one.standard_normal(len(chain.center)))} for one in rng]
    z, stats = run_nuts(settings, seed, density, chain, starts, watch)
    params = _named(density, chain, z["theta"].reshape(-1, len(chain.center)))
    shaped = {
        name: np.asarray(values).reshape(*z["theta"].shape[:2], *values.shape[1:])
        for name, values in params.items()
    }
    return shaped, stats


@jax.jit
def _centred(density: SitesInJax) -> tuple[SitesInJax, Chain]:
    return density.centred()


@jax.jit
def _named(density: SitesInJax, chain: Chain, x: Array) -> Sites:
    return jax.vmap(lambda one: density.named(chain.theta(one)))(x)


def _mean(prior: Any) -> Array:
    """Prior mean on the real line, or 0 there if it has none, such as a Cauchy."""
    to_support = biject_to(prior.support)
    try:
        mean = jnp.asarray(prior.mean, dtype=float)
    except NotImplementedError:  # LKJCholesky: no correlation
        return to_support.inv(jnp.eye(prior.event_shape[-1]))
    z = to_support.inv(jnp.broadcast_to(mean, prior.shape()))
    return jnp.where(jnp.isfinite(z), z, 0.0)
