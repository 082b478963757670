"""What a campaign learned, in memory and on disk."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from trustbo import archive, records
from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError
from trustbo.files import to_json, write_file, write_text
from trustbo.models import params_of
from trustbo.planning import Plan, Planner
from trustbo.terrain import Workspace

_BELIEVED = "believed.nc"
_PLANNER_OPTIONS = ("objective", "connectivity", "max_bounds", "team", "length_weight")


@dataclass(frozen=True, eq=False)
class Result:
    """What a campaign learned.

    Attributes:
        workspace: Where it was.
        missions: All missions, in order.
        posteriors: The posterior after each of them (ArviZ DataTrees).
        path: The path recommended after the last mission: the best under the posterior mean.
        trust: Expected trust along it, shape (bound, robot).
        value: Its objective.
        trust_map: The team's trust map after the last mission, dims (row, col).
        history: Dataset over `iteration` (1, 2, ...): the plan each mission followed (`path`, as
            row and col of each step, -1 after the goal), its `objective` when it was planned,
            whether it differs from the plan before (`path_changed`), the `trust_map` it was planned
            on, the mission's mean `contact_rate` and `status`, what `models.diagnostics` says of
            its posterior, and the seconds spent planning, running and fitting.
        settings: What the campaign was run with.
        stop_reason: Why it ended.
        believed: Of campaigns with `awareness="belief"`, the awareness believed in at the end: its
            `mean` (robot, row, col, feature) and `draws` of it (draw, robot, row, col, feature).
    """

    workspace: Workspace
    missions: list[Mission]
    posteriors: list[xr.DataTree]
    path: list[Cell]
    trust: np.ndarray
    value: float
    trust_map: xr.DataArray
    history: xr.Dataset
    settings: dict[str, object]
    stop_reason: str
    believed: xr.Dataset | None = None

    @property
    def posterior(self) -> xr.DataTree:
        """The posterior after the last mission."""
        return self.posteriors[-1]

    @cached_property
    def planner(self) -> Planner:
        """A planner as the campaign's, going by the awareness believed in at the end."""
        missing = [n for n in (*_PLANNER_OPTIONS, "start", "goal") if n not in self.settings]
        if missing:
            raise TrustboError(
                f"the result's settings lack {', '.join(missing)}: it was made by another version "
                "or by hand; plan with a Planner of your own."
            )
        options: dict[str, Any] = {name: self.settings[name] for name in _PLANNER_OPTIONS}
        start, goal = (_cell(self.settings[name]) for name in ("start", "goal"))
        planner = Planner(self.workspace, start, goal, **options)
        if self.believed is None:
            return planner
        return planner.with_awareness(self.believed["draws"].values, self.believed["mean"].values)

    @cached_property
    def plan(self) -> Plan:
        """The recommended path as a `Plan`, with bands over the posterior."""
        mean = params_of(self.posterior).mean()
        best = self.planner.plan(mean)
        if list(best.path) != self.path:  # as good, found by another version
            best = self.planner.evaluate(self.path, mean)
        return replace(best, bands=self.planner.bands(best.path, self.posterior))

    def maps(self, *, n_draws: int | None = None, seed: int = 0) -> xr.Dataset:
        """Every map of the planning cells after the last mission, for GIS and figures.

        Args:
            n_draws: How many draws of the posterior to go over; by default 1000, or 100 where each
                cell needs a search of its own: `team="min"`, or robots that influence each other.
            seed: Same seed, same draws.

        Returns:
            Dataset over (row, col) with `trust_mean` and `trust_sd` over the posterior, the mean
            `cost` 1 - sigma(trust), `path_probability` (of a cell to be on the best path), and
            each feature's awareness, the mean over robots, by its name, or as `awareness_<name>`
            where that is another map's or a dim's. NaN where no robot can go.
        """
        if n_draws is None:
            mean = params_of(self.posterior).mean()
            n_draws = 1000 if self.planner.dynamics(mean).is_scalar else 100
        summary = self.planner.trust_summary(self.posterior, n_draws=n_draws, seed=seed)
        maps = summary.rename(mean="trust_mean", sd="trust_sd")
        share = self.planner.path_posterior(self.posterior, n_draws=n_draws, seed=seed)
        awareness = self.workspace.awareness if self.believed is None else self.believed["mean"]
        taken = {*maps.variables, *maps.dims, "path_probability", "x", "y", "spatial_ref"}
        for name in [str(feature) for feature in awareness["feature"].values]:
            values = awareness.sel(feature=name, drop=True).mean("robot")
            own = f"awareness_{name}" if name in taken else name
            maps[own] = values.assign_attrs(long_name=f"{name}, 0 worst, 1 best")
        maps["path_probability"] = share
        return maps.where(self.workspace.passable)

    def plot_maps(self) -> np.ndarray:
        """The trust map and path of each iteration, and those after the last; returns the Axes."""
        from trustbo import plots  # matplotlib only for those who plot

        return plots.trust_maps(self)

    def save(self, directory: str | PathLike[str]) -> None:
        """Write everything to a folder that `load_result` reads.

        Each file is written whole or not at all: `posteriors/` (one per mission), `posterior.nc`
        (the last of them), `missions.nc`, `workspace.nc`, `history.nc`, `history.csv` and
        `result.json`. What another result left there is replaced.

        Raises:
            TrustboError: The folder's name belongs to a file.
        """
        folder = require_folder(directory)
        (folder / "result.json").unlink(missing_ok=True)  # whatever it spoke of is going
        for j, posterior in enumerate(self.posteriors):
            _write_tree(folder / "posteriors" / _posterior_name(j), posterior)
        _write_tree(folder / "workspace.nc", archive.workspace_to_tree(self.workspace))
        self.checkpoint(folder)

    def checkpoint(self, directory: str | PathLike[str]) -> None:
        """As `save`, into a folder where it was called a mission ago.

        The workspace and the earlier posteriors never change, and are not written again.
        """
        folder = require_folder(directory)
        last = _posterior_name(len(self.posteriors) - 1)
        _write_tree(folder / "posteriors" / last, self.posterior)
        for file in (folder / "posteriors").glob("*.nc"):
            if file.name > last:
                file.unlink()
        _write_tree(folder / "posterior.nc", self.posterior)
        trees = {
            "missions.nc": records.missions_to_tree(self.missions),
            "history.nc": xr.DataTree(self.history.assign(final_trust_map=self.trust_map)),
        }
        if self.believed is None:
            (folder / _BELIEVED).unlink(missing_ok=True)
        else:
            trees[_BELIEVED] = xr.DataTree(self.believed)
        for name, tree in trees.items():
            _write_tree(folder / name, tree)
        scalars = [n for n, a in self.history.data_vars.items() if a.dims == ("iteration",)]
        table = self.history[scalars].to_dataframe()[scalars]
        table["path"] = [_path_text(path) for path in self.history["path"].values]
        write_text(folder / "history.csv", table.to_csv())
        record = {
            "n_missions": len(self.missions),
            "path": self.path,
            "trust": self.trust.tolist(),
            "value": self.value,
            "settings": self.settings,
            "stop_reason": self.stop_reason,
        }
        # Last: its presence says that the rest is complete.
        write_text(folder / "result.json", to_json(record))


def load_result(directory: str | PathLike[str]) -> Result:
    """Read a result that `Result.save` wrote.

    Args:
        directory: The folder.

    Raises:
        TrustboError: The folder holds no result, or a damaged one.
    """
    folder = Path(directory)
    if not (folder / "result.json").exists():
        raise TrustboError(f"{str(folder)!r} holds no result; give a folder written by save().")
    try:
        record = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        n, settings = record["n_missions"], record["settings"]
    except (ValueError, KeyError, TypeError) as error:
        raise TrustboError(f"{str(folder / 'result.json')!r} is damaged: {error!r}.") from None
    # A run killed while it saved may have left one mission more than the record knows of.
    missions, posteriors, history = read_learned(folder, n)
    believed = None
    if settings.get("awareness") == "belief":
        if not (folder / _BELIEVED).exists():
            raise TrustboError(f"{str(folder / _BELIEVED)!r} is missing: the result is damaged.")
        believed = records.read_tree(folder / _BELIEVED).to_dataset()
    return Result(
        archive.workspace_from_tree(records.read_tree(folder / "workspace.nc")),
        missions,
        posteriors,
        [_cell(cell) for cell in record["path"]],
        np.array(record["trust"]),
        record["value"],
        history["final_trust_map"].rename("trust"),
        history.drop_vars("final_trust_map"),
        settings,
        record["stop_reason"],
        believed,
    )


class Learned(NamedTuple):
    """Missions of a saved result, the posterior after each, and the history."""

    missions: list[Mission]
    posteriors: list[xr.DataTree]
    history: xr.Dataset


def read_learned(folder: Path, n_missions: int) -> Learned:
    """The first missions of a saved result, and what was learned from each."""
    history = records.read_tree(folder / "history.nc").to_dataset()
    return Learned(
        records.missions_from_tree(records.read_tree(folder / "missions.nc"))[:n_missions],
        [records.read_tree(folder / "posteriors" / _posterior_name(j)) for j in range(n_missions)],
        history.isel(iteration=slice(n_missions)),
    )


def build_history(
    rows: Sequence[Mapping[str, object]], plans: Sequence[Plan], maps: Sequence[xr.DataArray]
) -> xr.Dataset:
    """`Result.history`, from one row of numbers, one plan and one trust map per mission."""
    steps = np.full((len(rows), max(len(plan.path) for plan in plans), 2), -1)
    for i, plan in enumerate(plans):
        steps[i, : len(plan.path)] = plan.path
    # The exact sampler may have fallen back on NUTS, whose diagnostics are others: NaN then.
    names = {name: None for row in rows for name in row}
    scalars = {name: [row.get(name, np.nan) for row in rows] for name in names}
    iteration = xr.DataArray(np.arange(1, len(rows) + 1), dims="iteration", name="iteration")
    return xr.Dataset(
        {
            **{name: ("iteration", values) for name, values in scalars.items()},
            "path": (("iteration", "step", "axis"), steps),
            "trust_map": xr.concat(maps, dim=iteration),
        },
        {"iteration": iteration, "axis": ["row", "col"]},
    )


def require_folder(directory: str | PathLike[str]) -> Path:
    """The folder, which need not exist yet.

    Raises:
        TrustboError: The name, or that of a folder above it, belongs to a file.
    """
    folder = Path(directory)
    for part in (folder, *folder.parents):
        if part.exists():
            if not part.is_dir():
                raise TrustboError(f"cannot write to {str(folder)!r}: {str(part)!r} is a file.")
            break
    return folder


def _cell(pair: Any) -> Cell:
    row, col = pair
    return int(row), int(col)


def _posterior_name(j: int) -> str:
    return f"{j + 1:04d}.nc"


def _write_tree(path: Path, tree: xr.DataTree) -> None:
    write_file(path, tree.to_netcdf)


def _path_text(path: np.ndarray) -> str:
    return " ".join(f"{row},{col}" for row, col in path if row >= 0)
