"""Which score of posts predicts the contact that they give?

    python benchmarks/overwatch.py --data DIR [--quick] [--csv FILE]

In random bounds of each world, T2 watches from each set of posts. Two scores predict the contact:
the score by which posts are chosen, which doubts the map (`workspace.posts`), and the feature
line_of_sight, from which models learn. The contact of a set is the mean over replicates in the true
world; all sets of a bound share the random numbers, and T2 closes up to the same places.

The table compares the contact lost in a bound, as a share of that of the standard set, if the set
is chosen at random, by each of the two scores, or in hindsight, and Spearman's correlation of each
score with contact over the sets of a bound. Intervals are those of a t test clustered by
terrain.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from groups import ALIKE, interval, over_worlds
from scipy.stats import rankdata
from world_set import World, available

from trustbo.data import POST_SETS, Cell
from trustbo.simulation import KinematicSimulator
from trustbo.workspace import MOVES, Workspace
from trustbo.workspace.posts import SETS

KINDS = ("right", "bare", "slopes", "aged", "canopy", "shapes", "teams", "jammer")
"""Kinds of worlds that are compared: maps that are right, that are wrong, and jammers."""
N_BOUNDS = 150
"""Number of bounds of a world."""
N_REPLICATES = 2
LEAST = 0.002
"""Contact lost in a bound that is added to both sides of a ratio."""


def main() -> None:
    parser = arguments(__doc__ or "", data=True, quick="four worlds")
    parser.add_argument("--csv", type=Path, help="CSV file for the rows")
    given = parsed(parser)

    chosen = [w for w in available(given.data).values() if w.kind in KINDS and not w.radio]
    rows = [row for world in chosen[:: len(chosen) // 4 if given.quick else 1] for row in of(world)]
    table = pd.DataFrame(rows)
    if given.csv is not None:
        given.csv.parent.mkdir(parents=True, exist_ok=True)
        table.round(5).to_csv(given.csv, index=False)
    report(table)


def of(world: World) -> Iterator[dict[str, object]]:
    """Yield a row with the scores and the contact of each set of posts in each bound."""
    workspace = world.campaign_workspace()
    simulator = world.simulator(workspace)
    if not isinstance(simulator, KinematicSimulator):
        return

    rng = np.random.default_rng(0)
    bounds = np.argwhere(workspace.passable_bounds.values)
    some = rng.permutation(len(bounds))[:N_BOUNDS]
    sight = workspace.awareness.sel(feature="line_of_sight").mean("robot").values
    for number, (move, row, col) in enumerate(bounds[some].tolist()):
        down, right = MOVES[move]
        a, c = (row - down, col - right), (row, col)
        for k, name in enumerate(POST_SETS):
            yield {
                "world": world.name,
                "kind": world.kind,
                "bound": number,
                "posts": name,
                "score": score_of(workspace, (*a, name), c),
                "line of sight": sight[move + len(MOVES) * k, row, col],
                "contact": contact_of(simulator, (*a, name), c, number),
            }
    print(f"{world.name}", flush=True)


def score_of(workspace: Workspace, station: tuple[int, int, str], after: Cell) -> float:
    """Return the score with doubt of the posts of a set, as that of the standard set; robots' mean.

    The penalties on distance and on posts in the way are included.
    """
    posts = workspace.posts
    places = posts.watching(station, after)
    scores = posts._scores(station[:2], [after], places, SETS[POST_SETS[0]])
    robots = posts.team.robots
    return float(np.mean([scores[robot][0, i] for i, robot in enumerate(robots)]))


def contact_of(
    simulator: KinematicSimulator, station: tuple[int, int, str], after: Cell, number: int
) -> float:
    """Return the expected contact in a bound that begins at the posts; NaN if it fails."""
    world = simulator.world(0, long_run=True)
    state = simulator.standing(station, after)
    found = []
    for replicate in range(N_REPLICATES):
        rng = np.random.default_rng([replicate, number])
        [(drive, contact, _)] = simulator.outcomes(
            world, state, 1, [(after, None)], rng, expected=True
        )
        if drive.status == "ok":
            found.append(contact.mean())
    return float(np.mean(found)) if found else np.nan


def report(rows: pd.DataFrame) -> None:
    """Print the table of all worlds and of groups of kinds."""
    of_worlds = rows.groupby(["world", "kind"]).apply(compared, include_groups=False).reset_index()
    names = [name for name in of_worlds if name not in ("world", "kind")]
    table = Table("worlds", "n", *names, first=26, name="overwatch")
    groups = {"all": KINDS, **{name: kinds for name, kinds in ALIKE.items() if {*kinds} & {*KINDS}}}
    for name, kinds in groups.items():
        some = of_worlds[of_worlds["kind"].isin(kinds)]
        texts = []
        for what in names:
            *ends, _ = over_worlds(some[what].to_numpy(), some["world"])
            texts.append(interval(*(ends if what.startswith("rank") else np.exp(ends)), places=2))
        table.row(name, len(some), *texts)


def compared(of_world: pd.DataFrame) -> pd.Series:
    """Return the logarithms of ratios of contact lost in a world, and mean rank correlations."""
    wide = of_world.pivot(index="bound", columns="posts")
    wide = wide[np.isfinite(wide["contact"]).all(axis=1)]
    lost = 1.0 - wide["contact"][list(POST_SETS)].to_numpy()
    usual = lost[:, 0].mean() + LEAST

    ratios = {"at random": lost.mean(), "in hindsight": lost.min(1).mean()}
    ranks = {}
    for name in ("score", "line of sight"):
        predicted = wide[name][list(POST_SETS)].to_numpy()
        best = lost[np.arange(len(lost)), predicted.argmax(1)]
        ratios[f"by {name}"] = best.mean()
        ranks[f"rank {name}"] = np.nanmean(spearman(predicted, -lost))
    return pd.Series({what: np.log((x + LEAST) / usual) for what, x in ratios.items()} | ranks)


def spearman(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute Spearman's correlation of each row; NaN if all values of one are equal."""
    x, y = (rankdata(values.round(6), axis=1) for values in (x, y))
    x, y = (values - values.mean(1, keepdims=True) for values in (x, y))
    with np.errstate(invalid="ignore"):
        return (x * y).sum(1) / np.sqrt((x**2).sum(1) * (y**2).sum(1))


if __name__ == "__main__":
    main()
