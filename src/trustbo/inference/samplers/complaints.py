"""Failed diagnostics of draws: limits exceeded, and modes missed."""

from collections.abc import Mapping

import arviz_base
import numpy as np
from arviz_stats import sampling_diagnostics

from trustbo.inference.samplers.convergence import MAX_RHAT, MIN_ESS, convergence
from trustbo.inference.samplers.modes import visits
from trustbo.inference.samplers.nuts import NutsDraws

_VISITED = 0.1  # of the draws that a mode's mass promises; Laplace's masses are rough
_MAX_SHARE_ERROR = 0.015  # Monte Carlo error of a mode's share of the draws


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


def complaints_of_modes(raw: NutsDraws) -> list[str]:
    """Modes that no chain visited, or whose share of the draws has not converged; empty if none."""
    complaints, around = [], visits(raw.modes, np.asarray(raw.theta))
    if len(around) == 1:
        return complaints
    shares = arviz_base.from_dict({"posterior": {str(i): mask * 1.0 for i, mask in around.items()}})
    error = sampling_diagnostics.mcse(shares["posterior"].to_dataset())
    for i, mask in around.items():
        mass, share = float(raw.modes.share[i]), mask.mean()
        mode = f"the mode where {_telling(raw, i)}"
        if share < _VISITED * mass:
            complaints.append(
                f"{share:.1%} of the draws are around {mode}, of some {mass:.0%} mass"
            )
        elif not error[str(i)] <= _MAX_SHARE_ERROR:
            complaints.append(
                f"the share of {mode} is {share:.2f} +- {float(error[str(i)]):.3f} (limit "
                f"{_MAX_SHARE_ERROR})"
            )
    return complaints


def _telling(raw: NutsDraws, i: int) -> str:
    """Parameter that best separates a mode from the largest other, and its value there."""
    gaps, other = [], int(np.argmax(np.delete(raw.modes.share, i)))
    other += other >= i
    for name, values in raw.params.items():
        at_modes = np.asarray(raw.params_at_modes[name])
        gap = np.abs(at_modes[i] - at_modes[other]) / np.maximum(np.std(values, (0, 1)), 1e-12)
        place = np.unravel_index(gap.argmax(), gap.shape)
        index = f"[{', '.join(map(str, place))}]" if place else ""
        gaps.append((gap[place], f"{name}{index} is {at_modes[i][place]:.3g}"))
    return max(gaps)[1]
