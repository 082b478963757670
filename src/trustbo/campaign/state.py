"""State of a campaign: missions with plans and posteriors, and missions given up."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from trustbo.campaign.closing import Closing, closed_by
from trustbo.campaign.course import Course
from trustbo.data import Cell, Mission, Station, cells_of, date_of, path_text, split_path
from trustbo.errors import TrustboError
from trustbo.files import read_file
from trustbo.hazard.trials import CAUSES, LostMission
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
EARLIER = "earlier"
"""State of a mission of an earlier campaign, which every fit uses."""
_STREAMS = ("policy", "fit", "mission", "prior", "awareness", "hazard", "exclude")
"""Random streams; the seeds depend on their order, so add new names at the end."""


class Failure(NamedTuple):
    """Mission that was given up without measurements.

    Attributes:
        after: Number of missions recorded before it.
        reason: Reason, one of `hazard.CAUSES` if a bound failed.
        path: Stations of the planned path, start first; empty if no bound caused the failure.
        where: Cell that the team failed to enter, if known. With a reason that is no cause of
            failures, such as "mud", it is known, but nothing is learned from it.
        withdrawn: Reason why a user has withdrawn the report, or an empty string.
    """

    after: int
    reason: str
    path: tuple[Station, ...] = ()
    where: Cell | None = None
    withdrawn: str = ""

    @property
    def lost(self) -> LostMission | None:
        """The mission for the hazard; None if no bound failed or the report is withdrawn."""
        is_used = self.path and self.reason in CAUSES and not self.withdrawn
        return LostMission(self.path, self.where) if is_used else None

    def row(self) -> dict[str, Any]:
        """Return the failure's row in the table of missions."""
        where = "" if self.where is None else path_text([self.where])
        ends = self.path[:1] + self.path[-1:]
        course = {n: path_text([a[:2]]) for n, a in zip(("start", "goal"), ends, strict=False)}
        return {
            **course,
            "status": self.reason if self.reason in CAUSES else "aborted",
            "state": EXCLUDED if self.withdrawn else GIVEN_UP,
            "reason": self.withdrawn or self.reason,
            "where": where,
            "failed_bounds": where and f"into {where} ({self.reason})",
            "n_bounds": np.nan if self.where is None else cells_of(self.path).index(self.where, 1),
            "path_changed": False,
            "replanned": False,
            "path": path_text(self.path),
        }


@dataclass(eq=False)
class Posterior:
    """Posterior of the parameters, which is computed from some of the missions.

    Attributes:
        name: Name of its file: the number of missions recorded when it was fitted, followed by the
            number of excluded missions if there are any, such as `"0003-1"`.
        used: Indices of the campaign's missions to which it was fitted, without earlier ones.
        diagnostics: Diagnostics of the sampler; see `inference.diagnostics`.
        tree: Draws in memory; None if they are stored only in `file`.
        file: Path and hash of the file of the draws; None if they have not been written.
    """

    name: str
    used: tuple[int, ...] = ()
    diagnostics: dict[str, float] = field(default_factory=dict)
    tree: xr.DataTree | None = None
    file: tuple[Path, str] | None = None

    def __call__(self) -> xr.DataTree:
        """Return the draws; raises TrustboError if the file cannot be read."""
        if self.tree is not None:
            return self.tree
        if self.file is None:
            raise ValueError("a posterior is in memory or in a file")
        return read_tree(*self.file)

    @property
    def after(self) -> int:
        """Number of missions recorded when it was fitted."""
        return int(self.name.split("-")[0])

    @property
    def is_lost(self) -> bool:
        """Whether the draws are only in a file that cannot be read any more."""
        if self.tree is not None or self.file is None:
            return False
        try:
            read_file(*self.file)
        except TrustboError:
            return True
        return False


def incomplete_bounds(mission: Mission) -> list[tuple[int, Cell, str]]:
    """Return the number (from 1), the cell and the status of each bound that was not completed."""
    bounds = zip(mission.bounds, mission.statuses, strict=True)
    return [
        (k, bound.cell, status) for k, (bound, status) in enumerate(bounds, 1) if status != "ok"
    ]


def why_never_learned(mission: Mission) -> str:
    """Return why a mission can never be used for learning, or an empty string."""
    if not np.isfinite(mission.contact_rate).any():
        return "no contact rate was measured."
    if np.isnan(mission.awareness).any():
        k = int(np.argwhere(np.isnan(mission.awareness))[0, 0])
        return f"the map has no awareness in cell {mission.bounds[k].cell} of bound {k + 1}."
    return ""


class Exclusion(NamedTuple):
    """Exclusion of a mission by a user.

    Attributes:
        after: Number of missions recorded before it.
        reason: Reason, as given by the user.
    """

    after: int
    reason: str


def measures_of(mission: Mission, path: Sequence[Station]) -> dict[str, Any]:
    """Return what a mission measured on a planned path, by column of `Result.table`."""
    n_planned = bounds_planned(mission, path)
    rates = mission.contact_rate
    failed = [cell for _, cell, _ in incomplete_bounds(mission)]
    contact = float(np.nanmean(rates)) if np.isfinite(rates).any() else np.nan
    lost = _contact_lost(rates, n_planned)
    _, post_sets = split_path(path)

    return {
        "contact_rate": contact,
        "contact_lost": lost,
        "lost_share": lost / n_planned,
        "status": mission.status,
        "where": path_text(failed),
        "failed_bounds": failed_bounds_text(mission),
        "n_bounds": len(mission.bounds),
        "n_unmeasured": int(np.isnan(rates).all(axis=1).sum()),
        "path": path_text(path),
        **({"posts": " ".join(post_sets)} if post_sets else {}),
        **({} if np.isnan(mission.began) else {"began": date_of(mission.began)}),
    }


def bounds_planned(mission: Mission, path: Sequence[Station]) -> int:
    """Return the number of bounds of a mission that followed a planned path."""
    n_planned = len(mission.path) - 1
    if mission.path[-1] != path[-1][:2]:  # the path no longer contained the goal
        n_planned = max(n_planned, len(path) - 1)
    return n_planned


def failed_bounds_text(mission: Mission) -> str:
    """Describe the bounds that were not completed, such as "2 into 1,2 (stuck)"."""
    return ", ".join(
        f"{k} into {path_text([cell])} ({status})" for k, cell, status in incomplete_bounds(mission)
    )


@dataclass(frozen=True, eq=False)
class Entry:
    """Recorded mission, with its plan and the posterior after it.

    Attributes:
        plan: Plan returned by `ask`.
        measured: Mission with the measured awareness.
        mission: Mission with the awareness used for learning; see `learning.as_learned`.
        trust_map: Trust map used for planning, dims (row, col).
        cause: What a user says about bounds that failed and from which no failure is learned, such
            as "mud (stuck)"; see `Campaign.tell`. They are aborted in both missions.
        exclusion: Exclusion by a user; None if there was none.
        posterior: Posterior after this mission; None if there is none yet.
    """

    plan: Plan
    measured: Mission
    mission: Mission
    trust_map: xr.DataArray
    cause: str = ""
    exclusion: Exclusion | None = None
    posterior: Posterior | None = None

    @property
    def course(self) -> Course:
        """Course of the plan."""
        return Course.of(self.plan)

    @cached_property
    def why_excluded(self) -> str | None:
        """Reason why the mission is not used for learning; None if it is used."""
        if self.exclusion is not None:
            return self.exclusion.reason
        return why_never_learned(self.mission) or None

    @cached_property
    def measures(self) -> dict[str, Any]:
        """Values of the mission in `Result.table`, by column, that depend on nothing else."""
        of_mission = measures_of(self.mission, self.plan.stations)
        return self.course.to_row() | of_mission | {"objective": self.plan.value}


type Planned = tuple[tuple[Station, ...], ...]
"""Planned path of a mission, and then those on which a bound failed; empty if not known."""


def planned_paths(plan: Plan) -> Planned:
    """Return the planned paths of a mission."""
    return (plan.stations, *plan.abandoned)


class EarlierMissions(NamedTuple):
    """Missions of earlier campaigns; see `earlier`.

    Attributes:
        missions: Measured missions with the awareness used for learning. All have the same robots:
            those of the campaign, followed by the others.
        planned: Planned paths of each mission.
        lost: Missions without measurements in which a bound of the campaign's map failed.
    """

    missions: tuple[Mission, ...] = ()
    planned: tuple[Planned, ...] = ()
    lost: tuple[LostMission, ...] = ()


@dataclass(frozen=True, eq=False)
class State:
    """What happened in a campaign: the contents of its folder, except for the workspace.

    A change is a new state. The posterior is a function of the missions that are used, the settings
    and the seed. It is up to date if the last fit, whether or not it succeeded, was of these
    missions.

    Attributes:
        settings: Arguments of the campaign, JSON-serialisable.
        entries: Recorded missions, in order.
        failures: Missions that were given up.
        closings: Cells and bounds that users closed, also those that no longer count.
        asked: Plan returned by `ask` and not run yet.
        simulation: Settings reported by the simulator, and `n_iterations`.
        stop_reason: Reason why the last run ended.
        fitted: Indices of the missions of the last fit.
        why_not: Reason why this fit failed; empty if it succeeded.
        earlier: Missions of earlier campaigns, which enter every fit.
        initial: Posterior given the missions of earlier campaigns; None if there are none.
    """

    settings: dict[str, Any]
    entries: tuple[Entry, ...] = ()
    failures: tuple[Failure, ...] = ()
    closings: tuple[Closing, ...] = ()
    asked: Plan | None = None
    simulation: dict[str, Any] = field(default_factory=dict)
    stop_reason: str = "interrupted"
    fitted: tuple[int, ...] | None = ()
    why_not: str = ""
    earlier: EarlierMissions = field(default_factory=EarlierMissions)
    initial: Posterior | None = None

    @property
    def used(self) -> tuple[int, ...]:
        """Indices of the missions that are not excluded."""
        return tuple(j for j, entry in enumerate(self.entries) if entry.why_excluded is None)

    @property
    def last(self) -> Posterior | None:
        """Posterior after the last mission; None if no mission has been used for learning."""
        return self.entries[-1].posterior if self.entries else self.initial

    @property
    def posteriors(self) -> list[Posterior]:
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

    @property
    def closed(self) -> dict[tuple[Cell, ...], str]:
        """What is closed for the next mission now, as in `Workspace.closed`."""
        return closed_by(self.closings, len(self.entries) + 1)

    def status_of(self, j: int) -> tuple[str, str]:
        """Return the state of the mission with index j, and the reason for it, which may be ""."""
        excluded = self.entries[j].why_excluded
        if excluded is not None:
            return EXCLUDED, excluded
        if self.last is not None and j in self.last.used:
            return LEARNED, ""
        return TOLD, self.why_not

    @property
    def earlier_here(self) -> dict[int, int]:
        """Indices of the earlier missions on this map that teach trust, by their label.

        The labels are negative, -1 for the last of all earlier missions that teach trust.
        """
        missions = self.earlier.missions
        usable = [i for i, mission in enumerate(missions) if not why_never_learned(mission)]
        labelled = zip(range(-len(usable), 0), usable, strict=True)
        return {label: i for label, i in labelled if not missions[i].map}

    def earlier_row(self, i: int) -> dict[str, Any]:
        """Return the row in `Result.table` of the earlier mission with index i."""
        mission = self.earlier.missions[i]
        planned = self.earlier.planned[i] or (mission.stations,)
        path = planned[0]

        measured = np.isfinite(mission.contact_rate).any(0)
        went = tuple(n for n, known in zip(mission.robots, measured, strict=True) if known)
        return {
            **Course(path[0][:2], path[-1][:2], went).to_row(),
            **measures_of(mission, path),
            "state": EARLIER,
            "reason": ", ".join(dict.fromkeys(one for _, _, one in incomplete_bounds(mission))),
            "objective": np.nan,
            "path_changed": False,
            "replanned": len(planned) > 1,
        }

    def row(self, j: int) -> dict[str, Any]:
        """Return the row of the mission with index j in `Result.table`.

        A blank reason is replaced by the statuses of incomplete bounds.
        """
        entry = self.entries[j]
        state, reason = self.status_of(j)
        failed = incomplete_bounds(entry.mission)
        if not reason and entry.cause:
            reason = entry.cause
        elif not reason:
            reason = ", ".join(dict.fromkeys(status for _, _, status in failed))

        posterior = entry.posterior
        is_own = posterior is not None and posterior.after == j + 1
        before = self.entries[max(j - 1, 0)]
        return {
            **entry.measures,
            "path_changed": entry.plan.stations != before.plan.stations,
            "replanned": entry.plan.is_replanned,
            "state": state,
            "reason": reason,
            **(posterior.diagnostics if posterior and is_own else {}),
        }

    def seed_of(self, stream: str, n: int | None = None) -> int:
        """Return the seed of one random stream after `n` missions; by default, after all so far."""
        n = len(self.entries) if n is None else n
        entropy = [self.settings["seed"], _STREAMS.index(stream), n]
        if stream == "exclude":  # several fits may follow one mission
            entropy.append(len(self.entries) - len(self.used))

        n_failures = sum(failure.after == n for failure in self.failures)
        if n_failures:  # also those withdrawn
            entropy.append(n_failures)  # after `fail`, a random policy may choose another path
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    @property
    def seed_of_fit(self) -> int:
        """Seed of the posterior of the missions that are used now."""
        n = len(self.entries)
        exclusions = [entry.exclusion for entry in self.entries if entry.exclusion is not None]
        if any(exclusion.after == n for exclusion in exclusions):
            return self.seed_of("exclude")
        return self.seed_of("fit", max(n - 1, 0))


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
