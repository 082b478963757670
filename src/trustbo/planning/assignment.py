"""Assignment of robots that differ to the posts along a path.

A state of bound k is who stands where, an ordered choice s of as many of its posts as there are
robots. In the bound, robot i sees and is seen in a share of the time (see `line_of_sight`)

    los_i(s, s') = (T_1 watched_i(s_i) + t_i closing_i(s_i, s'_i) + (T_2 - t_i) waiting_i(s'_i))
                   / (T_1 + T_2),

t_i the time of its way and T_2 = max_i t_i. Of what it could see it has the share w_i in contact,
so that the contact lost is mean_i 1 - w_i los_i: a poor watcher gets the post that matters least.
Its sum over the bounds is least by dynamic programming over k, exactly.
"""

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from trustbo.data import Cell
from trustbo.workspace import Workspace
from trustbo.workspace.watch import Watch

MAX_ROBOTS = 4
"""Teams of more are not assigned: states are ordered choices, too many of them."""
DIFFERENT = 0.1
"""Difference of the weights of two robots from which on they are assigned."""


def robots_along(
    workspace: Workspace, path: tuple[Cell, ...], trust: np.ndarray
) -> np.ndarray | None:
    """Post of each robot in each bound of a path, (bound, robot), see `Plan.robots`.

    Weights are the contact expected of a robot, `trust` (bound, robot), as a share of its line of
    sight from the workspace's posts, the best robot's being 1.
    """
    team, table = workspace.team, workspace.watch
    if table is None or workspace.of_bounds is None or not 1 < team.n_robots <= MAX_ROBOTS:
        return None
    sight = workspace.along(path)[..., -len(workspace.sights)].sum(0)
    weights = np.clip(trust, 0.0, 1.0).sum(0) / np.maximum(sight, 1e-6)
    weights = weights / weights.max(initial=1e-6)
    if len(set(team.robots)) == 1 and weights.min() >= 1.0 - DIFFERENT:
        return None
    return assign(table.along(path)[1], weights)[0]


def assign(watches: Sequence[Watch], weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Assign robots to posts along a path.

    Args:
        watches: Sight in each bound, see `WatchTable.along`.
        weights: Share of what it could see that a robot has in contact, (robot,).

    Returns:
        Post of each robot in each bound, (bound, robot), an index into its posts; and the contact
        expected to be lost, in bounds.
    """
    n_robots = len(weights)
    states = [_choices(watch.watched.shape[1], n_robots) for watch in watches]
    states.append(np.arange(n_robots)[None])  # around the goal, by the rule
    loss = np.zeros(1)
    onward: list[np.ndarray] = []
    for k in range(len(watches) - 1, -1, -1):
        total = lost_contact(watches[k], states[k], states[k + 1], weights) + loss
        onward.append(np.argmin(total, axis=1))
        loss = np.take_along_axis(total, onward[-1][:, None], 1)[:, 0]
    at = int(np.argmin(loss))
    least, chosen = float(loss[at]), []
    for k, best in enumerate(reversed(onward)):
        chosen.append(states[k][at])
        at = int(best[at])
    return np.array(chosen), least


def lost_contact(
    watch: Watch, states: np.ndarray, after: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Contact lost in a bound from each state to each, (state, next state), in bounds.

    Args:
        watch: Sight in the bound.
        states: Post of each robot, (state, robot).
        after: Post of each robot in the next bound, (next state, robot).
        weights: See `assign`.
    """
    i, s, then = np.arange(len(weights)), states[:, None], after[None]
    times = watch.times[i, s, then]
    slowest = times.max(-1, keepdims=True)
    seen = watch.lead_time * watch.watched[i, s] + times * watch.closing[i, s, then]
    seen = seen + (slowest - times) * watch.waiting[i, then]
    return 1.0 - (weights * seen / (watch.lead_time + slowest)).mean(-1)


def _choices(n_posts: int, n_robots: int) -> np.ndarray:
    return np.array(list(permutations(range(n_posts), n_robots)))
