"""Print the error of predicted contact in bounds that no robot has driven (docs/benchmarks.md).

    python benchmarks/undriven.py --data DIR --out out/undriven

In each world and on two courses, the default campaign runs six missions. The contact of the team in
all other bounds is then predicted by the prior, which only knows the map, and by two models fitted
to these missions: the default model, and the default model without effects of robots in bounds. The
error in a bound is the absolute difference from the true expected contact rate. The mean error over
bounds is averaged over courses. The interval of the paired difference is computed by a bootstrap
over worlds.
"""

from typing import Any

import numpy as np
import xarray as xr
from common import Table, arguments, parsed
from groups import ALIKE
from world_set import worlds

import trustbo as tb
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect
from trustbo.workspace.moves import MOVE_NAMES, bounds_along

WORLDS = (
    "synthetic-0", "synthetic-1", "synthetic-2", "wellington", "synthetic-0-low",
    "synthetic-1-dense", "synthetic-2-jammer", "synthetic-alder-thin-canopy",
)  # fmt: skip
COURSES = ("sw-ne", "nw-se")
MISSIONS = 6
NONE = 1e-4
"""Scale of the prior on the effects of robots in bounds that leaves them out."""
MODELS = {
    "default without r": PooledTrust(effects=(PlaceEffect(tau_r=NONE), RobotEffect())),
    "default": tb.models.default_model(),
}
PRIOR = "prior"
N_RESAMPLES = 10_000


def main() -> None:
    parser = arguments(__doc__, data=True, out="out/undriven", quick="one world, one course")
    given = parsed(parser)
    known = worlds(given.data)
    names = [n for n in WORLDS if known[n].is_packaged or given.data]
    courses = COURSES
    if given.quick:
        names, courses = names[:1], courses[:1]

    table = Table("world", "map", "undriven bounds", PRIOR, *MODELS)
    errors: dict[str, list[dict[str, float]]] = {"right": [], "wrong": []}
    for name in names:
        world = known[name]
        kind = "right" if world.kind in ALIKE["map right"] else "wrong"
        of_courses = []
        n_bounds = []
        for course in courses:
            error, n = errors_of(world.scene(course, given.out / "truths"))
            of_courses.append(error)
            n_bounds.append(n)

        mean = {key: float(np.mean([e[key] for e in of_courses])) for key in of_courses[0]}
        errors[kind].append(mean)
        table.row(name, kind, sum(n_bounds), *(f"{mean[key]:.3f}" for key in (PRIOR, *MODELS)))

    print()
    report(errors)


def errors_of(scene: Any) -> tuple[dict[str, float], int]:
    """Return the mean absolute error of each prediction, and the number of undriven bounds."""
    campaign = tb.Campaign(scene.workspace, scene.start, scene.goal, seed=0, **scene.options)
    for _ in campaign.run(scene.simulator, MISSIONS):
        pass
    missions = campaign.missions

    contact = scene.truth.at(MISSIONS).bounds["contact"].mean("next_move").values
    is_undriven = np.isfinite(contact) & scene.workspace.passable_bounds.values
    for mission in missions:
        moves, rows, cols = bounds_along(mission.path).T
        is_undriven[moves, rows, cols] = False

    learned: dict[str, Any] = {PRIOR: campaign.draw_prior(500)}
    for name, model in MODELS.items():
        learned[name] = tb.fit(
            missions, model, workspace=scene.workspace, seed=0, latent=False, progress=False
        )
    planner = campaign.planner
    predicted = {name: contact_of(planner, draws) for name, draws in learned.items()}
    off = {name: np.abs(p - contact)[is_undriven] for name, p in predicted.items()}
    return {name: float(o.mean()) for name, o in off.items()}, int(is_undriven.sum())


def contact_of(planner: tb.Planner, draws: tb.models.draws.Draws | xr.DataTree) -> np.ndarray:
    """Return the expected contact rate (move, row, col) of the team in each bound."""
    by_move = [
        planner.trust(draws, move=move, as_rate=True).mean(("draw", "robot")) for move in MOVE_NAMES
    ]
    return np.stack([contact.values for contact in by_move])


def report(errors: dict[str, list[dict[str, float]]]) -> None:
    """Print the mean errors by kind, with an interval of the difference between the models."""
    before, now = MODELS
    table = Table("map", "worlds", PRIOR, *MODELS, "difference")
    rng = np.random.default_rng(0)
    for kind, rows in {**errors, "all": [*errors["right"], *errors["wrong"]]}.items():
        if not rows:
            continue
        means = [np.mean([row[key] for row in rows]) for key in (PRIOR, *MODELS)]
        less = np.array([row[now] - row[before] for row in rows])
        resampled = less[rng.integers(len(less), size=(N_RESAMPLES, len(less)))].mean(1)
        low, high = np.quantile(resampled, (0.025, 0.975))
        interval = f"{less.mean():+.3f} [{low:+.3f}, {high:+.3f}]"
        table.row(kind, len(rows), *(f"{mean:.3f}" for mean in means), interval)


if __name__ == "__main__":
    main()
