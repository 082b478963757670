"""Failed diagnostics of draws: limits exceeded, and means that importance sampling denies."""

from collections.abc import Mapping

import arviz_base
import numpy as np

from trustbo.inference.samplers.convergence import MAX_RHAT, MIN_ESS, convergence


def complaints_of(params: Mapping[str, np.ndarray], stats: Mapping[str, np.ndarray]) -> list[str]:
    """Limits exceeded by the draws, parameter by parameter; empty if none."""
    sites = arviz_base.from_dict({"posterior": params})["posterior"].to_dataset()
    complaints = []
    for name, (worst, fewest) in convergence(sites).items():
        if not worst <= MAX_RHAT:  # NaN is a complaint too
            complaints.append(f"R-hat of {name} is {worst:.3f} (limit {MAX_RHAT})")
        if not fewest >= MIN_ESS:
            complaints.append(f"bulk ESS of {name} is {fewest:.0f} (at least {MIN_ESS:.0f})")
    n_divergences = int(stats["diverging"].sum())
    if n_divergences:
        complaints.append(f"{n_divergences} divergences")
    return complaints


def complaints_of_means(
    params: Mapping[str, np.ndarray],
    at_points: Mapping[str, np.ndarray],
    weight: np.ndarray,
    limit: float = 0.3,
) -> list[str]:
    """Parameters whose mean is far from that of weighted points; empty if there are none.

    Chains that start at different modes and do not meet have a large R-hat. It does not detect a
    mode that all chains left in their warm-up; the points, half of which are spread wide, do.

    Args:
        params: Draws, each (chain, draw, ...).
        at_points: Parameters at weighted points, each (point, ...), by the same names.
        weight: Weight of each point, sum 1.
        limit: Largest distance, in sd; points of an effective number of 200 have an error of .07.
    """
    complaints = []
    for name, values in at_points.items():
        mean = np.tensordot(weight, values, 1)
        sd = np.sqrt(np.tensordot(weight, (values - mean) ** 2, 1))
        off = np.max(np.abs(params[name].mean((0, 1)) - mean) / np.maximum(sd, 1e-12))
        if not off <= limit:
            complaints.append(
                f"the mean of {name} is {off:.2f} sd from that of importance sampling "
                f"(limit {limit})"
            )
    return complaints
