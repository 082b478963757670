"""Scan over columns: sums of columns, their atoms, and quadratic forms of them.

Columns come in runs, and a candidate is the sum of a column and all later ones of its run, the
change "from mission j on" of a column for each mission. Sums are carried from the last column of a
run to its first, so that a candidate costs the entries of one column.

Columns of areas overlap: bounds of a mission that the same areas hold are one atom, and columns are
sums of few atoms. What needs a triangular solve is done once for each atom.
"""

from typing import NamedTuple

import numba as nb
import numpy as np
from scipy import sparse

from trustbo.models.effects.effect import Columns
from trustbo.models.effects.fingerprint import fingerprints

_compiled = nb.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})


Compressed = tuple[np.ndarray, np.ndarray, np.ndarray]
"""First entry of each column, row and value of each entry."""


class Sums(NamedTuple):
    """Columns as sums of atoms."""

    slots: Compressed
    atoms: Columns  # (slot, atom)
    of_atoms: Compressed

    @classmethod
    def of(cls, columns: Columns) -> "Sums":
        """Atoms of columns (slot, column): a column is one itself, unless it is an indicator."""
        columns.sort_indices()
        size, (n_slots, n_columns) = np.diff(columns.indptr), columns.shape
        other = np.bincount(np.repeat(np.arange(n_columns), size), columns.data != 1.0, n_columns)
        whole = np.flatnonzero(other)
        held: Columns = sparse.csr_array(columns @ sparse.diags_array(1.0 * (other == 0)))
        held.eliminate_zeros()
        slots = np.flatnonzero(np.diff(held.indptr))
        keys = fingerprints(held)[slots]
        _, first, atom = np.unique(keys, return_index=True, return_inverse=True)
        shape = n_slots, len(first)
        indicators = sparse.csr_array((np.ones(len(slots)), (slots, atom.ravel())), shape=shape)
        identity = np.ones(len(whole)), (np.arange(len(whole)), whole)
        of_whole = sparse.csr_array(identity, shape=(len(whole), n_columns))
        of_atoms: Columns = sparse.vstack([of_whole, held[slots[first]]], format="csc")
        atoms = sparse.hstack([columns[:, whole], indicators], format="csr")
        return cls(_compressed(columns), atoms, _compressed(of_atoms))


def _compressed(columns: Columns) -> Compressed:
    return columns.indptr, columns.indices, columns.data


@_compiled
def take_projections(a, b, T, right, start, atom, value, run) -> None:
    """Subtract |T'z|^2 from `a` and right'T'z from `b`, both (column,), for each candidate z.

    T (atom, factor) and right (factor,); the entries of columns are compressed by column.
    """
    total, m = np.zeros(T.shape[1]), T.shape[1]
    for i in range(len(run) - 1, -1, -1):
        if i == len(run) - 1 or run[i] != run[i + 1]:
            total[:] = 0.0
        for entry in range(start[i], start[i + 1]):
            x, row = value[entry], T[atom[entry]]
            for f in range(m):
                total[f] += x * row[f]
        square = linear = 0.0
        for f in range(m):
            square += total[f] * total[f]
            linear += total[f] * right[f]
        a[i] -= square
        b[i] -= linear


@_compiled
def weigh_chains(a, b, S, kind, weight, residual, start, slot, value, run) -> None:
    """Set `a` to z'S z and `b` to z'residual, both (column,), for each candidate z.

    S (kind, bound, bound) is block diagonal by chain, of kind (chain,) and weight (chain,); slots
    of a column are in order, and no two columns of a run share a chain.
    """
    K = S.shape[1]
    square = linear = 0.0
    for i in range(len(run) - 1, -1, -1):
        if i == len(run) - 1 or run[i] != run[i + 1]:
            square = linear = 0.0
        for entry in range(start[i], start[i + 1]):
            chain, k = divmod(slot[entry], K)
            linear += value[entry] * residual[slot[entry]]
            row = value[entry] ** 2 * S[kind[chain], k, k]
            for other in range(entry + 1, start[i + 1]):
                if slot[other] // K != chain:
                    break
                row += 2.0 * value[entry] * value[other] * S[kind[chain], k, slot[other] % K]
            square += weight[chain] * row
        a[i], b[i] = square, linear
