"""Rates of missions as the chains that expectation propagation runs on."""

import numpy as np

from trustbo.inference.evidence.ep.joint import Chains
from trustbo.models.families import Family
from trustbo.models.families.terms import AT_ONE, GAUSSIAN, count_tables


def chains_of(
    family: Family,
    y: np.ndarray,
    n_ticks: np.ndarray,
    u: np.ndarray,
    column: np.ndarray,
    length: np.ndarray | None = None,
) -> tuple[Chains, np.ndarray]:
    """Chains of rates, of robots that share beta0, and the sites to begin with, (2, chain, bound).

    Args:
        family: Family of observations.
        y: Rates (chain, bound), NaN where not measured.
        n_ticks: Ticks of that shape.
        u: Drift that each of a chain's coefficients gives, (chain, bound, column).
        column: Indices of these coefficients, (chain, column).
        length: Bounds of each chain; by default up to its last rate.
    """
    terms, seen = family.terms(y, n_ticks), ~np.isnan(y)
    gaussian, late = terms.kind == GAUSSIAN, terms.kind >= AT_ONE
    rates = np.where(seen, y, 0.0)
    ends = y.shape[1] - np.argmax(seen[:, ::-1], axis=1) if length is None else length
    chains = Chains(
        rates,
        terms.kind,
        terms.case,
        np.ascontiguousarray(u),
        np.ascontiguousarray(column),
        np.zeros(len(y), dtype=int),
        ends,
        np.where(late.any(1), np.argmax(late, axis=1), ends),
        np.stack([gaussian.sum(1), (np.where(gaussian, rates, 0.0) ** 2).sum(1)], axis=1),
        np.zeros(y.shape),
        terms.counts,
        count_tables(terms.counts),
        0.0,
    )
    return chains, np.stack([terms.lam, terms.eta])
