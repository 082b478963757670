"""The evidence of Gaussian rates in JAX, at one theta and differentiable, for NUTS.

The steps are those of `gaussian`, with its sums of products as data; the matrix is factored whole,
and the derivative of its log determinant and misfit, which the inverse gives, is written out.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.scipy.linalg import solve_triangular

from trustbo.inference.evidence.gaussian import Gaussian, joined_columns
from trustbo.models.effects.effect import Group, dense_root


class Entries(NamedTuple):
    """Entries of a sparse matrix, sorted by row."""

    row: np.ndarray
    column: np.ndarray
    value: np.ndarray

    @classmethod
    def of(cls, matrix) -> "Entries":
        """Entries of a sparse matrix of SciPy."""
        entries = matrix.tocsr().tocoo()
        return cls(entries.row, entries.col, entries.data)

    def times(self, x: Array, n_rows: int) -> Array:
        """Product with a vector."""
        terms = self.value * x[self.column]
        return jax.ops.segment_sum(terms, self.row, n_rows, indices_are_sorted=True)


class Sums(NamedTuple):
    """Data of the evidence: rates and products of columns, see `Gaussian`."""

    y: np.ndarray  # (chain, bound), 0 where not measured
    weight: np.ndarray  # (chain,)
    kind: np.ndarray  # (chain,)
    seen: np.ndarray  # (kind, bound)
    gram: Entries  # (entry, pair of bounds of a kind)
    entry: tuple[np.ndarray, np.ndarray]  # row and column of each entry
    columns: Entries  # (slot, column)
    transposed: Entries  # (column, slot)
    order: np.ndarray  # (column,), index among those of the groups

    @classmethod
    def of(cls, evidence: Gaussian) -> "Sums":
        """Data of an evidence."""
        row, column, G = evidence.gram()
        sizes = evidence.y, evidence.slots.weight, evidence.kind, evidence.seen
        U = Entries.of(evidence.U), Entries.of(evidence.U.T)
        return cls(*sizes, Entries.of(G), (row, column), *U, evidence.order)


class GaussianJax:
    """`Gaussian.log_density` at one theta, as a function of `Sums` that JAX compiles."""

    def __init__(self, evidence: Gaussian) -> None:
        """Take what shapes and priors depend on; the sums are an argument."""
        self.groups: Sequence[Group] = evidence.groups
        self.x0, self.level = evidence.x0, evidence.level
        place = np.argsort(evidence.order)
        self.joined = [
            slice(int(place[columns.start]), int(place[columns.stop - 1]) + 1)
            for columns in joined_columns(evidence.groups)
        ]

    def log_density(self, theta: Mapping[str, Array], sums: Sums) -> Array:
        """Log density of the rates; NaN where it is not finite.

        Args:
            theta: Hyperparameters, each (1,).
            sums: Data.
        """
        m, mean, sd, roots = len(sums.order), *self._prior(theta, sums.order)
        N, E, log_det = impulses(theta, self.x0[1], sums.seen)
        C = N if self.level else E
        S = jnp.swapaxes(C, 1, 2) @ C
        upper = S[:, *np.triu_indices(S.shape[1])].ravel()
        entries = sums.gram.times(upper, len(sums.entry[0]))
        A = jnp.zeros((m, m)).at[sums.entry].set(entries).at[sums.entry[::-1]].set(entries)
        weighted, misfit = self._residual(theta, sums, N, E, mean)
        h = sums.transposed.times(weighted, m)
        A, h = sd[:, None] * sd * A, sd * h
        for columns, root in zip(self.joined, roots, strict=True):
            A = A.at[columns].set(root.T @ A[columns])
            A = A.at[:, columns].set(A[:, columns] @ root)
            h = h.at[columns].set(root.T @ h[columns])
        rates = sums.weight @ sums.seen.sum(1)[sums.kind] * np.log(2.0 * np.pi)
        rates += sums.weight @ log_det[sums.kind]
        return -0.5 * (rates + minus_two_log(jnp.eye(m) + A, h) + misfit)

    def _prior(
        self, theta: Mapping[str, Array], order: np.ndarray
    ) -> tuple[Array, Array, list[Array]]:
        """Mean and sd (column,) of all columns in their order, and roots of those joined."""
        priors = [group.prior(theta) for group in self.groups]  # pyright: ignore
        mean, sd = (
            jnp.concatenate([jnp.asarray(getattr(prior, name))[0] for prior in priors])[order]
            for name in ("mean", "sd")
        )
        shared = {id(root): root for prior in priors for root in prior.roots}
        dense = {name: dense_root(root)[0] for name, root in shared.items()}
        return mean, sd, [dense[id(root)] for prior in priors for root in prior.roots]

    def _residual(
        self, theta: Mapping[str, Array], sums: Sums, N: Array, E: Array, mean: Array
    ) -> tuple[Array, Array]:
        """C'r (slot,) and r'r of the rates less their prior mean, weighted."""
        n_chains, K = sums.y.shape
        expected = sums.columns.times(mean, n_chains * K).reshape(n_chains, K)
        C, E = (N if self.level else E)[sums.kind], E[sums.kind]
        r = jnp.einsum("cij,cj->ci", E, sums.y) - jnp.einsum("cij,cj->ci", C, expected)
        if self.level:
            r -= theta["beta0"][0] * self.x0[0] * N[sums.kind][:, :, 0]
        weighted = sums.weight[:, None] * r
        return jnp.einsum("cij,ci->cj", C, weighted).ravel(), (weighted * r).sum()


def impulses(
    theta: Mapping[str, Array], x0_sd: float, seen: Array | np.ndarray
) -> tuple[Array, Array, Array]:
    """N and E (kind, bound, bound) and log |V| (kind,), see `gaussian.impulses`; theta (1,)."""
    core = jnp.stack([theta[name][0] for name in ("beta0", "delta_w", "delta_v")])
    return _impulses(core, x0_sd, jnp.asarray(seen))


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def _impulses(core: Array, x0_sd: float, seen: Array) -> tuple[Array, Array, Array]:
    b, Q, R = core[0], core[1] ** 2, core[2] ** 2
    n_kinds, K = seen.shape

    def step(carry, inputs):
        m, P = carry
        seen, impulse = inputs
        F, m = P + R, m + impulse
        left = jnp.where(seen, R / F, 1.0)
        row = m * jnp.where(seen, F**-0.5, 0.0)[:, None]
        out = row, jnp.where(seen, P / F, 0.0), jnp.where(seen, jnp.log(F), 0.0)
        return (m * (b * left)[:, None], b * b * P * left + Q), out

    start = jnp.zeros((n_kinds, K)), jnp.full(n_kinds, (b * x0_sd) ** 2 + Q)
    _, (rows, gain, log_F) = lax.scan(step, start, (seen.T, jnp.eye(K)))
    N, gain = jnp.swapaxes(rows, 0, 1), gain.T
    later = jnp.pad(-b * gain[:, None, :-1] * N[:, :, 1:], ((0, 0), (0, 0), (0, 1)))
    E = later + jnp.eye(K) * N
    return N, E, log_F.sum(0)


def _with_jacobian(core: Array, x0_sd: float, seen: Array) -> tuple[Any, Any]:
    """Impulses, and their derivatives: of three numbers, one scan has them, not one more back."""

    def twice(core: Array) -> tuple[Any, Any]:
        out = _impulses.fun(core, x0_sd, seen)
        return out, out

    jacobian, out = jax.jacfwd(twice, has_aux=True)(core)
    return out, jacobian


def _of_core(x0_sd: float, jacobian: Any, ahead: Any) -> tuple[Array, None]:
    terms = [jnp.tensordot(a, J, a.ndim) for a, J in zip(ahead, jacobian, strict=True)]
    return sum(terms[1:], terms[0]), None


_impulses.defvjp(_with_jacobian, _of_core)


@jax.custom_vjp
def minus_two_log(P: Array, h: Array) -> Array:
    """Log |P| - h' P^-1 h of a positive definite P, NaN of others."""
    return _factored(P, h)[0]


def _factored(P: Array, h: Array) -> tuple[Array, tuple[Array, Array]]:
    F = jnp.linalg.cholesky(P, symmetrize_input=False)
    e = solve_triangular(F, h, lower=True)
    return 2.0 * jnp.log(jnp.diagonal(F)).sum() - e @ e, (F, e)


def _slope(kept: tuple[Array, Array], ahead: Array) -> tuple[Array, Array]:
    F, e = kept
    inverse = solve_triangular(F, jnp.eye(len(e)), lower=True)
    x = e @ inverse
    return ahead * (inverse.T @ inverse + jnp.outer(x, x)), -2.0 * ahead * x


minus_two_log.defvjp(_factored, _slope)
