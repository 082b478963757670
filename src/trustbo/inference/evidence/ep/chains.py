"""Rates of missions as the chains that expectation propagation runs on."""

import numpy as np

from trustbo.inference.evidence.ep.joint import Chains
from trustbo.models.families import Family
from trustbo.models.families.terms import AT_ONE, GAUSSIAN, count_tables
from trustbo.parallel import plain
from trustbo.stacking import MissionBatch


def gather_chains(
    family: Family,
    batch: MissionBatch,
    *,
    whole: np.ndarray | None = None,
    apart: bool = False,
) -> tuple[Chains, np.ndarray]:
    """Chains of a batch, and the sites to begin with, (2, chain, bound).

    Args:
        family: Family of observations.
        batch: Missions, padded with NaN.
        whole: Bounds of each mission, (mission,): chains have these lengths, and those without a
            rate are kept; by default they end at their last rate.
        apart: Whether each robot has separate beta0, weights and intercept.

    Returns:
        Chains whose gamma is (weights, intercept), where robots are apart of one after the other.
    """
    n_robots = batch.contact_rate.shape[2]
    # One row per mission and robot: (chain, bound[, column]).
    y = np.swapaxes(batch.contact_rate, 1, 2).reshape(-1, batch.contact_rate.shape[1])
    n_ticks = np.swapaxes(np.broadcast_to(batch.n_ticks, batch.contact_rate.shape), 1, 2)
    z = np.swapaxes(batch.awareness, 1, 2).reshape(*y.shape, -1)
    u = np.concatenate([z, np.ones_like(z[..., :1])], axis=-1)
    seen = ~np.isnan(y)
    kept = np.flatnonzero(seen.any(1)) if whole is None else np.arange(len(y))
    robot = kept % n_robots if apart else np.zeros(len(kept), dtype=int)
    column = plain(u.shape[-1] * robot[:, None] + np.arange(u.shape[-1]))
    drift = u[kept]
    length = y.shape[1] - np.argmax(seen[kept][:, ::-1], axis=1)
    if whole is not None:
        length = np.repeat(whole, n_robots)
    terms = family.terms(y[kept], n_ticks.reshape(y.shape)[kept])
    gaussian, late = terms.kind == GAUSSIAN, terms.kind >= AT_ONE
    chains = Chains(
        np.where(seen[kept], y[kept], 0.0),
        terms.kind,
        terms.case,
        np.ascontiguousarray(drift),
        np.ascontiguousarray(column),
        robot,
        length,
        np.where(late.any(1), np.argmax(late, axis=1), length),
        np.stack([gaussian.sum(1), (np.where(gaussian, y[kept], 0.0) ** 2).sum(1)], axis=1),
        np.zeros((len(kept), y.shape[1])),
        terms.counts,
        count_tables(terms.counts),
    )
    return chains, np.stack([terms.lam, terms.eta])
