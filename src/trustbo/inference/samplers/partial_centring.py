"""Partially non-centred coordinates of coefficients that vary by robot.

Deviations e = (c - mu) / tau make a funnel where a robot's data are more informative than the other
robots (Papaspiliopoulos, Roberts and Skoeld 2007). With a Gaussian fit N(center_i, precision_i^-1)
of each robot's likelihood, c given mu and tau is normal in closed form, and so is mu given tau:
standard normal innovations of these two conditionals take the places of e and mu.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import cho_solve, solve_triangular
from numpyro.distributions.transforms import biject_to

_COLUMNS = {"e_beta0": 0, "e_beta": slice(1, -1), "e_b": -1}


class RobotFit(NamedTuple):
    """Gaussian fit of each robot's likelihood in its coefficients, on the real line."""

    center: Array  # (robot, coefficient)
    precision: Array  # (robot, coefficient, coefficient)


def fit_robots(
    values: Mapping[str, Array], support: Any, log_likelihood: Callable[[dict[str, Array]], Array]
) -> RobotFit:
    """One Newton step on each robot's log-likelihood of its coefficients.

    Args:
        values: Sites of `HierarchicalTrust`, on their supports.
        support: Support of the mean of beta0.
        log_likelihood: Log density (robot,) of rates at sites.
    """
    mu, tau = _moments(values, support)
    c = mu[None] + tau[None] * _deviations(values)

    def of_robots(c: Array) -> Array:
        return log_likelihood({**values, **_sites((c - mu[None]) / tau[None])})

    index = jnp.arange(len(c))
    gradient = jax.jacfwd(of_robots)(c)[index, index]
    hessian = jax.jacfwd(jax.jacfwd(of_robots))(c)[index, index, :, index]
    # A robot whose likelihood is not concave here is informed by the others only.
    eigenvalues, vectors = jnp.linalg.eigh(-hessian)
    eigenvalues = jnp.maximum(eigenvalues, 1e-3)
    precision = (vectors * eigenvalues[:, None, :]) @ jnp.swapaxes(vectors, 1, 2)
    step = jnp.linalg.solve(precision, gradient[..., None])[..., 0]
    return RobotFit(c + step, precision)


def centre(
    values: Mapping[str, Array], support: Any, fit: RobotFit
) -> tuple[dict[str, Array], Array]:
    """Means on the real line and deviations, of innovations in their places; the log Jacobian."""
    innovations, (mu, tau) = _deviations(values), _moments(values, support)
    log_jacobian = -len(innovations) * jnp.log(tau).sum()
    information = jnp.linalg.inv(jnp.linalg.inv(fit.precision) + jnp.diag(tau**2)[None])
    # Unit precision stands for the priors, which are about so wide.
    L = jnp.linalg.cholesky(information.sum(0) + jnp.eye(len(mu)))
    middle = cho_solve((L, True), jnp.einsum("icd,id->c", information, fit.center))
    mu = middle + solve_triangular(L, mu, trans=1, lower=True)
    log_jacobian -= jnp.log(jnp.diagonal(L)).sum()
    L = jnp.linalg.cholesky(fit.precision + jnp.diag(tau**-2.0)[None])
    total = jnp.einsum("icd,id->ic", fit.precision, fit.center) + (mu / tau**2)[None]
    c = cho_solve((L, True), total[..., None])
    c = c + solve_triangular(L, innovations[..., None], trans=1, lower=True)
    log_jacobian -= jnp.log(jnp.diagonal(L, axis1=1, axis2=2)).sum()
    means = {"mean_beta0": mu[0], "mean_beta": mu[1:-1], "mean_b": mu[-1]}
    return means | _sites((c[..., 0] - mu[None]) / tau[None]), log_jacobian


def _moments(values: Mapping[str, Array], support: Any) -> tuple[Array, Array]:
    """Means and spreads of the coefficients on the real line, each (coefficient,)."""
    mean_beta0 = biject_to(support).inv(values["mean_beta0"])
    mu = jnp.concatenate([mean_beta0[None], values["mean_beta"], values["mean_b"][None]])
    tau = [values["tau_beta0"][None], values["tau_beta"], values["tau_b"][None]]
    return mu, jnp.concatenate(tau)


def _deviations(values: Mapping[str, Array]) -> Array:
    """Deviations in units of tau, (robot, coefficient)."""
    columns = [values["e_beta0"][:, None], values["e_beta"], values["e_b"][:, None]]
    return jnp.concatenate(columns, axis=1)


def _sites(deviations: Array) -> dict[str, Array]:
    """Sites of deviations: the inverse of `_deviations`."""
    return {name: deviations[:, column] for name, column in _COLUMNS.items()}
