"""Evidence of Gaussian rates in JAX, with derivatives in closed form, for NUTS.

The value equals that of `engine.evidence`, which NumPy computes without compilation. With the
residual e = y - m - T u at the posterior mean of the coefficients, the precision P of the rates of
a block, and the posterior covariance M of its inputs u, the derivatives of the log evidence are

    of m:  P e,        of T:  P e u' - P T M,        of V:  (P e e' P - P + P T M T' P) / 2,

summed over blocks. They follow from Fisher's identity: the slope of log p(y | theta) is the
posterior mean of the slope of log p(y, c | theta). Compared with automatic differentiation, the
closed form needs a third of the operations and compiles in half the time.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trustbo.inference.engine import Blocks, Prior
from trustbo.inference.factor import Factor, add_products, times
from trustbo.models.backend import inverse_and_log_det
from trustbo.statespace.blocks import LinearPredictor, each


def log_evidence(blocks: Blocks, predictor: LinearPredictor, prior: Prior, lam: Any) -> Any:
    """Compute log p(y | theta) (point,) with linear predictors and coefficients integrated out.

    Args:
        blocks: Data of all blocks.
        predictor: Distribution of the linear predictors given the coefficients.
        prior: Prior on the coefficients.
        lam: Site precisions (point, kind, row), 0 where nothing was measured.
    """
    seen = blocks.seen
    label = blocks.label
    both = seen[:, :, None] & seen[:, None, :]

    # Rows without a measurement get the unit matrix. Both calls of `where` keep infinities out of
    # the derivatives.
    variance = jnp.where(seen, 1.0 / jnp.where(seen, lam, 1.0), 1.0)

    V = jnp.where(both, each(predictor.covariance, label), 0.0)
    V = V + variance[..., None] * np.eye(V.shape[-1])
    m = _of_kinds(predictor.mean, label)
    T = _of_kinds(predictor.response, label)

    A = prior.add_to(jnp.zeros((len(prior.mean), blocks.order.size)), blocks.order)
    return _of_data(blocks)(m, T, V, prior.mean, A) + 0.5 * prior.log_det


def _of_kinds(values: Any, label: np.ndarray) -> Any:
    """Select values (point, kind, ...) by the label of each kind."""
    chosen = each(values, label)
    return jnp.broadcast_to(chosen, (len(chosen), len(label), *chosen.shape[2:]))


def _of_data(blocks: Blocks) -> Callable[..., jax.Array]:
    """Return the log evidence without the log determinant of the prior, as a JAX function.

    Its arguments are the means m (point, kind, row), responses T (point, kind, row, input) and
    covariances V (point, kind, row, row) of the rates, the prior mean (point, column), and the
    stored entries of the prior precision (point, entry). Rows of V that were not measured are those
    of the unit matrix.
    """
    b = blocks
    n_kinds = len(b.seen)
    measured = b.seen[b.kind]
    both = b.seen[:, :, None] & b.seen[:, None, :]
    is_kind = (np.arange(n_kinds)[:, None] == b.kind).astype(float)
    n_of_kind = is_kind.sum(1)

    def inputs(c: Any) -> Any:
        return times(b.U, c).reshape(len(c), len(b.y), -1)

    def per_kind(left: Any, right: Any) -> Any:
        """Sum the outer products of vectors (point, block, ...) over the blocks of each kind."""
        products = left[..., None] * right[:, :, None]
        return jnp.einsum("kb,nbij->nkij", is_kind, products)

    def value(m: Any, T: Any, V: Any, mean: Any, A: Any) -> tuple[Any, Any]:
        P, log_det = inverse_and_log_det(V)
        P = jnp.where(both, P, 0.0)
        PT = P @ T
        P_of = each(P, b.kind)
        T_of = each(T, b.kind)

        # Residuals at the prior mean; the rest is as in `engine.evidence`, with P = W' W.
        first = b.y - each(m, b.kind) - (T_of @ inputs(mean)[..., None])[..., 0]
        first = jnp.where(measured, first, 0.0)
        weighted = (P_of @ first[..., None])[..., 0]
        h = times(b.U.T, (T_of.mT @ weighted[..., None])[..., 0].reshape(len(A), -1))
        h = jnp.concatenate([h, jnp.zeros((len(A), b.order.hidden.size))], axis=1)

        pairs = (T.mT @ PT)[:, :, *np.triu_indices(T.shape[3])]
        F = Factor.from_precision(b.order, add_products(A, b.at, b.sums, pairs.reshape(len(A), -1)))
        half = F.forward(h)

        of_rates = log_det + np.log(2.0 * np.pi) * b.seen.sum(1)
        log_p = -0.5 * (of_rates @ n_of_kind + (first * weighted).sum((1, 2)) - (half**2).sum(1))
        log_p = log_p - F.log_det
        return log_p, (P, PT, P_of, T_of, F, half, first)

    def with_slopes(m: Any, T: Any, V: Any, mean: Any, A: Any) -> tuple[Any, Any]:
        log_p, (P, PT, P_of, T_of, F, half, first) = value(m, T, V, mean, A)

        # Posterior mean of the coefficients, relative to the prior mean, and P e there.
        c = F.back(half[:, None])[:, 0]
        off = inputs(c[:, : mean.shape[1]])  # without hidden columns
        Pe = (P_of @ (first - (T_of @ off[..., None])[..., 0])[..., None])[..., 0]

        # Posterior covariance M of the inputs, summed over the blocks of each kind.
        covariance = F.covariance()
        k, j = np.triu_indices(T.shape[3])
        halves = times(b.sums.T, covariance[:, b.at]).reshape(len(A), n_kinds, -1)
        M = jnp.zeros((len(A), n_kinds, T.shape[3], T.shape[3])).at[..., k, j].set(halves)
        M = M + M.mT

        # The derivatives at the top of this file, by Fisher's identity.
        PTM = PT @ M
        of_m = jnp.einsum("kb,nbi->nki", is_kind, Pe)
        of_T = per_kind(Pe, off + inputs(mean)) - PTM
        of_V = 0.5 * (per_kind(Pe, Pe) - n_of_kind[:, None, None] * P + PTM @ PT.mT)
        of_mean = times(b.U.T, (T_of.mT @ Pe[..., None])[..., 0].reshape(len(A), -1))
        of_A = -(covariance + F.outer(c))
        return log_p, (of_m, of_T, of_V, of_mean, of_A)

    def scaled(slopes: Any, slope: Any) -> Any:
        """Multiply the derivatives by the slope (point,) of a function of the evidence."""
        return tuple(slope.reshape(-1, *(1,) * (of.ndim - 1)) * of for of in slopes)

    function = jax.custom_vjp(lambda *arguments: value(*arguments)[0])
    function.defvjp(with_slopes, scaled)
    return function
