"""Result of a campaign, in memory and on disk."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import rioxarray  # noqa: F401  (registers the .rio accessor)
import xarray as xr

from trustbo.campaign.history import table_of
from trustbo.campaign.options import PLANNING_OPTIONS, CampaignOptions
from trustbo.campaign.planners import planner_of, under_risk
from trustbo.campaign.posteriors import Posteriors, whole_posterior
from trustbo.campaign.state import Failure
from trustbo.campaign.summary import evidence_of
from trustbo.data import Cell, Mission
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, require_pair
from trustbo.files import FilePath
from trustbo.hazard.model import measures_of
from trustbo.hazard.risk import BoundRisk
from trustbo.inference import (
    memory,
    params_of,
    place_maps,
)
from trustbo.inference.memory import Memory
from trustbo.planning import Plan, Planner
from trustbo.workspace import Workspace

if TYPE_CHECKING:
    from trustbo.plots.explorer import Explorer


@dataclass(frozen=True, eq=False, repr=False)
class Result(Summary):
    """Result of a campaign.

    Attributes:
        workspace: Workspace of the campaign.
        missions: All missions, in order.
        posteriors: Posterior of the parameters after each of them (ArviZ DataTrees, read from the
            folder when asked for); None where nothing could be learned yet.
        path: Path recommended after the last mission: the best under the posterior mean.
        trust: Expected trust along it, shape (bound, robot).
        value: Its objective.
        trust_map: Trust map of the team after the last mission, dims (row, col).
        history: Dataset over `iteration` (1, 2, ...): the path that was planned (`path`, row and
            col of each step, -1 after the goal), its `objective` when it was planned, whether it
            differs from the plan before (`path_changed`), the `trust_map` it was planned on, the
            mission's mean `contact_rate`, its `status`, its `state` with the `reason` (`"told"`: to
            be learned from later; `"learned"`; `"set aside"`: never), the diagnostics
            of the posterior (see `inference.diagnostics`), and the seconds of planning, running and
            fitting.
        settings: Options of the campaign, and the settings of its model and simulator.
        stop_reason: Reason of the end.
        failures: Missions that were given up, see `Campaign.fail`.
    """

    workspace: Workspace
    missions: list[Mission]
    posteriors: Sequence[xr.DataTree]
    path: list[Cell]
    trust: np.ndarray
    value: float
    trust_map: xr.DataArray
    history: xr.Dataset
    settings: dict[str, Any]
    stop_reason: str
    failures: Sequence[Failure] = ()

    def _rows(self) -> Rows:
        n = len(self.missions)
        rows = [
            ("missions", f"{n}; stopped: {self.stop_reason}"),
            ("recommended", f"{self.path[0]} to {self.path[-1]}, {len(self.path) - 1} bounds"),
            ("value", f"{self.value:.3g} ({self.settings.get('objective', 'objective unknown')})"),
            ("contact rate", f"{self.history['contact_rate'].values[-1]:.3f} on the last mission"),
            ("outcomes", ", ".join(map(str, self.history["status"].values))),
        ]
        if "memory" in self.__dict__:
            rows.append(("memory", str(self.memory)))
        return rows + evidence_of(self.history)

    @property
    def has_posterior(self) -> bool:
        """Whether anything could be learned yet."""
        return (
            len(self.posteriors) > 0
            and Posteriors.from_trees(self.posteriors).stored[-1] is not None
        )

    @cached_property
    def posterior(self) -> xr.DataTree:
        """Posterior after the last mission, with all groups, for ArviZ.

        Its missions are labelled by their index in `missions`; see `inference.complete` for those
        before.

        Raises:
            TrustboError: Nothing could be learned yet.
        """
        if not self.has_posterior:
            reasons = [str(r) for r in self.history.get("reason", xr.DataArray([""])).values]
            raise TrustboError(
                f"there is no posterior: none of {len(self.missions)} missions could be learned "
                f"from yet ({reasons[-1]}). They are kept; go on with more missions."
            )
        return whole_posterior(self.posteriors[-1], self.missions)

    @cached_property
    def memory(self) -> Memory:
        """Whether trust carries over from one bound to the next, see `inference.memory`.

        Computed when first asked for, in a second; the summary shows it from then on.

        Raises:
            TrustboError: Nothing could be learned yet; or memory cannot be weighed under the model.
        """
        return memory(self.posterior, self.missions, self.workspace)

    def table(self) -> pd.DataFrame:
        """Table with a row for each mission, labelled by its number, from 1; also `history.csv`.

        Columns are the `status`, the `state` with its `reason`, or the reason of a failure, the
        cell `where` the mission failed, the mean `contact_rate`, the plan's `objective`, the number
        `n_bounds` of bounds run, including a failed one, `path_changed` and the `path` as text,
        "9,0 8,1"; then diagnostics of the posterior and seconds, as in `history`. A mission given
        up without a report, see `Campaign.fail`, has no number and the state "given up".
        """
        return table_of(self.history, self.missions, self.failures)

    @cached_property
    def planner(self) -> Planner:
        """Planner as the campaign's at the end."""
        needed = ("start", "goal", "objective", *PLANNING_OPTIONS)
        missing = [name for name in needed if name not in self.settings]
        if missing:
            raise TrustboError(
                f"the result's settings lack {', '.join(missing)}: it was made by another version "
                "or by hand; plan with a Planner of your own."
            )
        options = CampaignOptions(**{name: self.settings[name] for name in PLANNING_OPTIONS})
        start, goal = (require_pair(name, self.settings[name]) for name in ("start", "goal"))
        observation = self.posterior.attrs.get("observation", "gaussian")
        planner = planner_of(
            options, self.workspace, start, goal, self.settings["objective"], observation,
        )  # fmt: skip
        if "hazard" in self.posterior.children:
            hazard = self.posterior["hazard"].to_dataset()
            # The workspace has no measures where the terrain was taken away.
            if {*hazard["measure"].values.tolist()} <= {*measures_of(self.workspace)}:
                planner = under_risk(planner, BoundRisk.of(hazard, self.workspace))
        return planner

    @cached_property
    def plan(self) -> Plan:
        """Recommended path as a `Plan`, with bands over the posterior."""
        mean = params_of(self.posterior).mean()
        best = self.planner.plan(mean)
        if list(best.path) != self.path:  # another version may find one of equal value
            best = self.planner.evaluate(self.path, mean)
        given = self.planner.evaluate(best.path, self.posterior)
        return best.with_draws(given)

    def maps(self, *, n_draws: int | None = None, seed: int = 0) -> xr.Dataset:
        """Compute every map of the planning cells after the last mission, for GIS and figures.

        Args:
            n_draws: Number of draws of the posterior; by default 1000, or 100 where each cell needs
                a separate search: `team="min"`, or robots that influence each other.
            seed: Seed of the choice of draws.

        Returns:
            Dataset over (y, x), the centres of the cells' rows and columns in CRS metres, so that
            `isel(y=row, x=col)` is a cell; `maps.rio` has the CRS and writes rasters. It holds
            `trust_mean` and `trust_sd` over the posterior, the mean `cost` 1 - sigma(trust),
            `path_probability` (of a cell to be on the best path), and each feature's awareness, the
            mean over robots, by its name, or as `awareness_<name>` where another map or a dim has
            that name. NaN where no robot can go. Where places have effects, also `place_mean` and
            `place_sd` of the cell's, and `place_bounds_mean`, the mean of those of the bounds into
            it (see `inference.place_maps`); of robots' own effects, the mean over robots.
        """
        if n_draws is None and seed == 0:
            return self._maps.copy(deep=True)  # the caller may write into it
        return self._compute_maps(n_draws, seed)

    @cached_property
    def _maps(self) -> xr.Dataset:
        return self._compute_maps(None, 0)

    def _compute_maps(self, n_draws: int | None, seed: int) -> xr.Dataset:
        if n_draws is None:
            mean = params_of(self.posterior).mean()
            n_draws = 1000 if self.planner.dynamics(mean).is_scalar else 100
        summary = self.planner.trust_summary(self.posterior, n_draws=n_draws, seed=seed)
        maps = summary.rename(mean="trust_mean", sd="trust_sd")
        share = self.planner.path_posterior(self.posterior, n_draws=n_draws, seed=seed)
        awareness = self.workspace.awareness
        places = self._places()
        taken = {*maps.variables, *maps.dims, "path_probability", "x", "y", "spatial_ref", *places}
        for name in [str(feature) for feature in awareness["feature"].values]:
            values = awareness.sel(feature=name, drop=True).mean("robot")
            free = f"awareness_{name}" if name in taken else name
            maps[free] = values.assign_attrs(long_name=f"{name}, 0 worst, 1 best")
        maps["path_probability"] = share
        maps = maps.assign(places.data_vars)
        return self.workspace.grid.place(maps.where(self.workspace.passable))

    def _places(self) -> xr.Dataset:
        """Maps of the effects of places, (row, col), where there are some."""
        if "places" not in self.posterior.children:
            return xr.Dataset()
        effects = place_maps(self.posterior)
        if "place_bound_mean" in effects:
            into = effects["place_bound_mean"].where(self.workspace.passable_bounds).mean("move")
            label = "mean effect on trust of the bounds into a cell"
            into.attrs = {"long_name": label, "units": "1"}
            effects["place_bounds_mean"] = into
        maps = effects.drop_vars(["place_bound_mean", "place_bound_sd", "move"], errors="ignore")
        return maps.mean("robot", keep_attrs=True) if "robot" in maps.dims else maps

    def plot_maps(self, **options: Any) -> np.ndarray:
        """Draw trust maps and paths of four moments; options and Axes as of `plots.trust_maps`."""
        from trustbo import plots  # imports matplotlib

        return plots.trust_maps(self.history, self.trust_map, self.path, self.workspace, **options)

    def explore(self) -> "Explorer":
        """Draw an interactive page with layers of the map and the missions on a slider.

        Layers are those of `maps`, the awareness of each robot, the failure chance, and the trust
        map that each mission was planned on. A notebook shows the page; `.save(path)` writes it to
        one HTML file that needs no network.

        Raises:
            TrustboError: Nothing could be learned yet.
        """
        from trustbo.plots.explorer import draw_explorer

        exploring = import_module("trustbo.report.exploring")  # by name: it lies above
        return draw_explorer(exploring.scene_of(self, self.maps()))

    def save(self, directory: FilePath, *, overwrite: bool = False) -> None:
        """Write everything to a folder that `load_result` reads.

        Each file is written whole or not at all: `posteriors/` (one per mission), `posterior.nc`
        (the last of them), `missions.nc`, `workspace.nc`, `history.nc`, `history.csv` and
        `result.json`.

        Args:
            directory: Folder to write to.
            overwrite: Whether to remove another campaign or result in it first.

        Raises:
            TrustboError: The folder holds a campaign or a result, without `overwrite`; or its name
                belongs to a file.
        """
        from trustbo.campaign.storage import save_result  # it reads results too

        save_result(self, directory, overwrite=overwrite)
