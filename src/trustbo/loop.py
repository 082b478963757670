"""The loop: plan, run, learn, and plan again."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr
from tqdm import tqdm

from trustbo import archive
from trustbo.campaign import Campaign
from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError
from trustbo.models import PooledTrust, diagnostics
from trustbo.planning import Plan, Policy
from trustbo.simulation import KinematicSimulator, Simulator
from trustbo.terrain import Workspace


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
            on, the mission's mean `contact_rate` and `status`, the posterior's `r_hat`, `ess_bulk`
            and `divergences`, and the seconds spent planning, running and fitting.
        settings: What the campaign was run with.
        stop_reason: Why it ended.
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

    @property
    def posterior(self) -> xr.DataTree:
        """The posterior after the last mission."""
        return self.posteriors[-1]

    def plot_maps(self) -> np.ndarray:
        """The trust map and path of each iteration, and those after the last; returns the Axes."""
        from trustbo import plots  # matplotlib only for those who plot

        return plots.trust_maps(self)

    def save(self, directory: str | PathLike[str]) -> None:
        """Write everything to a folder that `load_result` reads.

        Each file is written whole or not at all: `posterior.nc` (the last), `posteriors/` (one per
        mission; those already there are kept), `missions.nc`, `workspace.nc`, `history.nc`,
        `history.csv` and `result.json`.

        Raises:
            TrustboError: The folder's name belongs to a file.
        """
        folder = require_folder(directory)
        _save_posteriors(folder, self.posteriors)
        trees = {
            "missions.nc": archive.missions_to_tree(self.missions),
            "workspace.nc": archive.workspace_to_tree(self.workspace),
            "history.nc": xr.DataTree(self.history.assign(final_trust_map=self.trust_map)),
        }
        for name, tree in trees.items():
            archive.write_file(folder / name, lambda f, tree=tree: tree.to_netcdf(f))
        scalars = [n for n, a in self.history.data_vars.items() if a.dims == ("iteration",)]
        table = self.history[scalars].to_dataframe()[scalars]
        table["path"] = [_path_text(path) for path in self.history["path"].values]
        archive.write_text(folder / "history.csv", table.to_csv())
        record = {
            "path": self.path,
            "trust": self.trust.tolist(),
            "value": self.value,
            "settings": self.settings,
            "stop_reason": self.stop_reason,
        }
        # Last: its presence says that the rest is complete.
        archive.write_text(folder / "result.json", json.dumps(record, indent=2))


def load_result(directory: str | PathLike[str]) -> Result:
    """Read a result that `Result.save` wrote.

    Raises:
        TrustboError: The folder holds no result.
    """
    folder = Path(directory)
    if not (folder / "result.json").exists():
        raise TrustboError(f"{str(folder)!r} holds no result; give a folder written by save().")
    record = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    history = archive.read_tree(folder / "history.nc").to_dataset()
    missions = archive.missions_from_tree(archive.read_tree(folder / "missions.nc"))
    names = [f"{j:04d}.nc" for j in range(1, len(missions) + 1)]
    return Result(
        archive.workspace_from_tree(archive.read_tree(folder / "workspace.nc")),
        missions,
        [archive.read_tree(folder / "posteriors" / name) for name in names],
        [(int(row), int(col)) for row, col in record["path"]],
        np.array(record["trust"]),
        record["value"],
        history["final_trust_map"].rename("trust"),
        history.drop_vars("final_trust_map"),
        record["settings"],
        record["stop_reason"],
    )


def iterate(
    workspace: Workspace,
    start: Cell,
    goal: Cell,
    *,
    n_iterations: int = 8,
    model: PooledTrust | None = None,
    policy: str | Policy = "greedy",
    objective: str = "terminal",
    sampler: str = "nuts",
    simulator: Simulator | None = None,
    initial: str = "prior_draw",
    connectivity: int = 8,
    max_bounds: int | str | None = None,
    checkpoint: str | PathLike[str] | None = None,
    callbacks: Sequence[Callable[[Campaign, Mission], None]] = (),
    seed: int = 0,
    progress: bool = True,
) -> Result:
    """Run a campaign: plan a path, run it, learn from the contact rates, plan again.

    Args:
        workspace: Where.
        start: First cell, (row, col); row 0 is the top.
        goal: Last cell.
        n_iterations: How many missions.
        model: The trust model; by default `PooledTrust()`.
        policy: `"greedy"`, `"thompson"`, `"random"`, or a callable
            `policy(key, draws, planner) -> Plan`.
        objective: `"terminal"` (the paper's), `"mean"`, `"success"`, `"bottleneck"` or
            `"stationary"`; see `Planner`.
        sampler: `"nuts"`.
        simulator: Whatever has `run(path, *, seed) -> Mission`; by default
            `KinematicSimulator(workspace)`.
        initial: The first plan comes from one random draw of the prior (`"prior_draw"`, as in the
            paper) or from `"prior_mean"`.
        connectivity: 4, or 8 to allow diagonal bounds too.
        max_bounds: Which paths are admissible; see `Planner`.
        checkpoint: A folder in which the result so far is saved after each mission.
        callbacks: Each called as `callback(campaign, mission)` after each mission.
        seed: Same seed, same result.
        progress: Whether to show a progress bar.

    Returns:
        The result.

    Raises:
        TrustboError: Bad input, before any work starts.
        NoPathError: The goal cannot be reached.
        PosteriorError: A posterior's diagnostics are bad.
    """
    if isinstance(n_iterations, bool) or int(n_iterations) != n_iterations or n_iterations < 1:
        raise TrustboError(f"n_iterations must be a whole number from 1 on; got {n_iterations!r}.")
    campaign = Campaign(
        workspace,
        start,
        goal,
        model=model,
        policy=policy,
        objective=objective,
        sampler=sampler,
        initial=initial,
        connectivity=connectivity,
        max_bounds=max_bounds,
        seed=seed,
    )
    runner = KinematicSimulator(workspace) if simulator is None else simulator
    folder = None if checkpoint is None else require_folder(checkpoint)
    describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
    settings = {
        **campaign.settings,
        **describe(),
        "trustbo_version": version("trustbo"),
        "start": campaign.planner.start,
        "goal": campaign.planner.goal,
    }
    rows: list[dict[str, object]] = []
    with tqdm(total=n_iterations, desc="missions", disable=not progress) as bar:
        for _ in range(n_iterations):
            rows.append(_iteration(campaign, runner))
            bar.set_postfix_str(
                f"objective {rows[-1]['objective']:.3f}, R-hat {rows[-1]['r_hat']:.3f}"
            )
            bar.update()
            for callback in callbacks:
                callback(campaign, campaign.missions[-1])
            if folder is not None and len(rows) < n_iterations:
                _result(campaign, rows, settings, "interrupted").save(folder)
    result = _result(campaign, rows, settings, "n_iterations")
    if folder is not None:
        result.save(folder)
    return result


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


def _iteration(campaign: Campaign, simulator: Simulator) -> dict[str, object]:
    """One mission, from plan to posterior; what the history keeps of it."""
    clock = time.perf_counter
    t0 = clock()
    plan = campaign.ask()
    trust_map = campaign.trust_map()
    t1 = clock()
    mission = simulator.run(plan.path, seed=campaign.seed_of("mission"))
    t2 = clock()
    before = campaign.plans[-1] if campaign.plans else plan
    posterior = campaign.tell(mission)
    return {
        "plan": plan,
        "trust_map": trust_map,
        "objective": plan.value,
        "path_changed": plan.path != before.path,
        "contact_rate": float(np.nanmean(mission.contact_rate)),
        "status": mission.status,
        **diagnostics(posterior),
        "seconds_plan": t1 - t0,
        "seconds_run": t2 - t1,
        "seconds_fit": clock() - t2,
    }


def _result(
    campaign: Campaign, rows: list[dict[str, object]], settings: dict[str, object], reason: str
) -> Result:
    recommended = campaign.recommend()
    plans: list[Plan] = [row["plan"] for row in rows]  # pyright: ignore[reportAssignmentType]
    steps = np.full((len(rows), max(len(plan.path) for plan in plans), 2), -1)
    for i, plan in enumerate(plans):
        steps[i, : len(plan.path)] = plan.path
    scalars = {name: [row[name] for row in rows] for name in rows[0] if name not in _NOT_SCALAR}
    maps: list[xr.DataArray] = [row["trust_map"] for row in rows]  # pyright: ignore[reportAssignmentType]
    iteration = xr.DataArray(np.arange(1, len(rows) + 1), dims="iteration", name="iteration")
    history = xr.Dataset(
        {
            **{name: ("iteration", values) for name, values in scalars.items()},
            "path": (("iteration", "step", "axis"), steps),
            "trust_map": xr.concat(maps, dim=iteration),
        },
        {"iteration": iteration, "axis": ["row", "col"]},
    )
    return Result(
        campaign.workspace,
        list(campaign.missions),
        list(campaign.posteriors),
        list(recommended.path),
        recommended.trust,
        recommended.value,
        campaign.trust_map(),
        history,
        settings,
        reason,
    )


_NOT_SCALAR = ("plan", "trust_map")


def _save_posteriors(folder: Path, posteriors: list[xr.DataTree]) -> None:
    for j, posterior in enumerate(posteriors, start=1):
        path = folder / "posteriors" / f"{j:04d}.nc"
        # A posterior never changes once computed: a checkpoint writes the new one only.
        if j == len(posteriors) or not path.exists():
            archive.write_file(path, lambda f, p=posterior: p.to_netcdf(f))
    archive.write_file(folder / "posterior.nc", lambda f: posteriors[-1].to_netcdf(f))


def _path_text(path: np.ndarray) -> str:
    return " ".join(f"{row},{col}" for row, col in path if row >= 0)
