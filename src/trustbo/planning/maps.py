"""Maps of the cells under a posterior, for GIS and figures."""

import numpy as np
import xarray as xr

from trustbo.models.draws import NextMission
from trustbo.planning.drawn_paths import choose_draws, drawn_paths
from trustbo.planning.problem import InfeasibleError, Problem
from trustbo.planning.trust_map import cost_of, trust_map
from trustbo.workspace.moves import cells_along


def maps_of(
    problem: Problem, ahead: NextMission, n_draws: int | None, seed: int, *, expected: bool
) -> xr.Dataset:
    """Return the maps of `Planner.maps`, for whose other arguments see there."""
    draws = choose_draws(ahead.of_robots(expected=expected), n_draws, seed)
    of_plans = choose_draws(ahead.expected, n_draws, seed)
    workspace = problem.paths.workspace
    trust = trust_map(problem, draws, led=True)
    passable = workspace.passable
    try:
        share = drawn_paths(problem, of_plans).share()
    except InfeasibleError as error:
        share = np.zeros(passable.shape)
        share[tuple(cells_along(error.path).T)] = 1.0

    maps = {
        "trust_mean": (trust.mean("draw"), "mean expected trust"),
        "trust_sd": (trust.std("draw", skipna=False), "sd of expected trust"),
        "cost": (cost_of(trust).mean("draw"), "mean cost 1 - sigma(trust)"),
        "path_probability": (passable.copy(data=share), "P(cell on the best path)"),
    }
    if "place" in draws.arrays:
        place = xr.DataArray(draws.arrays["place"].mean(1), dims=("draw", "row", "col"))
        maps["place_mean"] = place.mean("draw"), "mean place effect"
        maps["place_sd"] = place.std("draw"), "sd of the place effect"

    awareness = workspace.awareness
    taken = {*maps, "x", "y", "row", "col", "spatial_ref"}
    for name in workspace.features:
        mean = awareness.sel(feature=name, drop=True).mean(("robot", "move"))
        label = f"awareness_{name}" if name in taken else name
        maps[label] = mean, f"{name}, 0 worst, 1 best"

    dataset = xr.Dataset({name: v.assign_attrs(long_name=t) for name, (v, t) in maps.items()})
    for name in ("trust_mean", "trust_sd", "cost"):
        dataset[name].attrs["start"] = trust.attrs["start"]
    return workspace.grid.place(dataset.where(passable))
