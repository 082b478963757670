"""Content of a result's interactive page: layers of the map, and its missions step by step."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import xarray as xr

from trustbo.campaign.result import Result
from trustbo.data import Cell, Mission
from trustbo.inference import params_of, place_maps
from trustbo.planning.plan import QUANTILES
from trustbo.planning.values import path_trust
from trustbo.plots.explorer import Layer, Overwatch, Scene, Step
from trustbo.plots.places import BETTER_WORSE
from trustbo.report.numbers import MINUS, counted
from trustbo.team import Robot
from trustbo.workspace import Workspace
from trustbo.workspace.moves import along, bounds_along

_FIVE = (*QUANTILES[:2], 0.5, *QUANTILES[2:])
_Moments = dict[str, tuple[np.ndarray, np.ndarray]]
"""Mean and sd by name, each (move, row, col)."""
_REACH = 30.0
"""Distance from the lead's stop of the points from which it is shown what is seen, m."""
_SIGN = "\N{PLUS-MINUS SIGN}"


def scene_of(result: Result, maps: xr.Dataset) -> Scene:
    """Lay out the page of a result with a posterior, and with `maps` of `Result.maps`."""
    bound_maps = _bound_maps(result)
    steps = [_mission_step(result, j, bound_maps) for j in range(len(result.missions))]
    steps.append(_last_step(result, bound_maps))
    title = f"{counted(len(result.missions), 'mission')}: trust, place by place"
    return Scene(title, result.workspace, _layers(result, maps, bound_maps), steps)


def _layers(result: Result, maps: xr.Dataset, bound_maps: _Moments) -> list[Layer]:
    """Layers by group, the most important first."""
    there = {str(name): maps[name].transpose("y", "x").values for name in maps.data_vars}
    learned = there["trust_mean"].copy()
    learned[result.path[0]] = np.nan  # assumed there, and would set the limits of the colours

    def layer(name: str, label: str, group: str, limits: tuple[float, float], **more) -> Layer:
        return Layer(name, label, group, there[name], limits, **more)

    def sd_layer(name: str, label: str, group: str) -> Layer:
        return layer(name, f"{label}, sd", group, (0.0, _top(there[name])))

    best, group = "P(cell on the best path)", "Trust"
    layers = [
        layer("trust_mean", "expected trust", group, _ends(learned), sd="trust_sd"),
        sd_layer("trust_sd", "expected trust", group),
        layer("path_probability", best, "Path", (0.0, 1.0)),
    ]
    cell, bounds, group = "effect of the cell", "effect of the bounds into it", "Places"
    for name, label, sd in (("place_mean", cell, "place_sd"), ("place_bounds_mean", bounds, None)):
        if name in there:
            top = _top(np.abs(there[name]))
            layers.append(layer(name, label, group, (-top, top), colours=BETTER_WORSE, sd=sd))
            layers += [sd_layer(sd, label, group)] if sd else []
    return [*layers, *_failure(bound_maps), *_awareness(result, there), *_as_planned(result)]


def _failure(bound_maps: _Moments) -> list[Layer]:
    """Probability of failure on entering a cell from its worst neighbour, and its sd."""
    if (chances := bound_maps.get("chance to fail")) is None:
        return []
    worst = np.where(np.isnan(chances[0]), -np.inf, chances[0]).argmax(0)[None]
    mean, sd = (np.take_along_axis(moment, worst, 0)[0] for moment in chances)
    label, group = "chance to fail, from the worst side", "Failure"
    return [
        Layer("p_fail", label, group, mean, (0.0, _top(mean)), sd="p_fail_sd"),
        Layer("p_fail_sd", f"{label}, sd", group, sd, (0.0, _top(sd))),
    ]


def _awareness(result: Result, there: Mapping[str, np.ndarray]) -> list[Layer]:
    """Awareness by feature and robot; one map for all robots where they are alike."""
    known = result.workspace.awareness
    layers = []
    for name in [str(feature) for feature in known["feature"].values]:
        by_robot = known.sel(feature=name).transpose("robot", "row", "col").values
        text = name.replace("_", " ")
        if np.allclose(by_robot, by_robot[:1], equal_nan=True):
            layers.append((name, text, by_robot[0]))
            continue
        mean = there[f"awareness_{name}" if f"awareness_{name}" in there else name]
        layers.append((name, f"{text}, mean of the robots", mean))
        for robot, values in zip(result.workspace.team.names, by_robot, strict=True):
            layers.append((f"{name} {robot}", f"{text}, {robot}", values))
    group = "Awareness (0 worst, 1 best)"
    return [Layer(name, label, group, values, (0.0, 1.0)) for name, label, values in layers]


def _as_planned(result: Result) -> list[Layer]:
    """Trust map that each mission was planned on, and the last one."""
    planned = result.history["trust_map"].transpose("iteration", "row", "col").values
    every = np.concatenate([planned, result.trust_map.transpose("row", "col").values[None]])
    learned = every[1:].copy()
    learned[:, *result.path[0]] = np.nan
    label = "expected trust when the path was planned"
    return [Layer("trust_planned", label, "Trust, mission by mission", every, _ends(learned))]


def _mission_step(result: Result, j: int, bound_maps: _Moments) -> Step:
    """Path, posts, contact and trust of a mission."""
    mission, row = result.missions[j], result.history.isel(iteration=j)
    n = len(mission.path) - 1
    contact = mission.contact_rate
    mean = float(np.nanmean(contact)) if np.isfinite(contact).any() else np.nan
    facts = [f"Mission {j + 1} of {len(result.missions)}: {mission.status.replace('_', ' ')}"]
    facts.append(f"contact {mean:.3f}" if np.isfinite(mean) else "no contact rate measured")
    if len(mission.bounds) < n:
        facts.append(f"ended in bound {len(mission.bounds)} of {n}")
    facts.append(f"{_objective(result, row['objective'].item())} when planned")
    stops, posts = _recorded(mission, result.workspace)
    return Step(
        f"mission {j + 1}",
        ", ".join(facts) + ".",
        "Trust along the mission, given all missions",
        mission.path,
        stops,
        posts,
        contact,
        _latent_trust(result, j, n),
        _numbers(result, mission.path, mission.awareness, bound_maps),
    )


def _last_step(result: Result, bound_maps: _Moments) -> Step:
    """Recommended path, with the trust expected along it."""
    path, planner = result.path, result.planner
    rolled = planner.dynamics(params_of(result.posterior, day=True).flat()).along(path)
    expected = path_trust(rolled, planner.problem.objective, 0.0, cap=False).trust
    stops, posts = _planned(path, result.workspace)
    z = along(result.workspace.bound_maps, path)
    return Step(
        "recommended",
        f"Recommended after {counted(len(result.missions), 'mission')}: {len(path) - 1} bounds, "
        f"{_objective(result, result.value)}.",
        "Expected trust along the recommended path",
        path,
        stops,
        posts,
        np.full(result.trust.shape, np.nan),
        np.quantile(expected, _FIVE, axis=0),
        _numbers(result, path, z.transpose(1, 0, 2), bound_maps),
        _overwatch(result.workspace, path),
    )


def _overwatch(workspace: Workspace, path: Sequence[Cell]) -> list[Overwatch] | None:
    """Share of each bound that robots would see from points around the lead's stop."""
    if workspace.watch is None or workspace.ground is None:
        return None
    left, bottom = workspace.grid.corner
    found = []
    for bound in pairwise(path):
        x, y = workspace.ground.posts.stop(bound[0])
        by_kind: dict[Robot, xr.DataArray] = {}
        for name, robot in zip(workspace.team.names, workspace.team.robots, strict=True):
            if robot not in by_kind:
                seen = workspace.overwatch_map(bound, robot=name)
                assert seen is not None  # noqa: S101  # there is a table
                near = {"x": abs(seen["x"] - x) <= _REACH, "y": abs(seen["y"] - y) <= _REACH}
                by_kind[robot] = seen.isel({axis: np.flatnonzero(n) for axis, n in near.items()})
        maps = [by_kind[robot] for robot in workspace.team.robots]
        axes = maps[0]["x"].values - left, maps[0]["y"].values - bottom
        found.append(Overwatch(*axes, np.stack([one.values for one in maps])))
    return found


def _latent_trust(result: Result, j: int, n_bounds: int) -> np.ndarray:
    """Quantiles of the team's trust along a mission given all missions, (quantile, bound)."""
    along = np.full((len(_FIVE), n_bounds), np.nan)
    latent = result.posterior["latent"]["trust"]
    if j not in latent.indexes["mission"]:  # never learned from
        return along
    by_robot = latent.sel(mission=j).transpose("chain", "draw", "bound", "robot").values
    team = (
        by_robot.min(-1) if result.settings["planner"].get("team") == "min" else by_robot.mean(-1)
    )
    draws = team.reshape(-1, team.shape[-1])[:, :n_bounds]
    along[:, : draws.shape[1]] = np.quantile(draws, _FIVE, axis=0)
    return along


def _recorded(mission: Mission, workspace: Workspace) -> tuple[np.ndarray, np.ndarray | None]:
    """Recorded stops and posts; those planned for bounds without a record."""
    stops, posts = _planned(mission.path, workspace)
    n_robots = len(mission.robots)
    for k, bound in enumerate(mission.bounds):
        if bound.poses is None or not len(bound.poses):
            continue
        if posts is None:
            posts = np.full((len(mission.path) - 1, n_robots, 2), np.nan)
        here = bound.poses[0, :, :2] - workspace.grid.corner
        stops[k], posts[k] = here[0], here[1:]
    return stops, posts


def _planned(path: Sequence[Cell], workspace: Workspace) -> tuple[np.ndarray, np.ndarray | None]:
    """Stops and posts in m from the lower left corner: centres and None without a terrain."""
    corner = np.array(workspace.grid.corner)
    if (ground := workspace.ground) is None:
        return np.array([workspace.grid.center(cell) for cell in path]) - corner, None
    stops = np.stack([ground.posts.stop(cell) for cell in path])
    return stops - corner, ground.posts.along(path) - corner


def _numbers(
    result: Result, path: Sequence[Cell], awareness: np.ndarray, bound_maps: _Moments
) -> dict[str, list[str]]:
    """Further numbers of the bounds of a path, as text; `awareness` is (bound, robot, feature)."""
    where = tuple(bounds_along(path).T)
    numbers = {
        name: [_with_sd(*moments) for moments in zip(means[where], sds[where], strict=True)]
        for name, (means, sds) in bound_maps.items()
    }
    robots = result.workspace.team.names
    for m, feature in enumerate(result.workspace.features):
        text, values = feature.replace("_", " "), awareness[..., m]
        if np.allclose(values, values[:, :1], equal_nan=True):
            values = values[:, :1]
        elif len(robots) > 1:
            text += f" ({' / '.join(robots)})"
        numbers[text] = [" / ".join(f"{z:.2f}" for z in row if np.isfinite(z)) for row in values]
    return numbers


def _with_sd(mean: float, sd: float) -> str:
    """Mean and sd as text, with the digits that two of the sd allow; empty where there is none."""
    if not np.isfinite(mean):
        return ""
    decimals = max(1 - int(np.floor(np.log10(sd))), 0) if sd > 0.0 else 3
    return f"{mean:.{decimals}f} {_SIGN} {sd:.{decimals}f}".replace("-", MINUS)


def _bound_maps(result: Result) -> _Moments:
    """Mean and sd of the quantities of bounds, by name, each (move, row, col)."""
    moments, children = {}, result.posterior.children
    if "hazard" in children and "p_fail" in result.posterior["hazard"]:
        hazard = result.posterior["hazard"]
        moments["chance to fail"] = hazard["p_fail"].values, hazard["p_fail_sd"].values
    if "places" in children:
        effects = place_maps(result.posterior)
        if "place_bound_mean" in effects:
            if "robot" in effects.dims:
                effects = effects.mean("robot")
            mean, sd = (
                effects[f"place_bound_{n}"].transpose("move", "row", "col") for n in ("mean", "sd")
            )
            moments["effect of the bound"] = mean.values, sd.values
    return moments


def _objective(result: Result, value: float) -> str:
    text = f"{value:.3g}".replace("-", MINUS)
    return f"objective {text} ({result.settings['objective'].replace('_', ' ')})"


def _ends(values: np.ndarray) -> tuple[float, float]:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return (low, high) if low < high else (low, low + 1e-6)


def _top(values: np.ndarray) -> float:
    return max(float(np.nanmax(values)), 1e-6)
