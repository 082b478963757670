"""The change of variables that makes a posterior round, and its mode.

NUTS works on a flat real vector. In place of the parameters it sees what the data say of them:

- the data fix delta_w^2 + delta_v^2 well and their ratio badly: t, the log of their root, and r =
  log(delta_w / delta_v), stand in the places of delta_w and delta_v;
- they fix the level that trust has on average, y = beta0 y + beta . z + b, better than its parts:
  b + beta0 mean(y) + beta . mean(z) stands in the place of b. Both have Jacobian 1;
- weights and intercept of the pooled model are normal given all else: if asked for, standard normal
  noise stands in their place, and few data round a perfect fit make no funnel;
- coefficients that vary by robot, e = (c - mu) / tau, non-centred, would make a funnel where the
  data know a robot better than the others tell: in the place of e stands what is left when c is
  drawn from N(mu, tau^2) times a Gaussian fit of the robot's own likelihood; in the place of mu,
  what is left when it is drawn given tau and those fits.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import Array, lax, random
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import cho_solve, solve_triangular
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import constrain_fn, potential_energy

from trustbo.models import observation as families
from trustbo.models.contact_rate import ContactRate
from trustbo.models.hierarchical import HierarchicalTrust
from trustbo.models.model import TrustModel
from trustbo.models.params import TrustParams
from trustbo.models.spectral import Spectrum, coefficients


class NutsData(NamedTuple):
    """The data, as compiled code takes them."""

    awareness: Array | np.ndarray  # (mission, bound, robot, feature)
    contact_rate: Array | np.ndarray  # (mission, bound, robot)
    exposure: Array | np.ndarray  # (mission, bound, robot)
    weight: Array | np.ndarray  # (mission,)
    spectrum: Spectrum | None = None
    """Of pooled Gaussian missions without gaps: their sums, which take the rates' place."""
    means: tuple[Array | np.ndarray, Array | np.ndarray] | None = None
    """Mean rate and mean awareness (feature,), which go with the sums."""


class _Robots(NamedTuple):
    """Gaussian fit of each robot's likelihood in its coefficients, on the real line."""

    center: Array  # (robot, coefficient)
    precision: Array  # (robot, coefficient, coefficient)


class _Space:
    """Between a flat vector, the sites' own real lines, and parameters."""

    def __init__(
        self,
        model: TrustModel,
        data: NutsData,
        *,
        shared: bool,
        joint: bool,
        collapse: bool = False,
    ) -> None:
        self.model, self.data, self.joint = model, data, joint
        self.args = (data.awareness, data.contact_rate)
        self.options = {
            "exposure": data.exposure,
            "weight": data.weight,
            "shared": shared,
            "joint": joint,
            "pilot": None,
            "spectrum": data.spectrum,
        }
        seeded = handlers.seed(model, random.key(0))
        trace = handlers.trace(seeded).get_trace(*self.args, **self.options)
        sites = {
            name: site
            for name, site in trace.items()
            if site["type"] == "sample" and not site["is_observed"] and name != "noise"
        }
        self.inverse = {name: biject_to(site["fn"].support) for name, site in sites.items()}
        start = {name: _start(self.inverse[name], site["fn"]) for name, site in sites.items()}
        self.start, self.unravel = ravel_pytree(start)
        self.means = _average(model, data)
        normal = all(isinstance(p, dist.Normal) for p in (model.priors.beta, model.priors.b))
        self.collapsed = collapse and data.spectrum is not None and normal

    def to_sites(self, theta: Array, robots: _Robots | None) -> tuple[dict[str, Array], Array]:
        """The sites on their own real lines, and the log Jacobian of the way there."""
        site, log_jacobian = self.unravel(theta), jnp.zeros(())
        t, r = site["delta_w"], site["delta_v"]
        site = site | {
            "delta_w": t + 0.5 * jax.nn.log_sigmoid(2.0 * r),
            "delta_v": t + 0.5 * jax.nn.log_sigmoid(-2.0 * r) - self.means.log_unit,
        }
        if self.collapsed:
            return self._collapse(site)
        if robots is not None and isinstance(self.model, HierarchicalTrust):
            return self._whiten(self.model, site, robots)
        shifts = self.model.level(self.values(site), self.means.y, self.means.z)
        site = site | {name: site[name] - shift for name, shift in shifts.items()}
        return site, log_jacobian

    def values(self, site: dict[str, Array]) -> dict[str, Array]:
        """The sites as their priors see them."""
        return {name: self.inverse[name](site[name]) for name in self.inverse}

    def potential(self, z: dict[str, Array], robots: _Robots | None = None) -> Array:
        """Minus the log density of z."""
        site, log_jacobian = self.to_sites(z["theta"], robots)
        full = site | {name: z[name] for name in z if name != "theta"}
        energy = potential_energy(self.model, self.args, self.options, full)
        return energy - log_jacobian  # pyright: ignore[reportOperatorIssue]

    def constrain(self, theta: Array, robots: _Robots | None = None) -> dict[str, Array]:
        """The model's parameters, by name."""
        full = self.to_sites(theta, robots)[0]
        if self.joint:
            full["noise"] = jnp.zeros(noise_shape(self.data))
        values = constrain_fn(self.model, self.args, self.options, full, return_deterministic=True)
        return {name: values[name] for name in self.model.dims}

    def fit_pilot(self, theta: Array) -> None:
        """Take the counts for what they are worth at theta, from now on."""
        values = self.values(self.to_sites(theta, None)[0])
        values["noise"] = jnp.zeros(noise_shape(self.data))
        at = handlers.substitute(handlers.seed(self.model, random.key(0)), values)
        rates = handlers.trace(at).get_trace(*self.args, **self.options)["contact_rate"]["fn"]
        observed = rates.observed(self.data.contact_rate)
        observed = families.refine(self.model.observation, rates.ssm(), observed)
        self.options["pilot"] = observed.pilot

    def fit_robots(self, model: HierarchicalTrust, theta: Array) -> _Robots:
        """One Newton step from theta on each robot's log-likelihood of its coefficients."""
        values = self.values(self.to_sites(theta, None)[0])
        c, mu, tau = model.robot_coefficients(values)

        def log_likelihood(c: Array) -> Array:
            deviations = model.robot_sites((c - mu[None]) / tau[None])
            params = model.assemble(values | deviations)
            rates = ContactRate(
                params,
                self.data.awareness,
                exposure=self.data.exposure,
                observation=model.observation,
                lag=model.lag,
                pilot=self.options["pilot"],
            )
            observed = rates.observed(self.data.contact_rate)
            zero = jnp.zeros_like(observed.y)
            weight = families.log_weight(
                model.observation, rates.ssm(), observed, zero, shared=False
            )
            return (weight * self.data.weight[:, None]).sum(0)

        index = jnp.arange(len(c))
        gradient = jax.jacfwd(log_likelihood)(c)[index, index]
        hessian = jax.jacfwd(jax.jacfwd(log_likelihood))(c)[index, index, :, index]
        # A robot whose likelihood is not concave here counts as known by the others only.
        eigenvalues, vectors = jnp.linalg.eigh(-hessian)
        eigenvalues = jnp.maximum(eigenvalues, 1e-3)
        precision = (vectors * eigenvalues[:, None, :]) @ jnp.swapaxes(vectors, 1, 2)
        step = jnp.linalg.solve(precision, gradient[..., None])[..., 0]
        return _Robots(c + step, precision)

    def _collapse(self, site: dict[str, Array]) -> tuple[dict[str, Array], Array]:
        """Weights and intercept drawn given all else: what is left is standard normal."""
        priors, e = self.model.priors, jnp.append(site["beta"], site["b"])
        others = {name: self.inverse[name](site[name]) for name in ("beta0", "delta_w", "delta_v")}
        x0 = {"x0_mean": priors.x0_mean, "x0_sd": priors.x0_sd}
        params = TrustParams(**others, beta=site["beta"], b=site["b"], **x0)

        def each(name: str) -> Array:
            of_beta = jnp.broadcast_to(getattr(priors.beta, name), site["beta"].shape)
            return jnp.append(of_beta, getattr(priors.b, name))

        data: Spectrum = self.data.spectrum  # pyright: ignore[reportAssignmentType]
        mean, L = coefficients(params, data, self.model.lag, each("loc"), each("scale") ** -2.0)
        c = mean + solve_triangular(L, e, trans=1, lower=True)
        return site | {"beta": c[:-1], "b": c[-1]}, -jnp.log(jnp.diagonal(L)).sum()

    def _whiten(
        self, model: HierarchicalTrust, site: dict[str, Array], robots: _Robots
    ) -> tuple[dict[str, Array], Array]:
        """Means given spreads, then robots given both, as the Gaussian fits have them."""
        noise = model.robot_deviations(site)
        _, mu, tau = model.robot_coefficients(self.values(site))
        log_jacobian = -len(noise) * jnp.log(tau).sum()
        if model.means_are_real:
            spread = jnp.linalg.inv(robots.precision) + jnp.diag(tau**2)[None]
            known = jnp.linalg.inv(spread)
            # Unit precision stands for the priors, which are about so wide.
            L = jnp.linalg.cholesky(known.sum(0) + jnp.eye(len(mu)))
            center = cho_solve((L, True), jnp.einsum("icd,id->c", known, robots.center))
            mu = center + solve_triangular(L, mu, trans=1, lower=True)
            log_jacobian = log_jacobian - jnp.log(jnp.diagonal(L)).sum()
            site = site | model.mean_sites(mu)
        L = jnp.linalg.cholesky(robots.precision + jnp.diag(tau**-2.0)[None])
        total = jnp.einsum("icd,id->ic", robots.precision, robots.center) + (mu / tau**2)[None]
        c = cho_solve((L, True), total[..., None])
        c = c + solve_triangular(L, noise[..., None], trans=1, lower=True)
        log_jacobian = log_jacobian - jnp.log(jnp.diagonal(L, axis1=1, axis2=2)).sum()
        return site | model.robot_sites((c[..., 0] - mu[None]) / tau[None]), log_jacobian


class RoundTarget(NamedTuple):
    """A posterior, fit to be sampled."""

    start: Array
    """A flat real vector to look for the mode from."""
    constrain: Callable[[Array], dict[str, Array]]
    """From there to parameters."""
    potential: Callable[[dict[str, Array]], Array]
    """Minus the log density of {"theta", "noise"}."""
    profile: Callable[[Array], Array]
    """The same of theta, without noise, for the search of the mode.

    As noise goes to 0 around a perfect fit, a density of few data grows without bound, but holds no
    mass: each location parameter takes a power of the noise away. That is added, as REML does.
    """
    pilot: Array | None


def round_target(
    model: TrustModel, data: NutsData, *, shared: bool, joint: bool, collapse: bool = False
) -> RoundTarget:
    """Change variables so that the posterior becomes round."""
    space = _Space(model, data, shared=shared, joint=joint, collapse=collapse)
    noise = {"noise": jnp.zeros(noise_shape(data))} if joint else {}
    robots, start = None, space.start
    if isinstance(model, HierarchicalTrust) or model.observation == "beta_binomial":
        mode, _ = newton(lambda theta: space.potential({"theta": theta, **noise}), start)
        if model.observation == "beta_binomial":
            space.fit_pilot(mode)
        if isinstance(model, HierarchicalTrust):
            robots = space.fit_robots(model, mode)

    def constrain(theta: Array) -> dict[str, Array]:
        return space.constrain(theta, robots)

    def potential(z: dict[str, Array]) -> Array:
        return space.potential(z, robots)

    def profile(theta: Array) -> Array:
        energy = potential({"theta": theta, **noise})
        if space.collapsed:
            return energy
        total = space.unravel(theta)["delta_w"]  # t, the log of all noise
        n_locations = len(theta) - 2 * total.size
        return energy - n_locations * total.mean()

    return RoundTarget(start, constrain, potential, profile, space.options["pilot"])


def newton(
    potential: Callable[[Array], Array], start: Array, n_steps: int = 40
) -> tuple[Array, Array]:
    """Mode and Hessian there, by Newton's method with a trust-region ridge."""

    def everything(z: Array):
        def with_value(z: Array):
            value, gradient = jax.value_and_grad(potential)(z)
            return gradient, (value, gradient)

        hessian, (value, gradient) = jax.jacfwd(with_value, has_aux=True)(z)
        return value, gradient, hessian

    def step(_, carry):
        z, at, proposal, ridge = carry
        new = everything(proposal)
        # The Hessian may overflow where the value does not: such a point is not stepped on.
        finite = jnp.isfinite(new[1]).all() & jnp.isfinite(new[2]).all()
        better = finite & (new[0] < at[0])
        z = jnp.where(better, proposal, z)
        at = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, at)
        ridge = jnp.where(better, ridge / 4.0, ridge * 8.0 + 1e-6)
        eigenvalues, vectors = jnp.linalg.eigh(at[2])
        # Away from the mode the Hessian may be indefinite: its absolute value still gives descent.
        rotated = vectors.T @ at[1] / (jnp.maximum(jnp.abs(eigenvalues), 1e-6) + ridge)
        return z, at, z - vectors @ rotated, ridge

    d = len(start)
    nothing = (jnp.asarray(jnp.inf), jnp.zeros(d), jnp.eye(d))
    carry = (start, nothing, start, jnp.asarray(4.0))
    z, (_, _, hessian), _, _ = lax.fori_loop(0, n_steps, step, carry)
    return z, hessian


def inverse_hessian(hessian: Array) -> Array:
    """The covariance of the Gaussian fit at a mode."""
    eigenvalues, vectors = jnp.linalg.eigh(hessian)
    # Floor: flat directions get the scale of the unconstrained priors, not an infinite one.
    return (vectors / jnp.maximum(eigenvalues, 0.1)[None]) @ vectors.T


def noise_shape(data: NutsData) -> tuple[int, ...]:
    """(bound, mission, robot)."""
    n_missions, n_bounds, n_robots = data.contact_rate.shape
    return (n_bounds, n_missions, n_robots)


class _Means(NamedTuple):
    """What the data are like on average."""

    y: Array
    """Mean rate, or its logit, where measured."""
    z: Array  # (feature,)
    log_unit: Array
    """Log of the noise of trust that an observation noise of 1 is worth."""


def _average(model: TrustModel, data: NutsData) -> _Means:
    if data.means is not None:
        y, z = data.means
        return _Means(jnp.asarray(y), jnp.asarray(z), jnp.zeros(()))
    measured = ~jnp.isnan(data.contact_rate)
    n = jnp.maximum(measured.sum(), 1)
    y = jnp.where(measured, data.contact_rate, 0.0).sum() / n
    z = jnp.where(measured[..., None], data.awareness, 0.0).sum((0, 1, 2)) / n
    if model.observation != "beta_binomial":
        return _Means(y, z, jnp.zeros(()))
    p = jnp.clip(y, 0.02, 0.98)
    return _Means(jax.scipy.special.logit(p), z, -0.5 * jnp.log(p * (1.0 - p)))


def _start(transform, prior) -> Array:
    """The prior's mean on the real line, or 0 there if it has none, as a Cauchy has not."""
    try:
        mean = jnp.asarray(prior.mean, dtype=float)
    except NotImplementedError:  # LKJCholesky: no correlation
        return transform.inv(jnp.eye(prior.event_shape[-1]))
    z = transform.inv(jnp.broadcast_to(mean, prior.shape()))
    return jnp.where(jnp.isfinite(z), z, 0.0)
