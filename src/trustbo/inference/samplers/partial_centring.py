"""Partially non-centred coordinates of coefficients that vary by robot.

Deviations e = (c - mu) / tau make a funnel where a robot's data are more informative than the other
robots (Papaspiliopoulos, Roberts and Skoeld 2007). With a Gaussian fit N(center_i, precision_i^-1)
of each robot's likelihood, c given mu and tau is normal in closed form, and so is mu given tau:
standard normal innovations of these two conditionals take the places of e and mu.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import cho_solve, solve_triangular

from trustbo.inference.samplers.target import Sites, Target
from trustbo.models.hierarchical import HierarchicalTrust


class RobotFit(NamedTuple):
    """Gaussian fit of each robot's likelihood in its coefficients, on the real line."""

    center: Array  # (robot, coefficient)
    precision: Array  # (robot, coefficient, coefficient)


def fit_robots(target: Target, pooling: HierarchicalTrust, site: Sites) -> RobotFit:
    """One Newton step from `site` on each robot's log-likelihood of its coefficients."""
    values = target.values(site)
    c, mu, tau = pooling.robot_coefficients(values)

    def log_likelihood(c: Array) -> Array:
        deviations = pooling.robot_sites((c - mu[None]) / tau[None])
        log_p = target.log_likelihood(pooling.assemble(values | deviations))
        return (log_p * target.data.weight[:, None]).sum(0)

    index = jnp.arange(len(c))
    gradient = jax.jacfwd(log_likelihood)(c)[index, index]
    hessian = jax.jacfwd(jax.jacfwd(log_likelihood))(c)[index, index, :, index]
    # A robot whose likelihood is not concave here is informed by the others only.
    eigenvalues, vectors = jnp.linalg.eigh(-hessian)
    eigenvalues = jnp.maximum(eigenvalues, 1e-3)
    precision = (vectors * eigenvalues[:, None, :]) @ jnp.swapaxes(vectors, 1, 2)
    step = jnp.linalg.solve(precision, gradient[..., None])[..., 0]
    return RobotFit(c + step, precision)


def centre(
    target: Target, pooling: HierarchicalTrust, site: Sites, fit: RobotFit
) -> tuple[Sites, Array]:
    """Sites of innovations in the places of means and deviations, and the log Jacobian."""
    innovations = pooling.robot_deviations(site)
    _, mu, tau = pooling.robot_coefficients(target.values(site))
    log_jacobian = -len(innovations) * jnp.log(tau).sum()
    if pooling.means_are_real:
        spread = jnp.linalg.inv(fit.precision) + jnp.diag(tau**2)[None]
        information = jnp.linalg.inv(spread)
        # Unit precision stands for the priors, which are about so wide.
        L = jnp.linalg.cholesky(information.sum(0) + jnp.eye(len(mu)))
        center = cho_solve((L, True), jnp.einsum("icd,id->c", information, fit.center))
        mu = center + solve_triangular(L, mu, trans=1, lower=True)
        log_jacobian = log_jacobian - jnp.log(jnp.diagonal(L)).sum()
        site = site | pooling.mean_sites(mu)
    L = jnp.linalg.cholesky(fit.precision + jnp.diag(tau**-2.0)[None])
    total = jnp.einsum("icd,id->ic", fit.precision, fit.center) + (mu / tau**2)[None]
    c = cho_solve((L, True), total[..., None])
    c = c + solve_triangular(L, innovations[..., None], trans=1, lower=True)
    log_jacobian = log_jacobian - jnp.log(jnp.diagonal(L, axis1=1, axis2=2)).sum()
    return site | pooling.robot_sites((c[..., 0] - mu[None]) / tau[None]), log_jacobian
