"""Sufficient statistics of missions under a model whose coefficients and trust integrate out."""

import numpy as np

from trustbo.inference.evidence.gram import Statistics, sufficient_statistics
from trustbo.models.model import TrustModel
from trustbo.stacking import MissionBatch


def gather(model: TrustModel, batch: MissionBatch, weight: np.ndarray | None = None) -> Statistics:
    """Compute sufficient statistics of a batch, each mission weighted.

    Args:
        model: Trust model.
        batch: Missions, padded.
        weight: Weight of each mission, shape (mission,); 1 by default.

    Returns:
        Statistics of all robots together, or of each where they have nothing in common.
    """
    args = (model.priors.x0_mean, weight)
    return tuple(sufficient_statistics(one, *args) for one in split_robots(model, batch))


def split_robots(model: TrustModel, batch: MissionBatch) -> list[MissionBatch]:
    """Split missions by robot where robots have nothing in common; else leave them together."""
    if model.robot_sets != "each":
        return [batch]
    n_robots = batch.contact_rate.shape[2]
    return [MissionBatch(*(a[:, :, i : i + 1] for a in batch)) for i in range(n_robots)]
