"""Which measure of tilt separates the bounds that fail?

    python benchmarks/failures.py --data DIR

In the worlds whose slope limit is 2 degrees too high, all bounds with all next moves are simulated.
The table shows the area under the ROC curve of several measures of tilt: 1 if a threshold separates
the bounds that fail from the others, and 0.5 if the tilt contains no information.
"""

import dataclasses
import warnings

import numpy as np
from common import Table, arguments, parsed
from world_set import available

from trustbo.simulation.replicates import replicated
from trustbo.workspace.difficulty import MEASURES
from trustbo.workspace.moves import END, MOVES

LOOKAHEADS = (0.5, 3.0)
"""True look-aheads, m, of robots for which 1.5 m is assumed."""


def print_separation(given):
    """Print the area under the ROC curve of the predicted tilt as a sign of failure, by world.

    The tilt is that of the route or of the driven curve, with the true next move or with one in the
    same direction. An area of .5 means that it says nothing about failures.
    """
    chosen = [w for w in available(given.data).values() if w.case == "limit-2"]
    columns = ["route, straight on", "route", "curve, straight on", "curve"]
    others = [f"curve, {ahead:g} m" for ahead in LOOKAHEADS]
    table = Table("world", "passed", *columns, *others, name="tilt")
    areas = []
    for world in chosen[: 1 if given.quick else None]:
        simulator = world.simulator(world.workspace())
        passed = share_passed(simulator)
        curve = simulator.workspace.difficulty.whole().values[..., MEASURES.index("tilt")]
        route = route_tilts(simulator.workspace, np.isfinite(passed))
        of_world = [
            area_under(tilt, passed)
            for tilt in (straight_on(route), route, straight_on(curve), curve)
        ]
        for ahead in LOOKAHEADS:
            team = world.team
            robot = dataclasses.replace(team.lead, lookahead=ahead)
            other = dataclasses.replace(team, lead=robot, robots=(robot,) * team.n_robots)
            simulator = dataclasses.replace(world, team=other).simulator(simulator.workspace)
            of_world.append(area_under(curve, share_passed(simulator)))
        areas.append(of_world)
        table.row(world.name, f"{np.nanmean(passed):.3f}", *(f"{a:.3f}" for a in of_world))
    table.row("mean", "", *(f"{a:.3f}" for a in np.mean(areas, axis=0)))


def share_passed(simulator, n=4):
    """Simulate all bounds; return the share that passed, (move, row, col, next_move)."""
    return replicated(simulator, 0, n, seed=5)["passed"].values


def straight_on(tilt):
    """Give all next moves of a bound the tilt of the one in the same direction, or of the end."""
    same = np.stack([tilt[m, ..., m] for m in range(len(MOVES))])
    same = np.where(np.isfinite(same), same, tilt[..., END])
    return np.broadcast_to(same[..., None], tilt.shape)


def route_tilts(workspace, exists):
    """Compute the largest tilt on the robots' routes, averaged over 1 m."""
    posts = workspace.posts
    tilts, known = np.full(exists.shape, np.nan), {}
    for m, row, col, after in np.argwhere(exists).tolist():
        cell, left = (row, col), (row - MOVES[m][0], col - MOVES[m][1])
        ahead = None if after == END else (row + MOVES[after][0], col + MOVES[after][1])
        worst = 0.0
        for route in posts.bound_routes(left, cell, ahead):
            key = route.tobytes()
            if key not in known:
                known[key] = route_tilt(posts.surface, route)
            worst = max(worst, known[key])
        tilts[m, row, col, after] = worst
    return tilts


def route_tilt(surface, route, step=0.25, ahead=1.5, n=4):
    """Largest tangent of pitch or roll on one route, if the robot faces a point 1.5 m ahead."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))])
    s = np.arange(0.0, along[-1] + 1e-9, step)
    here, there = (
        np.stack([np.interp(at, along, axis) for axis in route.T]) for at in (s, s + ahead)
    )
    heading = np.arctan2(*(there - here)[::-1])
    east, north = np.cos(heading), np.sin(heading)
    gx, gy = surface.gradient[:, *surface.nearest(*here)]
    tilt = np.maximum(np.abs(gx * east + gy * north), np.abs(gy * east - gx * north))
    n = min(n, len(tilt))
    return np.convolve(tilt, np.full(n, 1.0 / n), mode="valid").max()


def area_under(tilt, passed):
    """Probability that a bound that failed has a larger tilt than one that passed."""
    known = np.isfinite(tilt) & np.isfinite(passed)
    values, index = np.unique(tilt[known], return_inverse=True)
    share = passed[known]
    fails, passes = (np.bincount(index, w, len(values)) for w in (1.0 - share, share))
    below = np.cumsum(passes) - 0.5 * passes
    return float(fails @ below / (fails.sum() * passes.sum()))


def main():
    given = parsed(arguments(__doc__, data=True, quick="one world"))
    warnings.simplefilter("ignore")
    print_separation(given)


if __name__ == "__main__":
    main()
