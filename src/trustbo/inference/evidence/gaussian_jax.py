"""The evidence of Gaussian rates in JAX, at one theta and differentiable, for NUTS.

The steps are those of `gaussian`, with two differences. Rates and trust before the first bound are
further columns, so that the rates less their mean are C times columns times loadings, and sums of
products of columns are all that the density takes: its cost does not depend on the number of
missions. And the matrix is factored whole; the derivative of its log determinant and misfit, which
the inverse gives, is written out.

Sums and numbers of priors are data of the compiled code, and bounds and kinds of chains are padded:
where no effect is of missions or places, the next mission meets the same program.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from scipy import sparse

from trustbo.inference.evidence.gaussian import Gaussian, joined_columns
from trustbo.models.effects.effect import Columns, Group, dense_root

_SPARSE = 10  # numbers of a matrix for each that is not 0, from which on its product is sparse
_BOUNDS = 2  # bounds are padded to a multiple


class Entries(NamedTuple):
    """Entries of a sparse matrix, sorted by row."""

    row: np.ndarray
    column: np.ndarray
    value: np.ndarray

    def times(self, x: Array, n_rows: int) -> Array:
        """Product with a vector."""
        terms = self.value * x[self.column]
        return jax.ops.segment_sum(terms, self.row, n_rows, indices_are_sorted=True)


class Sums(NamedTuple):
    """Sums of products of columns and rates, and numbers that go with them, see `Gaussian`."""

    seen: np.ndarray  # (kind, bound)
    robot: np.ndarray  # (kind,), index of its memory
    mass: np.ndarray  # (kind,)
    n_measured: float
    gram: Entries | np.ndarray  # (entry, pair of bounds of a kind)
    entry: tuple[np.ndarray, np.ndarray]  # row and column of each entry
    order: np.ndarray  # (column,), index among those of the groups
    x0: tuple[float, float]

    @classmethod
    def of(cls, evidence: Gaussian) -> Self:
        """Sums of an evidence."""
        n_kinds, K = evidence.seen.shape
        more = (1 << (n_kinds - 1).bit_length()) - n_kinds, -K % _BOUNDS
        *entry, G = evidence.gram(_columns_of_rates(evidence))
        products, size = G.tocoo(), K + more[1]
        q, pair = np.divmod(products.col, K * (K + 1) // 2)
        i, j = (index[pair] for index in np.triu_indices(K))
        n_pairs = size * (size + 1) // 2
        column = q * n_pairs + i * size - i * (i - 1) // 2 + j - i
        shape = len(entry[0]), n_pairs * (n_kinds + more[0])
        gram: Columns = sparse.csr_array((products.data, (products.row, column)), shape=shape)
        entries = gram.tocoo()
        dense = np.prod(shape) < _SPARSE * gram.nnz
        kinds = (0, more[0])
        return cls(
            np.pad(evidence.seen, (kinds, (0, more[1]))),
            np.pad(evidence.robot, kinds),
            np.pad(evidence.mass, kinds),
            evidence.n_measured,
            gram.toarray() if dense else Entries(entries.row, entries.col, entries.data),
            (entry[0], entry[1]),
            evidence.order,
            evidence.x0,
        )


def _columns_of_rates(evidence: Gaussian) -> Columns:
    """Further columns (slot, column): of rates, and where trust is carried on, of those before.

    With E of `gaussian`, E y = C (y - beta0 y_before). The third column is of trust before the
    first bound. Each is one for every robot with a separate memory.
    """
    y, columns = evidence.y, [evidence.y]
    if evidence.level:
        first = np.zeros(y.shape)
        first[:, 0] = 1.0
        columns = [y, np.pad(y, ((0, 0), (1, 0)))[:, :-1], first]
    apart = evidence.robot[evidence.kind][:, None] == np.arange(evidence.robot.max() + 1)
    values = np.stack(columns, axis=2)[..., None] * apart[:, None, None]
    return sparse.csr_array(values.reshape(y.size, -1))


class _Size(NamedTuple):
    """Number of columns of a matrix, all that the prior of a group may need of it."""

    shape: tuple[int, int]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GaussianJax:
    """`Gaussian.log_density` at one theta, as an argument of compiled code.

    The groups are split: their arrays are data, and all else is compiled in.
    """

    sums: Sums
    arrays: tuple[Any, ...]
    others: tuple[Any, ...] = field(metadata={"static": True})
    joined: tuple[slice, ...] = field(metadata={"static": True})
    level: bool = field(metadata={"static": True})

    @classmethod
    def of(cls, evidence: Gaussian) -> Self:
        """Take the sums and the groups of an evidence."""
        place = np.argsort(evidence.order)
        joined = [
            slice(int(place[columns.start]), int(place[columns.stop - 1]) + 1)
            for columns in joined_columns(evidence.groups)
        ]
        leaves, tree = jax.tree.flatten(list(evidence.groups))
        leaves = [_Size((0, x.shape[1])) if sparse.issparse(x) else x for x in leaves]
        is_array = [isinstance(leaf, np.ndarray) for leaf in leaves]
        arrays = tuple(x for x, data in zip(leaves, is_array, strict=True) if data)
        others = tuple(None if data else x for x, data in zip(leaves, is_array, strict=True))
        return cls(Sums.of(evidence), arrays, (tree, others), tuple(joined), evidence.level)

    @property
    def groups(self) -> list[Group]:
        """Columns of all effects."""
        (tree, others), arrays = self.others, iter(self.arrays)
        return jax.tree.unflatten(tree, [next(arrays) if x is None else x for x in others])

    def log_density(self, theta: Mapping[str, Array]) -> Array:
        """Log density of the rates; NaN where it is not finite.

        Args:
            theta: Hyperparameters, each (1, ...).
        """
        sums, m = self.sums, len(self.sums.order)
        mean, sd, roots = self._prior(theta)
        beta0 = theta["beta0"].reshape(-1)
        C, log_det = impulses(theta, sums, level=self.level)
        S = jnp.swapaxes(C, 1, 2) @ C
        upper = S[:, *np.triu_indices(S.shape[1])].ravel()
        (row, column), G = sums.entry, sums.gram
        entries = G.times(upper, len(row)) if isinstance(G, Entries) else jnp.dot(G, upper)
        loadings = [jnp.ones_like(beta0)]
        if self.level:
            loadings += [-beta0, -beta0 * sums.x0[0]]
        loadings = jnp.concatenate([-mean, *loadings])
        P = jnp.zeros((len(loadings), len(loadings)))
        P = P.at[row, column].set(entries).at[column, row].set(entries)
        of_rates = P @ loadings
        A, h = sd[:, None] * sd * P[:m, :m], sd * of_rates[:m]
        for columns, root in zip(self.joined, roots, strict=True):
            A = A.at[columns].set(root.T @ A[columns])
            A = A.at[:, columns].set(A[:, columns] @ root)
            h = h.at[columns].set(root.T @ h[columns])
        value = minus_two_log(jnp.eye(m) + A, h) + loadings @ of_rates + sums.mass @ log_det
        return -0.5 * (value + sums.n_measured * np.log(2.0 * np.pi))

    def _prior(self, theta: Mapping[str, Array]) -> tuple[Array, Array, list[Array]]:
        """Mean and sd (column,) of all columns in their order, and roots of those joined."""
        priors = [group.prior(theta) for group in self.groups]  # pyright: ignore
        mean, sd = (
            jnp.concatenate([jnp.asarray(getattr(prior, name))[0] for prior in priors])
            for name in ("mean", "sd")
        )
        shared = {id(root): root for prior in priors for root in prior.roots}
        dense = {name: dense_root(root)[0] for name, root in shared.items()}
        roots = [dense[id(root)] for prior in priors for root in prior.roots]
        return mean[self.sums.order], sd[self.sums.order], roots


def impulses(theta: Mapping[str, Array], sums: Sums, *, level: bool) -> tuple[Array, Array]:
    """C (kind, bound, bound) and log |V| (kind,), see `gaussian`; C is N, or E if not `level`."""
    memory = theta["beta0"].reshape(-1)[sums.robot]
    noises = (jnp.broadcast_to(theta[name], memory.shape) for name in ("delta_w", "delta_v"))
    core = jnp.stack([memory, *noises], axis=1)
    whitened = _level_impulses if level else _deviation_impulses
    return jax.vmap(whitened, in_axes=(0, None, 0))(core, sums.x0[1], sums.seen)


def _filtered(core: Array, x0_sd: Array, seen: Array) -> tuple[Array, Array, Array]:
    """N (bound, bound), the gains (bound,) and log |V| of a kind, as `gaussian` has them."""
    b, Q, R = core[0], core[1] ** 2, core[2] ** 2

    def step(carry, inputs):
        m, P = carry
        seen, impulse = inputs
        F, m = P + R, m + impulse
        left, gain = jnp.where(seen, R / F, 1.0), jnp.where(seen, P / F, 0.0)
        row = m * jnp.where(seen, F**-0.5, 0.0)
        return (m * (b * left), b * b * (P * left) + Q), (
            row, gain, jnp.where(seen, jnp.log(F), 0.0)
        )  # fmt: skip

    K = len(seen)
    start = jnp.zeros(K), b * b * (x0_sd**2 + 0.0 * b) + Q
    _, (N, gain, log_F) = lax.scan(step, start, (seen, jnp.eye(K)))
    return N, gain, log_F.sum()


def _level(core: Array, x0_sd: Array, seen: Array) -> tuple[Array, Array]:
    N, _, log_det = _filtered(core, x0_sd, seen)
    return N, log_det


def _deviation(core: Array, x0_sd: Array, seen: Array) -> tuple[Array, Array]:
    N, gain, log_det = _filtered(core, x0_sd, seen)
    later = jnp.pad(-core[0] * gain[None, :-1] * N[:, 1:], ((0, 0), (0, 1)))
    return later + jnp.eye(len(N)) * N, log_det


def _by_jacobian(function: Any) -> Any:
    """A function of three numbers and constants, differentiated forward: no scan goes back."""

    def forward(core: Array, *constants: Array) -> tuple[Any, Any]:
        def twice(core: Array) -> tuple[Any, Any]:
            out = function(core, *constants)
            return out, out

        jacobian, out = jax.jacfwd(twice, has_aux=True)(core)
        return out, (jacobian, constants)

    def backward(kept: tuple[Any, Any], ahead: Any) -> tuple[Any, ...]:
        jacobian, constants = kept
        terms = [jnp.tensordot(a, J, a.ndim) for a, J in zip(ahead, jacobian, strict=True)]
        return sum(terms[1:], terms[0]), *(None for _ in constants)

    primitive = jax.custom_vjp(function)
    primitive.defvjp(forward, backward)
    return primitive


_level_impulses, _deviation_impulses = _by_jacobian(_level), _by_jacobian(_deviation)


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
