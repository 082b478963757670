"""History of a campaign, mission by mission."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.campaign.damage import naming_what_is_left
from trustbo.campaign.failures import Failure
from trustbo.data import Mission, path_text
from trustbo.errors import DamagedFileError
from trustbo.files import checksum
from trustbo.inference import complete
from trustbo.inference.posterior_groups import parameters_alone
from trustbo.logs.netcdf import read_tree
from trustbo.models import TrustModel
from trustbo.models.backend import VERSIONS
from trustbo.planning import Plan
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.workspace import Workspace

TOLD, LEARNED, SET_ASIDE = "told", "learned", "set aside"
"""States of a mission: on disk, in the posterior, or never to be."""
GIVEN_UP = "given up"
"""State of a mission without a report, in tables."""


class Posterior:
    """A posterior in memory, or in a file until it is asked for.

    Attributes:
        after: Number of missions told when it was fitted; also that of its file.
        file: File that holds it; None where it is in memory only.
    """

    def __init__(
        self, after: int, tree: xr.DataTree | None = None, file: Path | None = None
    ) -> None:
        """Hold a tree, or the name of a file of `logs.netcdf.write_tree`."""
        self.after, self.file, self._tree = after, file, tree
        self._sum = None if file is None else checksum(file)

    def __call__(self) -> xr.DataTree:
        """Posterior as it is kept: parameters alone, unless its trust was sampled too.

        Raises:
            DamagedFileError: Its file is missing, damaged or another's by now.
        """
        if self._tree is None:
            file = Path(self.file or "")
            with naming_what_is_left(file.parent.parent):
                if checksum(file) != self._sum:
                    raise DamagedFileError(f"{str(file)!r} was replaced since it was opened.")
                self._tree = read_tree(file)
        return self._tree

    def shrink(self) -> None:
        """Keep the parameters alone from now on; a later posterior has the rest."""
        if self._tree is not None and "latent" in self._tree.children:
            self._tree, self.file = parameters_alone(self._tree), None


class Posteriors(Sequence[xr.DataTree]):
    """Posterior after each mission told; None where nothing could be learned yet."""

    def __init__(self, kept: Iterable[Posterior | None]) -> None:
        """Take posteriors as they are kept."""
        self.kept = list(kept)

    def __len__(self) -> int:
        return len(self.kept)

    def __iter__(self) -> Iterator[xr.DataTree]:
        return (self[j] for j in range(len(self)))

    def __getitem__(self, j: Any) -> Any:
        if isinstance(j, slice):
            return Posteriors(self.kept[j])
        one = self.kept[j]
        return None if one is None else one()


def whole_posterior(
    kept: xr.DataTree, missions: Sequence[Mission], model: TrustModel | None = None
) -> xr.DataTree:
    """Posterior with all groups, its missions labelled by their numbers in the campaign, from 0.

    Args:
        kept: Posterior as a campaign keeps it.
        missions: All missions told so far, their awareness filled in.
        model: Its model, for `log_prior`; needed where the priors are the user's own.
    """
    if "missions" not in kept.attrs:  # of version 0.1, whole already
        return kept
    numbers = np.atleast_1d(kept.attrs["missions"]).astype(int)
    whole = complete(kept, [missions[j] for j in numbers], model=model)
    parts = {name: part.to_dataset() for name, part in whole.children.items()}
    for name, part in parts.items():
        if "mission" in part.dims:
            parts[name] = part.assign_coords(mission=numbers)
    labelled = xr.DataTree.from_dict(parts)
    labelled.attrs = whole.attrs
    return labelled


_FIRST = (
    "status", "state", "reason", "where", "contact_rate", "objective", "n_bounds", "path_changed",
    "path",
)  # fmt: skip
"""First columns of a table of missions."""


def table_of(
    history: xr.Dataset, missions: Sequence[Mission], failures: Sequence[Failure] = ()
) -> pd.DataFrame:
    """Table with a row for each mission of a history, labelled by its number, from 1.

    Columns are the scalars of `Result.history`, `n_bounds`, the number of bounds that were run, the
    cell `where` one failed, and the `path` as text, "9,0 8,1"; first those of the outcome, then
    diagnostics and seconds. A mission given up without a report has a row too, without a number,
    after the missions told before it.
    """
    reasons = {f.after: f.reason for f in failures if f.told}
    columns: dict[str, Any] = {
        str(n): a.values.tolist() for n, a in history.data_vars.items() if a.dims == ("iteration",)
    }
    if missions:
        states = columns.get("reason", [""] * len(missions))
        columns |= {
            "reason": [said or reasons.get(n, "") for n, said in enumerate(states, start=1)],
            "where": ["" if m.status == "ok" else path_text([m.bounds[-1].cell]) for m in missions],
            "n_bounds": [len(mission.bounds) for mission in missions],
            "path": [path_text(p[p[:, 0] >= 0].tolist()) for p in history["path"].values],
        }
    told = zip(*columns.values(), strict=True)
    rows: list[tuple[int | None, dict[str, Any]]] = [
        (n, dict(zip(columns, row, strict=True))) for n, row in enumerate(told, start=1)
    ]
    lost = [failure for failure in failures if not failure.told]
    for failure in reversed(lost):  # a later one does not move the place of those before
        rows.insert(failure.after, (None, _row_of(failure)))
    names = [name for name in _FIRST if name in columns or lost]
    names += [name for name in columns if name not in names]
    numbers = [number for number, _ in rows]
    index = pd.Index(numbers, dtype="Int64", name="mission") if lost else None
    if index is None:
        index = pd.RangeIndex(1, len(missions) + 1, name="mission")
    return pd.DataFrame([row for _, row in rows], index, names)


def _row_of(failure: Failure) -> dict[str, Any]:
    """Row of a mission that was given up without a report, as far as it is known."""
    path, where = list(failure.path), failure.where
    return {
        "status": failure.reason if failure.path else "aborted",
        "state": GIVEN_UP,
        "reason": failure.reason,
        "where": "" if where is None else path_text([where]),
        "contact_rate": np.nan,
        "objective": np.nan,
        "n_bounds": np.nan if where is None else path.index(where, 1),
        "path_changed": False,
        "path": path_text(path),
    }


@dataclass(eq=False)
class Entry:
    """One mission that was told.

    Attributes:
        mission: Mission, its awareness filled in where it was not measured.
        measured: The same mission as it was told.
        plan: Plan that it was asked for with.
        trust_map: Trust map that it was planned on, dims (row, col).
        row: Numbers of the mission, by name; its `state` and the `reason` of that among them.
        posterior: Posterior after it; None where nothing could be learned yet.
        extra: Numbers that it was told with.
    """

    mission: Mission
    measured: Mission
    plan: Plan
    trust_map: xr.DataArray
    row: dict[str, Any]
    posterior: Posterior | None
    extra: dict[str, float] = field(default_factory=dict)

    @property
    def state(self) -> str:
        """State of the mission: told, learned or set aside."""
        return self.row["state"]

    def become(self, state: str, reason: str = "") -> None:
        """Change the state of the mission."""
        self.row |= {"state": state, "reason": reason}


class Kept(NamedTuple):
    """Missions of a saved result, the posterior after each, and `Result.history`."""

    missions: list[Mission]
    posteriors: Posteriors
    history: xr.Dataset


@dataclass(eq=False)
class History:
    """Missions that were told to a campaign, those that failed, and the reason of its end.

    Attributes:
        entries: One for each mission told.
        failures: Missions given up.
        notes: More for `Result.settings`, by the loop.
        stop_reason: Reason of the end.
    """

    entries: list[Entry] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    stop_reason: str = "interrupted"

    @property
    def missions(self) -> list[Mission]:
        """Missions told, their awareness filled in."""
        return [entry.mission for entry in self.entries]

    @property
    def measured(self) -> list[Mission]:
        """Missions as they were told."""
        return [entry.measured for entry in self.entries]

    @property
    def posteriors(self) -> Posteriors:
        """Posterior after each mission."""
        return Posteriors(entry.posterior for entry in self.entries)

    @property
    def last(self) -> Posterior | None:
        """Posterior after the last mission."""
        return self.entries[-1].posterior if self.entries else None

    @property
    def last_tree(self) -> xr.DataTree | None:
        """The tree of `last`; None where nothing could be learned yet."""
        return None if self.last is None else self.last()

    def numbers(self, *states: str) -> list[int]:
        """Numbers, from 0, of the missions in one of these states."""
        return [j for j, entry in enumerate(self.entries) if entry.state in states]

    def to_dataset(self) -> xr.Dataset:
        """`Result.history`; empty before the first mission."""
        if not self.entries:
            return xr.Dataset()
        plans, rows = [entry.plan for entry in self.entries], [entry.row for entry in self.entries]
        steps = np.full((len(rows), max(len(plan.path) for plan in plans), 2), -1)
        for i, plan in enumerate(plans):
            steps[i, : len(plan.path)] = plan.path
        # The exact sampler may have fallen back on NUTS, whose diagnostics are others: NaN then.
        names = {name: None for row in rows for name in row}
        scalars = {name: [row.get(name, np.nan) for row in rows] for name in names}
        trust_map = self.entries[0].trust_map
        # Older campaigns have numbers by names that are those of axes.
        axes = {*map(str, trust_map.coords), *map(str, trust_map.dims), "axis", "step", "iteration"}
        scalars = {f"told_{n}" if n in axes else n: values for n, values in scalars.items()}
        maps = np.stack([entry.trust_map.values for entry in self.entries])
        return xr.Dataset(
            {
                **{
                    name: ("iteration", values, {"units": "%"} if name == "regret" else {})
                    for name, values in scalars.items()
                },
                "path": (("iteration", "step", "axis"), steps),
                "trust_map": (("iteration", "row", "col"), maps, trust_map.attrs),
            },
            {
                "iteration": np.arange(1, len(rows) + 1),
                "axis": ["row", "col"],
                **trust_map.coords,
            },
        )

    def to_state(self) -> dict[str, Any]:
        """Everything that no file of a `Result` holds, as JSON can hold it."""
        return {
            "n_missions": len(self.entries),
            "plans": [plan_to_record(entry.plan) for entry in self.entries],
            "rows": [entry.row for entry in self.entries],
            "posterior_after": [e.posterior and e.posterior.after for e in self.entries],
            "failures": self.failures,
            "notes": self.notes,
            "stop_reason": self.stop_reason,
            "versions": VERSIONS | {"numpy": np.__version__},
        }

    @classmethod
    def from_state(
        cls,
        state: dict[str, Any],
        measured: Sequence[Mission],
        extras: Sequence[dict[str, float]],
        kept: Kept | None,
        workspace: Workspace,
    ) -> Self:
        """History of a state, of missions as they were told, and of a saved result."""
        entries: list[Entry] = []
        if kept is not None:
            n = state["n_missions"]
            maps = [kept.history["trust_map"].isel(iteration=i, drop=True) for i in range(n)]
            plans = [plan_from_record(record, workspace) for record in state["plans"]]
            before = {"state": LEARNED, "reason": ""}  # of version 0.1, which had no other
            rows = [row if "state" in row else row | before for row in state["rows"]]
            columns = (
                kept.missions, measured[:n], plans, maps, rows, kept.posteriors.kept, extras[:n]
            )  # fmt: skip
            entries = [Entry(*values) for values in zip(*columns, strict=True)]
        failures = [Failure.restore(record) for record in state["failures"]]
        return cls(entries, failures, state["notes"], state["stop_reason"])
