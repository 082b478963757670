"""A campaign: ask for a path, run it by whatever means, tell what was measured."""

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
import xarray as xr
from jax import random

from trustbo.data import Cell, Mission
from trustbo.errors import PosteriorError, ShapeError, TrustboError, require_choice, require_whole
from trustbo.journal import Journal
from trustbo.learning import INITIAL, Learning
from trustbo.logbook import Logbook
from trustbo.models import PooledTrust, TrustModel, diagnostics, params_of
from trustbo.models.params import Params
from trustbo.models.record import model_from_record, model_to_record
from trustbo.planning import AwarenessBelief, Plan, Planner, Policy
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.planning.policies import greedy, resolve_policy
from trustbo.result import Result
from trustbo.stacking import fill_awareness
from trustbo.terrain import Workspace

AWARENESS = ("map", "belief")
_STREAMS = ("policy", "fit", "mission", "prior", "awareness")
_N_MAPS = 500  # drawn of the awareness that is believed in
_N_KEPT = 200  # of these, in a result


class Campaign:
    """Learns from missions and proposes the next path.

    With a `directory`, every mission is on disk before anything is learned from it, and everything
    before the next is asked for: `Campaign.load` goes on where the process ended, and gives what it
    would have given.

    Attributes:
        workspace: Where.
        planner: Finds the paths.
        log: What it has been through (a `Logbook`): missions as measured, plans, history, failures.
        pending: A mission that was told, but nothing could be learned from it; see `tell`.
        belief: Parameter draws the next plan is made from: the posterior's, or, before the first
            mission, one from the prior.
        awareness: What is believed of the awareness map, if it is not trusted blindly.
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Cell,
        goal: Cell,
        *,
        model: TrustModel | None = None,
        policy: str | Policy = "greedy",
        objective: str = "terminal",
        sampler: str = "nuts",
        initial: str = "prior_draw",
        update: str = "refit",
        forgetting: float = 1.0,
        connectivity: int = 8,
        max_bounds: int | str | None = None,
        team: str = "mean",
        length_weight: float = 0.0,
        awareness: str | AwarenessBelief = "map",
        seed: int = 0,
        directory: str | PathLike[str] | None = None,
    ) -> None:
        """Set up; nothing is computed yet.

        Args:
            workspace: Where.
            start: First cell of every path.
            goal: Last cell of every path.
            model: The trust model; by default `PooledTrust()`.
            policy: Name of a policy, or a callable `policy(key, draws, planner) -> Plan`.
            objective: See `Planner`.
            sampler: See `trustbo.models.fit`.
            initial: What the first plan is made from: `"prior_draw"`, one random draw from the
                prior as in the paper, or `"prior_mean"`.
            update: `"refit"`, from all missions so far; or, for comparison with the authors' later
                code, `"moment_matched"`: from the last mission alone, its prior having the mean and
                sd of the posterior before, which is not exact.
            forgetting: How much a mission counts relative to the next, in (0, 1]; below 1, a change
                of the environment is followed. For `"refit"` with Gaussian observations.
            connectivity: 4, or 8 to allow diagonal bounds too.
            max_bounds: See `Planner`.
            team: See `Planner`.
            length_weight: See `Planner`.
            awareness: `"map"`: plans trust the workspace's awareness map. `"belief"`: it is in
                doubt, and corrected by what missions measure; policies draw from what it may be. Or
                an `AwarenessBelief` of your own.
            seed: Same seed and same missions, same campaign.
            directory: A folder where the campaign is kept as it goes. Nobody else may use it until
                `close`, or the end of the process.

        Raises:
            TrustboError: Start, goal or a name that does not exist; a sampler that does not suit
                the model; or a model that cannot be updated so.
            NoPathError: The goal cannot be reached.
        """
        require_choice("initial", initial, INITIAL)
        self._policy = resolve_policy(policy)
        self.planner = Planner(
            workspace,
            start,
            goal,
            objective,
            connectivity=connectivity,
            max_bounds=max_bounds,
            team=team,
            length_weight=length_weight,
        )
        self.workspace, self.seed = workspace, require_whole("seed", seed, 0)
        self.model = PooledTrust() if model is None else model
        self._learning = Learning(self.model, sampler, update, forgetting)
        self.log = Logbook()
        self.pending: Mission | None = None
        self.awareness = _belief_in(workspace, awareness)
        self._plan: Plan | None = None
        self._believed: Planner | None = None
        self._asked = (0.0, 0.0)  # seconds that planning took, and when it was done
        sizes = workspace.awareness.sizes
        self.belief: Params = self._learning.prior_belief(
            initial, sizes["robot"], sizes["feature"], self.seed_of("prior")
        )
        own = getattr(policy, "__name__", type(policy).__name__)
        self.settings = {
            "start": list(self.planner.start),
            "goal": list(self.planner.goal),
            "model": type(self.model).__name__,
            "policy": policy if isinstance(policy, str) else own,
            "objective": self.planner.objective,
            "sampler": sampler,
            "initial": initial,
            "observation": self.model.observation,
            "response": self.model.response,
            "update": update,
            "forgetting": self._learning.forgetting,
            "connectivity": connectivity,
            "team": team,
            "length_weight": length_weight,
            "awareness": "map" if self.awareness is None else "belief",
            "max_bounds": self.planner.max_bounds,
            "seed": self.seed,
        }
        # As it was given: what `load` gives back to this method.
        self._options = {name: self.settings[name] for name in _OPTIONS} | {
            "max_bounds": max_bounds,
            "model": model_to_record(self.model),
            "own_policy": not isinstance(policy, str),
            "own_awareness": isinstance(awareness, AwarenessBelief),
        }
        self._journal: Journal | None = None
        if directory is not None:
            self._open(Journal(directory), overwrite=False)

    @property
    def missions(self) -> list[Mission]:
        """All missions learned from so far, awareness filled in."""
        return self.log.missions

    @property
    def posteriors(self) -> list[xr.DataTree]:
        """The posterior after each of them."""
        return self.log.posteriors

    @property
    def plans(self) -> list[Plan]:
        """The plan each of them was asked for with."""
        return self.log.plans

    @property
    def posterior(self) -> xr.DataTree | None:
        """The posterior after the last mission; None before the first."""
        return self.posteriors[-1] if self.posteriors else None

    # --- what is done with it ---

    def ask(self) -> Plan:
        """The next path to run; the same one until `tell`, `fail` or `suggest`.

        Raises:
            TrustboError: The policy returned a path that is broken, or no plan.
        """
        if self._plan is None:
            started = time.perf_counter()
            key, planner = random.key(self.seed_of("policy")), self.planner_now()
            plan = self._policy(key, self.belief, planner)
            name = self.settings["policy"]
            if not isinstance(plan, Plan):
                raise TrustboError(f"the policy {name!r} must return a Plan; got {plan!r}.")
            try:
                planner.require_path(plan.path)
            except TrustboError as error:
                raise TrustboError(f"the policy {name!r}: {error}") from None
            self._plan = self._accept(plan, started)
        return self._plan

    def suggest(self, path: Sequence[Cell]) -> Plan:
        """Let the operator choose the next path; `ask` then returns it.

        Args:
            path: Cells from start to goal.

        Raises:
            TrustboError: It is broken, or does not lead from start to goal.
        """
        started = time.perf_counter()
        plan = self.planner_now().evaluate(path, self.belief.mean())
        self._plan = self._accept(plan, started)
        self._write_state()
        return self._plan

    def tell(self, mission: Mission, **extra: float) -> xr.DataTree:
        """Learn from a mission.

        Awareness that the mission did not measure (NaN) is taken from what is believed of it. The
        mission may have followed another path than the one asked for.

        Args:
            mission: What was measured, whether or not the goal was reached.
            **extra: More for this mission's row of the history, such as its regret.

        Returns:
            The posterior given all missions so far.

        Raises:
            ShapeError: Robots or features differ from the workspace's.
            TrustboError: The path leaves the grid, or what `fit` refuses.
            PosteriorError: The posterior's diagnostics are bad. The mission is then not among
                those learned from, but kept as `pending`, and on disk, until the next is told.
        """
        self._require_ours(mission)
        filled = fill_awareness(mission, self.planner_now().mean_awareness)
        plan, trust_map = self.ask(), self.trust_map()
        told = time.perf_counter()
        if self._journal is not None:
            self._journal.write_measured([*self.log.measured, mission])
        missions, last = [*self.missions, filled], self.posterior
        self.pending = mission
        posterior = self._learning.posterior(missions, last, self.seed_of("fit"))
        # Only now, all at once: a failed fit leaves the campaign as it was.
        before = self.plans[-1] if self.plans else plan
        row = {
            "objective": plan.value,
            "path_changed": plan.path != before.path,
            "contact_rate": float(np.nanmean(mission.contact_rate)),
            "status": mission.status,
            **extra,
            **diagnostics(posterior),
            "seconds_plan": self._asked[0],
            "seconds_run": told - self._asked[1],
            "seconds_fit": time.perf_counter() - told,
        }
        log = self.log
        entries = (filled, mission, plan, trust_map, row, posterior)
        columns = (log.missions, log.measured, log.plans, log.maps, log.rows, log.posteriors)
        for column, entry in zip(columns, entries, strict=True):
            column.append(entry)  # pyright: ignore[reportArgumentType]
        self._learned(mission)
        self._write()
        return posterior

    def fail(self, reason: str, mission: Mission | None = None) -> xr.DataTree | None:
        """Say that the mission asked for was given up.

        Args:
            reason: Why, for the record.
            mission: Its bounds as far as they were run, to learn from; None if there are none.

        Returns:
            The posterior, if there was something to learn.

        Raises:
            TrustboError: As `tell`.
        """
        posterior = None if mission is None else self.tell(mission)
        self.log.failures.append((len(self.missions), str(reason)))
        self._plan = None
        self._write_state()
        return posterior

    def recommend(self) -> Plan:
        """The best path under the mean of the belief, whatever the policy would try next."""
        return greedy(random.key(0), self.belief, self.planner_now())

    def trust_map(self) -> xr.DataArray:
        """The team's trust map under the mean of the belief, dims (row, col)."""
        return self.planner_now().trust_map(self.belief.mean())

    # --- what it has come to ---

    @property
    def history(self) -> xr.Dataset:
        """What `Result.history` holds; empty before the first mission."""
        return self.log.history()

    def summary(self) -> pd.DataFrame:
        """One row per mission: what was planned, how it ended, what was learned."""
        return self.log.summary()

    @property
    def last(self) -> Mapping[str, Any]:
        """The last mission's row of the history.

        Raises:
            TrustboError: There is none yet.
        """
        if not self.log.rows:
            raise TrustboError("the campaign has no mission yet; tell it one first.")
        return self.log.rows[-1]

    def result(self) -> Result:
        """Everything learned so far, as `iterate` returns it.

        Raises:
            TrustboError: Nothing was learned yet.
        """
        if not self.missions:
            raise TrustboError("the campaign has no mission yet; tell it one first.")
        best = self.recommend()
        return Result(
            self.workspace,
            list(self.missions),
            list(self.posteriors),
            list(best.path),
            best.trust,
            best.value,
            self.trust_map(),
            self.history,
            {**self.settings, **self.log.notes, "trustbo_version": version("trustbo")},
            self.log.stop_reason,
            self._believed_awareness(),
        )

    # --- on disk ---

    def keep(self, directory: str | PathLike[str]) -> None:
        """Write everything to a folder, replacing what is there, and keep it up to date from now.

        Raises:
            TrustboError: Another campaign holds the folder, or its name belongs to a file.
        """
        self.close()
        self._open(Journal(directory), overwrite=True)

    def save(self, directory: str | PathLike[str]) -> None:
        """Write everything to a folder that `Campaign.load` reads.

        What another campaign left there is replaced. To keep a campaign as it goes, give it a
        `directory` when it is made.

        Raises:
            TrustboError: Another campaign holds the folder, or its name belongs to a file.
        """
        own, self._journal = self._journal, None
        here = own is not None and own.folder.resolve() == Path(directory).resolve()
        journal = own if own is not None and here else Journal(directory)
        try:
            self._open(journal, overwrite=True)
        finally:
            self._journal = own
            if journal is not own:
                journal.close()

    @classmethod
    def load(
        cls,
        directory: str | PathLike[str],
        *,
        model: TrustModel | None = None,
        policy: Policy | None = None,
        awareness: AwarenessBelief | None = None,
    ) -> Self:
        """Go on with a campaign where it stopped, in the same folder.

        A mission that was told, but not yet learned from, is learned from now.

        Args:
            directory: The folder of its `directory`, or of `save`.
            model: Needed again if it has priors of your own, or is your own.
            policy: Needed again if it is your own.
            awareness: Needed again if it is your own; as it was before the first mission.

        Raises:
            TrustboError: There is no campaign; another process is at work on it; or something of
                your own is missing.
        """
        journal = Journal.existing(directory)
        try:
            state, measured, learned = journal.read()
            options = state["options"]
            for name, given in (("policy", policy), ("awareness", awareness)):
                options[name] = _again(name, options[name], given, options.pop(f"own_{name}"))
            options["model"] = model_from_record(options["model"], model)
            start, goal = (tuple(options.pop(name)) for name in ("start", "goal"))
            campaign = cls(journal.read_workspace(), start, goal, **options)
        except BaseException:
            journal.close()
            raise
        campaign.log = Logbook.from_state(state, measured, learned)
        if campaign.log.measured:
            *earlier, latest = campaign.log.measured
            if campaign.awareness is not None:
                for mission in earlier:
                    campaign.awareness.update(mission)
            campaign._learned(latest)
        suggested = state["suggested"]
        campaign._plan = suggested and plan_from_record(suggested)
        campaign._journal = journal
        if len(measured) > len(campaign.missions):
            try:
                campaign.tell(measured[-1])
            except PosteriorError as error:
                warnings.warn(f"the last mission is pending: {error}", stacklevel=2)
        return campaign

    def stop(self, reason: str) -> Result:
        """Say why the campaign ends, and what it came to; it may still go on later.

        Args:
            reason: For `Result.stop_reason`.
        """
        self.log.stop_reason = reason
        result = self.result()
        if self._journal is not None:
            self._journal.write(self._state(), result)
        return result

    def close(self) -> None:
        """Let go of the folder; the campaign is kept there no longer."""
        if self._journal is not None:
            self._journal.close()
            self._journal = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _open(self, journal: Journal, *, overwrite: bool) -> None:
        """Write all of it to a folder, and keep it there from now on."""
        if journal.is_used and not overwrite:
            journal.close()
            raise TrustboError(
                f"{str(journal.folder)!r} holds a campaign already: go on with it by "
                "Campaign.load, or choose another folder."
            )
        journal.clear()
        journal.write_workspace(self.workspace)
        if self.log.measured:
            journal.write_measured(self.log.measured)
        self._journal = journal
        self._write(whole=True)

    def _write(self, *, whole: bool = False) -> None:
        if self._journal is not None:
            result = self.result() if self.missions else None
            self._journal.write(self._state(), result, whole=whole)

    def _write_state(self) -> None:
        if self._journal is not None:
            self._journal.write(self._state(), None)

    def _state(self) -> dict[str, Any]:
        plan = None if self._plan is None else plan_to_record(self._plan)
        return {"options": self._options, "suggested": plan, **self.log.to_state()}

    # --- inside ---

    def _accept(self, plan: Plan, started: float) -> Plan:
        bands = self.planner_now().bands(plan.path, self.belief)
        now = time.perf_counter()
        self._asked = now - started, now
        return replace(plan, bands=bands)

    def _learned(self, mission: Mission) -> None:
        """Go by what was learned, from a mission as it was told, from now on."""
        self.belief, self.pending = params_of(self.posteriors[-1]), None
        self._plan = self._believed = None
        if self.awareness is not None:
            self.awareness.update(mission)

    def _require_ours(self, mission: Mission) -> None:
        """Refuse a mission of another team, or somewhere else."""
        awareness = self.workspace.awareness
        if not isinstance(mission, Mission):
            raise TrustboError(f"tell takes a Mission; got {mission!r}.")
        for what, names in (("robot", mission.robots), ("feature", mission.features)):
            expected = tuple(str(name) for name in awareness[what].values)
            if names != expected:
                raise ShapeError(f"the mission has {what}s {names}, the workspace {expected}.")
        rows, cols = self.workspace.grid.shape
        for cell in mission.path:
            if not (0 <= cell[0] < rows and 0 <= cell[1] < cols):
                raise TrustboError(
                    f"the mission's path enters {cell}, outside the grid of {rows} rows and {cols} "
                    "columns."
                )

    def planner_now(self) -> Planner:
        """The planner, going by what is believed of the awareness now."""
        if self.awareness is None:
            return self.planner
        if self._believed is None:
            n_maps = min(_N_MAPS, self.belief.leading[0])
            maps = self.awareness.draw(n_maps, self.seed_of("awareness"))
            self._believed = self.planner.with_awareness(maps, self.awareness.mean())
        return self._believed

    def _believed_awareness(self) -> xr.Dataset | None:
        """`Result.believed`."""
        if self.awareness is None:
            return None
        like, planner = self.workspace.awareness, self.planner_now()
        # Single precision: they are written after every mission.
        maps = planner.awareness[:_N_KEPT].astype(np.float32)
        draws = xr.DataArray(maps, like.coords, ("draw", *like.dims))
        return xr.Dataset({"mean": like.copy(data=planner.mean_awareness), "draws": draws})

    def seed_of(self, stream: str) -> int:
        """The seed of one stream of randomness ("policy", "fit", "mission") at this iteration."""
        entropy = [self.seed, _STREAMS.index(stream), len(self.missions)]
        if n_failures := sum(n == len(self.missions) for n, _ in self.log.failures):
            entropy.append(n_failures)  # another try may choose another path
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])


_OPTIONS = (
    "start", "goal", "policy", "objective", "sampler", "initial", "update", "forgetting",
    "connectivity", "team", "length_weight", "awareness", "seed",
)  # fmt: skip


def _again(name: str, kept: object, given: object, was_own: bool) -> object:
    """What was kept, or, if it was the user's own, what is given again."""
    if was_own and given is None:
        raise TrustboError(
            f"the campaign's {name} was your own ({kept!r}); give it again with {name}=."
        )
    if given is not None and not was_own:
        raise TrustboError(f"the campaign's {name} is {kept!r}, none of your own; leave {name}=.")
    return kept if given is None else given


def _belief_in(workspace: Workspace, awareness: object) -> AwarenessBelief | None:
    if isinstance(awareness, AwarenessBelief):
        return awareness
    chosen = require_choice("awareness", awareness, AWARENESS)
    return AwarenessBelief(workspace) if chosen == "belief" else None
