"""Reparametrisation of a posterior for NUTS: coordinates in which it is close to a sphere.

Method: a deterministic change of variables theta -> sites, with its Jacobian, before Laplace's
scaling (`nuts`). Each step gives one badly determined direction a separate axis:

- noises: the data fix delta_w^2 + delta_v^2 well and their ratio badly. t = log hypot(delta_w, s)
  and r = log(delta_w / s) stand in the places of log delta_w and log s, s^2 = delta_v^2 - floor^2
  where delta_v has a floor (`floored`);
- level: the data fix the average level of trust, y = beta0 y + beta . z + b, better than its parts.
  b + beta0 mean(y) + beta . mean(z) stands in the place of b. Both steps have Jacobian 1;
- collapse: the pooled model's (beta, b) are normal given the other parameters (generalised least
squares,
  `gram_jax.coefficients`). If asked for, their innovations stand in their places (Gelfand, Sahu and
  Carlin 1995), and few data round a perfect fit make no funnel;
- robots: coefficients that vary by robot are partially non-centred, see `partial_centring`.

State: one flat real vector theta, its start being the priors' means. Invariant: `potential(theta)`
is minus the log posterior density of the sites less the log Jacobian of theta -> sites, so that
`constrain` of a draw of theta is a draw of the posterior; the linearisation point and the robots'
fits, found at a first mode, are constants and change the coordinates or the weights, never the
posterior.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from numpyro.distributions import constraints

from trustbo.inference.evidence.gram_jax import Spectrum, coefficients
from trustbo.inference.samplers.laplace import newton
from trustbo.inference.samplers.partial_centring import RobotFit, centre, fit_robots
from trustbo.inference.samplers.target import NutsData, Sites, Target, innovations_shape
from trustbo.models.model import TrustModel
from trustbo.models.params import TrustParams

_OF_PLACES = {"tau_s", "length_scale", "tau_e", "place_white"}
_AUTOREGRESSIONS = {"beta0", "mean_beta0", "B0_diagonal"}


class Frame(NamedTuple):
    """Constants of the coordinates, found at a first mode."""

    linearisation: Array | None
    robots: RobotFit | None


class Reparametrisation(NamedTuple):
    """A posterior in the coordinates that NUTS samples."""

    starts: Array
    """Flat real vectors to start the search of modes from, (start, unknown)."""
    longest: Array
    """Longest step of the search in each unknown, (unknown,): finite where the starts differ."""
    constrain: Callable[[Array], Sites]
    """Function from a flat vector to parameters by name."""
    potential: Callable[[Sites], Array]
    """Minus the log density of {"theta", "innovations"}."""
    profile: Callable[[Array], Array]
    """Potential of theta at innovations 0, for the search of the mode.

    As the noises go to 0 around a perfect fit, a density of few data grows without bound, but holds
    no mass: each location parameter takes a power of the noise away. That is added, as in REML.
    """
    frame: Frame
    draw_effects: Callable[[Array, Array], Sites]
    """Effects of places, and integrated sites, given such a vector: one draw by a key."""


def reparametrise(
    model: TrustModel,
    data: NutsData,
    *,
    complete: bool = False,
    collapse: bool = False,
    frame: Frame | None = None,
) -> Reparametrisation:
    """Change variables so that the posterior is close to a sphere.

    Args:
        model: Trust model.
        data: Missions.
        complete: Whether no rate is missing before the last of a mission.
        collapse: Whether to put innovations in the places of weights and intercept.
        frame: Frame of an earlier call, which is then not searched again.
    """
    space = Coordinates(model, data, complete=complete, collapse=collapse)
    target, robots, pooling = space.target, None, model.partial_pooling
    joint = not model.family.integrates_out
    zeros = {"innovations": jnp.zeros(innovations_shape(data))} if joint else {}
    if frame is not None:
        target.linearisation, robots = frame
    elif pooling is not None or model.family.linearises:
        mode, _ = newton(lambda theta: space.potential({"theta": theta, **zeros}), target.start)
        if model.family.linearises:
            target.linearise(space.to_sites(mode)[0])
        if pooling is not None:
            robots = fit_robots(target, pooling, space.to_sites(mode)[0])

    def constrain(theta: Array) -> Sites:
        return target.constrain(space.to_sites(theta, robots)[0])

    def potential(z: Sites) -> Array:
        return space.potential(z, robots)

    def profile(theta: Array) -> Array:
        energy = potential({"theta": theta, **zeros})
        if space.collapsed or space.target.integrated:
            return energy
        total = target.unravel(theta)["delta_w"]  # t, the log of all noise
        of_places = sum(v.size for name, v in target.unravel(theta).items() if name in _OF_PLACES)
        n_locations = len(theta) - 2 * total.size - of_places
        return energy - n_locations * total.mean()

    starts, longest = _starts(model, target, space.means.scatter)

    def draw_effects(theta: Array, key: Array) -> Sites:
        return target.draw_effects(target.values(space.to_sites(theta, robots)[0]), key)

    functions = constrain, potential, profile, Frame(target.linearisation, robots), draw_effects
    return Reparametrisation(starts, longest, *functions)


def _starts(model: TrustModel, target: Target, scatter: Array) -> tuple[Array, Array]:
    """Points to search modes from, and the longest step of the search in each unknown.

    The priors' means, and other autoregressions, where modes differ, at the rates' scatter.
    """
    site = target.unravel(target.start)
    unit = model.priors.beta0.support is constraints.unit_interval
    others, step = ((-4.0, -1.5, 2.0), 0.5) if unit else ((-0.2, 0.2, 0.8), 0.05)  # logits, values

    def vector(autoregression: float, all_else: Sites) -> Array:
        moved = {name: jnp.full_like(site[name], autoregression) for name in names}
        return ravel_pytree(all_else | moved)[0]

    names = _AUTOREGRESSIONS & site.keys()
    noise = {"delta_w": jnp.log(scatter) - 1.0, "delta_v": 0.0}  # (t, r), see above
    at_scatter = site | {name: jnp.full_like(site[name], value) for name, value in noise.items()}
    starts = jnp.stack([target.start, *(vector(value, at_scatter) for value in others)])
    return starts, vector(step, {name: jnp.full_like(site[name], jnp.inf) for name in site})


class Coordinates:
    """The change of variables between a flat vector and a target's sites."""

    def __init__(
        self, model: TrustModel, data: NutsData, *, complete: bool = False, collapse: bool = False
    ) -> None:
        """Take the data's means; see `reparametrise`."""
        self.model, self.target = model, Target(model, data, complete=complete)
        self.means = _average(model, data)
        normal = all(isinstance(p, dist.Normal) for p in (model.priors.beta, model.priors.b))
        self.collapsed = collapse and data.spectrum is not None and normal

    def to_sites(self, theta: Array, robots: RobotFit | None = None) -> tuple[Sites, Array]:
        """Unconstrained sites, and the log Jacobian of the map."""
        site, log_jacobian = self.target.unravel(theta), jnp.zeros(())
        t, r = site["delta_w"], site["delta_v"]
        site = site | {
            "delta_w": t + 0.5 * jax.nn.log_sigmoid(2.0 * r),
            "delta_v": t + 0.5 * jax.nn.log_sigmoid(-2.0 * r) - self.means.log_unit,
        }
        if self.collapsed:
            return self._collapse(site)
        if robots is not None and (pooling := self.model.partial_pooling) is not None:
            return centre(self.target, pooling, site, robots)
        if self.target.integrated:
            return site, log_jacobian
        shifts = self.model.level(self.target.values(site), self.means.y, self.means.z)
        site = site | {name: site[name] - shift for name, shift in shifts.items()}
        return site, log_jacobian

    def potential(self, z: Sites, robots: RobotFit | None = None) -> Array:
        """Minus the log density of z, "theta" and if need be "innovations"."""
        site, log_jacobian = self.to_sites(z["theta"], robots)
        full = site | {name: z[name] for name in z if name != "theta"}
        return self.target.potential(full) - log_jacobian

    def _collapse(self, site: Sites) -> tuple[Sites, Array]:
        """Weights and intercept as functions of the other parameters and normal innovations."""
        priors, inverse = self.model.priors, self.target.inverse
        e = jnp.append(site["beta"], site["b"])
        others = {name: inverse[name](site[name]) for name in ("beta0", "delta_w", "delta_v")}
        x0 = {"x0_mean": priors.x0_mean, "x0_sd": priors.x0_sd}
        params = TrustParams(**others, beta=site["beta"], b=site["b"], **x0)

        weights, intercept = (
            prior(others["beta0"]) for prior in (priors.weights, priors.intercept)
        )

        def moment_of(name: str) -> Array:
            of_beta = jnp.broadcast_to(getattr(weights, name), site["beta"].shape)
            return jnp.append(of_beta, getattr(intercept, name))

        sums: Spectrum = self.target.data.spectrum  # pyright: ignore[reportAssignmentType]
        mean, L = coefficients(
            params, sums, self.model.lag, moment_of("loc"), moment_of("scale") ** -2.0
        )
        c = mean + solve_triangular(L, e, trans=1, lower=True)
        return site | {"beta": c[:-1], "b": c[-1]}, -jnp.log(jnp.diagonal(L)).sum()


class _Means(NamedTuple):
    """Averages of the data."""

    y: Array
    """Trust equivalent of the mean rate."""
    z: Array  # (feature,)
    log_unit: Array
    """Log of the noise of trust equivalent to an observation noise of 1."""
    scatter: Array
    """Standard deviation of the rates, at least .005."""


def _average(model: TrustModel, data: NutsData) -> _Means:
    if data.means is not None:
        y, z, scatter = (jnp.asarray(mean) for mean in data.means)
        return _Means(y, z, jnp.zeros(()), jnp.maximum(scatter, 0.005))
    measured = ~jnp.isnan(data.contact_rate)
    n = jnp.maximum(measured.sum(), 1)
    y = jnp.where(measured, data.contact_rate, 0.0).sum() / n
    z = jnp.where(measured[..., None], data.awareness, 0.0).sum((0, 1, 2)) / n
    scatter = jnp.sqrt((jnp.where(measured, data.contact_rate - y, 0.0) ** 2).sum() / n)
    y, log_unit = model.family.mean_level(y)
    return _Means(y, z, log_unit, jnp.maximum(scatter, 0.005) * jnp.exp(log_unit))
