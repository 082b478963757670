"""Evidence of Gaussian rates for NUTS, with derivatives in closed form.

JAX computes the means, responses, covariances and priors of `engine` at each theta. NumPy then
computes the evidence from these arrays, and its derivatives with respect to them, so that the
sparse factors need no version in JAX. With the residual e = y - m - T u at the posterior mean of
the coefficients, the precision P of the rates of a block, and the posterior covariance M of its
inputs u, the derivatives of the log evidence are

    of m:  P e,        of T:  P e u' - P T M,        of V:  (P e e' P - P + P T M T' P) / 2,

summed over blocks. They follow from Fisher's identity: the slope of log p(y | theta) is the
posterior mean of the slope of log p(y, c | theta).
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trustbo.inference.engine import Blocks, Prior, covariance_of_inputs, inputs, regress
from trustbo.inference.factor import cholesky, log_diagonal, upper
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

    return _of_data(blocks)(m, T, V, prior.mean, *prior.parts) + 0.5 * prior.log_det


def _of_kinds(values: Any, label: np.ndarray) -> Any:
    """Select values (point, kind, ...) by the label of each kind."""
    chosen = each(values, label)
    return jnp.broadcast_to(chosen, (len(chosen), len(label), *chosen.shape[2:]))


def _of_data(blocks: Blocks) -> Callable[..., jax.Array]:
    """Return the log evidence without the log determinant of the prior, as a JAX function.

    Its arguments are those of `_value`.
    """

    def value(*arguments: jax.Array) -> jax.Array:
        def log_p(*arrays: np.ndarray) -> list[np.ndarray]:
            return [_value(blocks, *arrays)[0]]

        return _in_numpy(log_p, arguments, [arguments[0].shape[:1]])[0]

    def with_slopes(*arguments: jax.Array) -> tuple[jax.Array, list[jax.Array]]:
        def both(*arrays: np.ndarray) -> list[np.ndarray]:
            return _value_and_slopes(blocks, *arrays)

        shapes = [arguments[0].shape[:1], *(one.shape for one in arguments)]
        log_p, *slopes = _in_numpy(both, arguments, shapes)
        return log_p, slopes

    def scaled(slopes: Any, slope: Any) -> Any:
        """Multiply the derivatives by the slope (point,) of a function of the evidence."""
        return tuple(slope.reshape(-1, *(1,) * (of.ndim - 1)) * of for of in slopes)

    function = jax.custom_vjp(value)
    function.defvjp(with_slopes, scaled)
    return function


def _in_numpy(
    function: Callable[..., list[np.ndarray]],
    arguments: Sequence[jax.Array],
    shapes: Sequence[tuple[int, ...]],
) -> list[jax.Array]:
    """Call a NumPy function of arrays (point, ...) from JAX; the results have the given shapes.

    All numbers are passed in one array, because JAX needs time for each, and as pairs of integers:
    callbacks run in threads of JAX without the setting of `own_settings`, in which JAX would round
    them to single precision.
    """
    of_arguments = [one.shape[1:] for one in arguments]
    of_results = [shape[1:] for shape in shapes]

    def on_bits(bits: Any) -> np.ndarray:
        flat = np.asarray(bits).view(np.float64)[..., 0]  # (..., point, number)
        leading = flat.shape[:-1]  # `jax.vmap` adds axes
        with np.errstate(all="ignore"):  # extreme scores overflow, and NUTS rejects them
            found = function(*_split(flat.reshape(-1, flat.shape[-1]), of_arguments))
        results = np.concatenate([one.reshape(len(one), -1) for one in found], axis=1)
        return results.reshape(*leading, -1, 1).view(np.uint32)

    n_points = len(arguments[0])
    size = sum(int(np.prod(shape)) for shape in of_results)
    flat = jnp.concatenate([one.reshape(n_points, -1) for one in arguments], axis=1)
    found = jax.pure_callback(
        on_bits,
        jax.ShapeDtypeStruct((n_points, size, 2), np.uint32),
        jax.lax.bitcast_convert_type(flat, np.uint32),
        vmap_method="broadcast_all",
    )
    return _split(jax.lax.bitcast_convert_type(found, np.float64), of_results)


def _split(flat: Any, shapes: Sequence[tuple[int, ...]]) -> list[Any]:
    """Split values (point, number) into arrays (point, ...) of the given shapes."""
    arrays = []
    end = 0
    for shape in shapes:
        start = end
        end = start + int(np.prod(shape))
        arrays.append(flat[:, start:end].reshape(len(flat), *shape))
    return arrays


def _value(blocks: Blocks, *arguments: np.ndarray) -> tuple[np.ndarray, tuple[Any, ...]]:
    """Compute the log evidence (point,) without the log determinant of the prior.

    Args:
        blocks: Data of all blocks.
        arguments: Means m (point, kind, row), responses T (point, kind, row, input) and covariances
            V (point, kind, row, row) of the rates, the prior mean (point, column), and the parts of
            the prior precision; see `Prior`. Rows of V that were not measured are those of the unit
            matrix.

    Returns:
        The log evidence, and what `_value_and_slopes` needs.
    """
    m, T, V, mean, *parts = arguments
    b = blocks
    L = cholesky(V)
    W = np.linalg.inv(L) * b.seen[:, None]

    # Residuals at the prior mean.
    off = inputs(b, mean)
    first = b.y - m[:, b.kind] - (T[:, b.kind] @ off[..., None])[..., 0]
    F, half, w = regress(b, W, first, T, parts)

    n_of_kind = np.bincount(b.kind, minlength=len(b.seen)).astype(float)
    of_rates = 2.0 * log_diagonal(L) + np.log(2.0 * np.pi) * b.seen.sum(1)
    log_p = -0.5 * (of_rates @ n_of_kind + (w**2).sum((1, 2)) - (half**2).sum(1)) - F.log_det
    return log_p, (W, F, half, first, off, n_of_kind)


def _value_and_slopes(blocks: Blocks, *arguments: np.ndarray) -> list[np.ndarray]:
    """Compute `_value`, and its derivatives with respect to each argument."""
    log_p, (W, F, half, first, off, n_of_kind) = _value(blocks, *arguments)
    _, T, _, _, *parts = arguments
    b = blocks
    n = len(T)
    P = np.swapaxes(W, 2, 3) @ W
    PT = P @ T
    T_of = T[:, b.kind]

    # Posterior mean of the coefficients, relative to the prior mean, and P e there.
    c = F.back(half[:, None])[:, 0]
    at_mean = inputs(b, c)
    e = first - (T_of @ at_mean[..., None])[..., 0]
    Pe = (P[:, b.kind] @ e[..., None])[..., 0]

    # Posterior covariance of the coefficients, and M, summed over the blocks of each kind.
    covariance = F.covariance()
    M = covariance_of_inputs(b, covariance, T.shape[3])

    # The derivatives at the top of this file, by Fisher's identity.
    is_kind = (np.arange(len(b.seen))[:, None] == b.kind).astype(float)
    PTM = PT @ M
    of_m = is_kind @ Pe
    of_T = _per_kind(is_kind, Pe, at_mean + off) - PTM
    of_V = 0.5 * (
        _per_kind(is_kind, Pe, Pe) - n_of_kind[:, None, None] * P + PTM @ np.swapaxes(PT, 2, 3)
    )
    of_mean = (b.U.T @ (np.swapaxes(T_of, 2, 3) @ Pe[..., None]).reshape(n, -1).T).T

    of_parts = []
    end = 0
    for part, entries in zip(parts, b.of_prior, strict=True):
        start = end
        end = start + part.shape[1]
        one = c[:, start:end]
        found = covariance[entries].T
        if part.ndim == 2:
            of_parts.append(-0.5 * (2.0 * found + one**2))
            continue

        i, j = upper(part.shape[1])
        cov = np.zeros(part.shape)
        cov[:, i, j] = found  # with half of the diagonal
        cov += np.swapaxes(cov, 1, 2)
        of_parts.append(-0.5 * (cov + one[:, :, None] * one[:, None]))
    return [log_p, of_m, of_T, of_V, of_mean, *of_parts]


def _per_kind(is_kind: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Sum the outer products of vectors (point, block, ...) over the blocks of each kind."""
    products = left[..., None] * right[:, :, None]
    n, n_blocks, *shape = products.shape
    return (is_kind @ products.reshape(n, n_blocks, -1)).reshape(n, -1, *shape)
