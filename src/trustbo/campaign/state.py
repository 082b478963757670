"""State of a campaign: missions with plans and posteriors, and missions given up."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr

from trustbo.data import Cell, Mission, path_text
from trustbo.hazard.trials import LostMission
from trustbo.logs.netcdf import read_tree
from trustbo.planning import Plan

TOLD = "told"
"""State of a mission that is recorded, but not used for learning yet."""
LEARNED = "learned"
"""State of a mission that is used for learning."""
EXCLUDED = "excluded"
"""State of a mission that is not used for learning."""
GIVEN_UP = "given up"
"""State of a mission without data."""
_STREAMS = ("policy", "fit", "mission", "prior", "awareness", "hazard", "exclude")
"""Random streams; the seeds depend on their order, so add new names at the end."""


class Failure(NamedTuple):
    """Mission that was given up without measurements.

    Attributes:
        after: Number of missions recorded before it.
        reason: Reason, one of `hazard.CAUSES` if a bound failed.
        path: Planned path, start first; empty if no bound caused the failure.
        where: Cell that the team failed to enter, if known.
    """

    after: int
    reason: str
    path: tuple[Cell, ...] = ()
    where: Cell | None = None

    @property
    def lost(self) -> LostMission | None:
        """The mission for the hazard; None if no bound caused the failure."""
        return LostMission(self.path, self.where) if self.path else None

    def row(self) -> dict[str, Any]:
        """Return the failure's row in the table of missions."""
        return {
            "status": self.reason if self.path else "aborted",
            "state": GIVEN_UP,
            "reason": self.reason,
            "where": "" if self.where is None else path_text([self.where]),
            "n_bounds": np.nan if self.where is None else self.path.index(self.where, 1),
            "path_changed": False,
            "path": path_text(self.path),
        }


class StoredFile(NamedTuple):
    """File of a campaign.

    Attributes:
        path: Path of the file.
        sha256: Hash of its content.
    """

    path: Path
    sha256: str


@dataclass(eq=False)
class Posterior:
    """Posterior of the parameters after a mission.

    Attributes:
        name: Name of its file: the number of missions recorded when it was fitted, followed by the
            number of excluded missions if there are any, such as `"0003-1"`.
        tree: Draws in memory; None if they are stored only in `file`.
        file: File of the draws; None if they have not been written.
    """

    name: str
    tree: xr.DataTree | None = None
    file: StoredFile | None = None

    def __call__(self) -> xr.DataTree:
        """Return the draws; raises TrustboError if the file cannot be read."""
        if self.tree is not None:
            return self.tree
        if self.file is None:
            raise ValueError("a posterior is in memory or in a file")
        return read_tree(*self.file)


def incomplete_bounds(mission: Mission) -> list[tuple[int, Cell, str]]:
    """Return the number (from 1), the cell and the status of each bound that was not completed."""
    bounds = zip(mission.bounds, mission.statuses, strict=True)
    return [
        (k, bound.cell, status) for k, (bound, status) in enumerate(bounds, 1) if status != "ok"
    ]


@dataclass(eq=False)
class Entry:
    """Recorded mission, with its plan and the posterior after it.

    Attributes:
        plan: Plan returned by `ask`.
        measured: Mission with the measured awareness.
        mission: Mission with the awareness used for learning; see `learning.as_learned`.
        trust_map: Trust map used for planning, dims (row, col).
        row: Values of the mission in `Result.table`, keyed by column, including the `state`
            (`TOLD`, `LEARNED` or `EXCLUDED`) and the `reason` for this state.
        posterior: Posterior after this mission; None if there is none yet.
    """

    plan: Plan
    measured: Mission
    mission: Mission
    trust_map: xr.DataArray
    row: dict[str, Any]
    posterior: Posterior | None = None

    @property
    def shown_row(self) -> dict[str, Any]:
        """The row, where a blank reason is replaced by the statuses of incomplete bounds."""
        statuses = [status for _, _, status in incomplete_bounds(self.mission)]
        reason = self.row["reason"] or ", ".join(dict.fromkeys(statuses))
        return self.row | {"reason": reason}

    def become(self, state: str, reason: str = "") -> None:
        """Change the state of the mission, in a new row, so that the change can be undone."""
        self.row = self.row | {"state": state, "reason": reason}


class EarlierMissions(NamedTuple):
    """Missions of earlier campaigns; see `earlier`.

    Attributes:
        missions: Measured missions with the awareness used for learning. All have the same robots:
            those of the campaign, followed by the others.
        lost: Missions without measurements in which a bound of the campaign's map failed.
    """

    missions: tuple[Mission, ...] = ()
    lost: tuple[LostMission, ...] = ()


@dataclass(eq=False)
class State:
    """Data of a campaign: the contents of its folder, except for the workspace.

    Attributes:
        settings: Arguments of the campaign, JSON-serialisable.
        entries: Recorded missions, in order.
        failures: Missions that were given up.
        asked: Plan returned by `ask` and not run yet.
        simulation: Settings reported by the simulator, and `n_iterations`.
        stop_reason: Reason why the last run ended.
        due: Seed of the fit that is due because the missions have changed; None if the posterior
            is up to date, or if learning is retried after the next mission.
        earlier: Missions of earlier campaigns, which enter every fit.
        initial: Posterior given the missions of earlier campaigns; None if there are none.
    """

    settings: dict[str, Any]
    entries: list[Entry] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    asked: Plan | None = None
    simulation: dict[str, Any] = field(default_factory=dict)
    stop_reason: str = "interrupted"
    due: int | None = None
    earlier: EarlierMissions = field(default_factory=EarlierMissions)
    initial: Posterior | None = None

    @property
    def last(self) -> Posterior | None:
        """Posterior after the last mission; None if no mission has been used for learning."""
        return self.entries[-1].posterior if self.entries else self.initial

    @property
    def stored(self) -> list[Posterior]:
        """All posteriors, in order and without duplicates."""
        found = [self.initial, *(entry.posterior for entry in self.entries)]
        return list(dict.fromkeys(posterior for posterior in found if posterior is not None))

    @property
    def posterior(self) -> xr.DataTree | None:
        """Posterior of the parameters after the last mission; None if nothing was learned."""
        return None if self.last is None else self.last()

    @property
    def lost(self) -> list[LostMission]:
        """Missions without measurements in which a bound failed, earlier campaigns' first."""
        own = [failure.lost for failure in self.failures if failure.lost is not None]
        return [*self.earlier.lost, *own]

    def copy(self) -> Self:
        """Return a state whose missions and failures can change independently of this one."""
        entries = [replace(entry) for entry in self.entries]
        return replace(self, entries=entries, failures=list(self.failures))

    def indices(self, *states: str) -> list[int]:
        """Return the indices of the missions in one of these states."""
        return [j for j, entry in enumerate(self.entries) if entry.row["state"] in states]

    def seed_of(self, stream: str) -> int:
        """Return the seed of one random stream for the next mission."""
        n = len(self.entries)
        entropy = [self.settings["seed"], _STREAMS.index(stream), n]
        if stream == "exclude":  # several fits may follow one mission
            entropy.append(len(self.indices(EXCLUDED)))

        n_failures = sum(failure.after == n for failure in self.failures)
        if n_failures:
            entropy.append(n_failures)  # after `fail`, a random policy may choose another path
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def row_of(self, plan: Plan, mission: Mission) -> dict[str, Any]:
        """Return the row of a new mission for `Result.table`."""
        before = self.entries[-1].plan if self.entries else plan

        n_planned = len(mission.path) - 1
        if mission.path[-1] != plan.path[-1]:  # the path no longer contained the goal
            n_planned = max(n_planned, len(plan.path) - 1)
        rates = mission.contact_rate
        failed = [cell for _, cell, _ in incomplete_bounds(mission)]
        contact = float(np.nanmean(rates)) if np.isfinite(rates).any() else np.nan

        return {
            "objective": plan.value,
            "path_changed": plan.path != before.path,
            "contact_rate": contact,
            "contact_lost": _contact_lost(rates, n_planned),
            "status": mission.status,
            "state": TOLD,
            "reason": "",
            "where": path_text(failed),
            "n_bounds": len(mission.bounds),
            "n_unmeasured": int(np.isnan(rates).all(axis=1).sum()),
            "path": path_text(plan.path),
        }


def _contact_lost(rates: np.ndarray, n_planned: int) -> float:
    """Sum the contact lost over the bounds of a mission, in bounds; NaN without any rate.

    In each bound, the contact is the mean of the measured robots. A bound without any rate counts
    as the mean of the other bounds, and a bound that was not run loses all contact.

    Args:
        rates: Contact rates of the bounds that were run, shape (bound, robot); NaN if unknown.
        n_planned: Number of bounds of the path.
    """
    is_measured = np.isfinite(rates).any(axis=1)
    if not is_measured.any():
        return np.nan

    of_bound = np.nanmean(rates[is_measured], axis=1)
    contact = np.full(len(rates), of_bound.mean())
    contact[is_measured] = of_bound

    # One mean of all rates: missions without gaps keep their value to the last bit.
    filled = np.where(np.isnan(rates), contact[:, None], rates)
    return n_planned - len(rates) * float(filled.mean())
