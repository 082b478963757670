"""The reference of every search for a path: all admissible paths, and their values, one by one.

Nothing of the package is imported. `peers.every_path` of the benchmarks enumerates problems that
are too large for this, all walks of one length at once.
"""

import numpy as np
from dense_families import expected_rate
from dense_statespace import STEPS, trust_of_params
from scipy.special import expit


def every_path(bounds, start, goal, longest, *, u_turns):
    """All paths of at most `longest` bounds that reach the goal once, at their end.

    Args:
        bounds: Mask (move, row, col) of the moves by which a cell may be entered.
        start: First cell.
        goal: Last cell.
        longest: Largest number of bounds.
        u_turns: Whether a bound may reverse the one before it.
    """
    found = []

    def extend(path):
        if path[-1] == goal:
            found.append(tuple(path))
            return
        if len(path) > longest:
            return
        for move, (down, right) in enumerate(STEPS):
            cell = path[-1][0] + down, path[-1][1] + right
            inside = all(0 <= i < n for i, n in zip(cell, bounds.shape[1:], strict=True))
            if not inside or not bounds[move, *cell]:
                continue
            if u_turns or len(path) == 1 or cell != path[-2]:
                extend([*path, cell])

    extend([start])
    return found


def paths_of(planner, goal=None, *, longest=None):
    """All admissible paths of a planner, whose settings are read, or to another cell."""
    paths = planner.problem.paths
    longest = paths.longest if longest is None else longest
    bounds = np.asarray(paths.bounds)
    return every_path(bounds, paths.start, goal or paths.goal, longest, u_turns=paths.turns)


def value_of(params, workspace, path, objective, family, noise_sd, x0=None):
    """Value of a path under one draw of parameters, without costs of bounds and failures.

    `noise_sd` is the mean over robots of the standard deviation of a rate given trust.
    """
    trust = trust_of_params(params, workspace.along(path), path, x0=x0).mean(1)
    if objective == "terminal":
        return expit(trust[-1])
    if objective == "mean":
        return trust.mean()
    return (expected_rate(family, trust, noise_sd) - 1.0).sum()
