"""A campaign: ask for a path, run it by whatever means, tell the mission."""

import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
import xarray as xr
from jax import random

from trustbo.campaign.card import campaign_card
from trustbo.campaign.failures import Failure, require_another, require_reason, to_avoid, under_risk
from trustbo.campaign.folder import CampaignFolder
from trustbo.campaign.history import SET_ASIDE, TOLD, Entry, History
from trustbo.campaign.learned import LearnedMissions
from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER, CampaignOptions, again
from trustbo.campaign.replacing import STATE
from trustbo.campaign.result import Result
from trustbo.campaign.told import never_to_be_learned, require_extra, require_mission, require_new
from trustbo.data import Cell, Mission
from trustbo.display.card import Card, Displayed
from trustbo.errors import TrustboError, require_whole
from trustbo.files import FilePath, as_path, interpreting
from trustbo.hazard import CAUSES
from trustbo.inference import params_of
from trustbo.models import TrustModel
from trustbo.models.backend import VERSIONS
from trustbo.models.record import model_from_record, model_to_record
from trustbo.planning import Plan, Planner, Policy
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.planning.policies import resolve_policy
from trustbo.stacking import fill_awareness
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location
from trustbo.workspace.moves import along, moves_along, require_on_grid

_N_MAPS = 500
"""Draws of the awareness that plans are made with; the first `_N_KEPT` are in the result."""
_N_KEPT = 200


class Campaign(LearnedMissions, Displayed):
    """Learns from missions and proposes the next path.

    A mission is planned by `ask`, then told, then learned from. One that cannot be learned from yet
    stays told and is tried with every later one; one that never can be is set aside. With a
    `directory`, every mission is on disk before anything is learned from it, and everything before
    the next is asked for: `Campaign.load` goes on where the process ended, with identical results.

    Attributes:
        workspace: Workspace of the paths.
        options: Options of the campaign.
        policy: Policy that chooses the paths.
        planner: Planner on the workspace's awareness map; see `planner_now`.
        log: Missions as measured, their states, plans, posteriors and failures (a `History`).
        belief: Parameter draws that the next plan is made from: the posterior's, or, before the
            first mission, one from the prior.
        awareness: Belief about the awareness; None where the map is trusted.
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Location,
        goal: Location,
        *,
        model: TrustModel | None = None,
        policy: str | Policy = POLICY,
        objective: str = OBJECTIVE,
        sampler: str = SAMPLER,
        seed: int = 0,
        directory: FilePath | None = None,
        **options: Any,
    ) -> None:
        """Prepare a campaign; nothing is computed yet.

        Args:
            workspace: Workspace of the paths.
            start: First cell of every path, or a position in it; see `Workspace.locate`.
            goal: Last cell of every path, or a position in it.
            model: Trust model; by default `PooledTrust(place=PlaceEffect())`.
            policy: Name of a policy, or a callable `policy(key, draws, planner) -> Plan`.
            objective: Objective of the paths; see `Planner`.
            sampler: Sampler of the posterior; see `trustbo.fit`.
            seed: Seed of everything random.
            directory: Folder that the campaign is kept in as it goes. No other process may use it
                until `close`, or the end of this one.
            **options: Fields of `CampaignOptions`, or a whole one as `options`.

        Raises:
            TrustboError: Start, goal or a name that does not exist; a sampler that does not suit
                the model; or a model that cannot be updated so.
            NoPathError: The goal cannot be reached.
        """
        chosen = CampaignOptions.of(options, Campaign.__init__)
        self.policy = resolve_policy(policy)
        super().__init__(workspace, chosen, model, sampler, seed)
        law = self.observation, self.model.response
        self.planner = chosen.planner(workspace, start, goal, objective, *law)
        self.awareness = chosen.belief(workspace)
        self._plan: Plan | None = None
        self._believed: Planner | None = None
        self._asked = (0.0, 0.0)  # seconds that planning took, and the time when it was done
        own_policy = not isinstance(policy, str)
        named = {
            "start": list(self.planner.start),
            "goal": list(self.planner.goal),
            "policy": getattr(policy, "__name__", type(policy).__name__) if own_policy else policy,
            "objective": objective,
            "sampler": sampler,
            "seed": self.seed,
        }
        record = named | self.options.to_record()
        self.settings = record | {
            "model": type(self.model).__name__ + " with places" * (self.model.place is not None),
            "observation": self.model.observation,
            "response": self.model.response,
            "max_bounds": self.planner.max_bounds,
        }
        self._record = record | {
            "model": model_to_record(self.model),
            "own_policy": own_policy,
            "own_awareness": self.options.own_awareness,
        }
        self._folder: CampaignFolder | None = None
        if directory is not None:
            self._open(CampaignFolder(directory), overwrite=False)

    def _card(self) -> Card:
        told, settings = len(self.missions), self.settings
        others = {
            "set aside": len(self.log.numbers(SET_ASIDE)),
            "given up": len(self.log.failures),
        }
        also = "".join(f", {n} {what}" for what, n in others.items() if n)
        rows = [
            ("course", f"{tuple(settings['start'])} to {tuple(settings['goal'])}"),
            ("missions", f"{told} told, {len(self.waiting)} not learned from yet{also}"),
            ("model", self.model.in_short()),
            ("policy", f"{settings['policy']}, objective {settings['objective']}"),
        ]
        return campaign_card(
            f"Campaign: {told} missions", rows, self.workspace, settings, self.history,
            self.trust_map if told else None, lambda: self.recommend().path,
        )  # fmt: skip

    # --- ask and tell ---

    def ask(self) -> Plan:
        """Plan the next path to run; the same one until `tell`, `fail` or `suggest`.

        Raises:
            TrustboError: The policy returned a path that is broken, or no plan.
        """
        if self._plan is None:
            started = time.perf_counter()
            planner = self.planner_now()
            with jax.threefry_partitionable(True):  # else the caller's flag decides what is drawn
                key = random.key(self.seed_of("policy"), impl="threefry2x32")
                plan = self.policy(key, self.belief, planner)
            name = self.settings["policy"]
            if not isinstance(plan, Plan):
                raise TrustboError(f"the policy {name!r} must return a Plan; got {plan!r}.")
            try:
                planner.require_path(plan.path)
            except TrustboError as error:
                raise TrustboError(f"the policy {name!r}: {error}") from None
            self._plan = self._accept(plan, started)
            self._write_state()
        return self._plan

    def suggest(self, path: Sequence[Cell]) -> Plan:
        """Let the operator choose the next path; `ask` then returns it.

        Args:
            path: Cells from start to goal.

        Raises:
            TrustboError: The path is broken, or does not lead from start to goal.
        """
        started = time.perf_counter()
        plan = self.planner_now().evaluate(path, self.belief.mean())
        self._plan = self._accept(plan, started)
        self._write_state()
        return self._plan

    def tell(
        self, mission: Mission, *, other_path: bool = False, again: bool = False, **extra: float
    ) -> xr.DataTree | None:
        """Take a mission, keep it, and learn from it.

        Awareness that the mission did not measure (NaN) is taken from the map, or from the belief.
        Robots and features may be in any order of their names.

        Args:
            mission: Mission as measured, whether or not the goal was reached.
            other_path: Whether it is known to have followed another path than the one asked for.
            again: Whether a mission equal to an earlier one in every number is another one.
            **extra: More numbers for its row of the history, such as its regret.

        Returns:
            Posterior of the parameters given all missions that can be learned from; with a warning
            the last one, or None, where this mission cannot be learned from yet, or never.

        Raises:
            ShapeError: Robots or features differ from the workspace's.
            TrustboError: The path leaves the grid, jumps or is not the one asked for; the mission
                was told before; or an extra is no number. Nothing is kept then.
        """
        plan = self.ask()
        mission = require_mission(self.workspace, mission, plan.path, other_path=other_path)
        if not again:
            told = (e.measured for e in self.log.entries if e.state != SET_ASIDE)
            require_new(mission, list(told))
        self._take(mission, require_extra(extra))
        return self.log.last_tree

    def set_aside(self, reason: str, mission: int | None = None) -> xr.DataTree | None:
        """Leave a mission out of what is learned from, for good; telling it again takes it back.

        Args:
            reason: Reason, for the record.
            mission: Number of the mission, from 1; by default the last.

        Returns:
            Posterior of the parameters given the others; None if there is nothing to learn from.

        Raises:
            TrustboError: There is no such mission, or it is set aside already.
        """
        n = len(self.log.entries)
        number = n if mission is None else require_whole("mission", mission, 1)
        if not 1 <= number <= n:
            raise TrustboError(f"there is no mission {number} to set aside; {n} were told.")
        if (entry := self.log.entries[number - 1]).state == SET_ASIDE:
            raise TrustboError(f"mission {number} is set aside already: {entry.row['reason']}")
        if self.options.update == "moment_matched":
            raise TrustboError('update="moment_matched" cannot forget a mission; use "refit".')
        self.log.entries[number - 1].become(SET_ASIDE, str(reason))
        self._learn(self.seed_of("fit"))
        self._plan = self._believed = None
        if self._folder is not None:
            self._replace(self._folder)  # the last posterior is another now
        return self.log.last_tree

    def _take(self, mission: Mission, extra: dict[str, float]) -> None:
        """Keep a mission on disk, then learn from it."""
        plan, trust_map, seed = self.ask(), self.trust_map(), self.seed_of("fit")
        filled = fill_awareness(mission, self.known_along(mission.path))
        told, entries = time.perf_counter(), self.log.entries
        if self._folder is not None:
            extras = [*(entry.extra for entry in entries), extra]
            self._folder.write_measured([*self.log.measured, mission], extras)
        before = entries[-1].plan if entries else plan
        rates = mission.contact_rate
        row: dict[str, Any] = {
            "objective": plan.value,
            "path_changed": plan.path != before.path,
            "contact_rate": float(np.nanmean(rates)) if np.isfinite(rates).any() else np.nan,
            "status": mission.status,
            "state": TOLD,
            "reason": "",
            **extra,
            "seconds_plan": self._asked[0],
            "seconds_run": told - self._asked[1],
        }
        entries.append(Entry(filled, mission, plan, trust_map, row, self.log.last, extra))
        if reason := never_to_be_learned(filled):
            entries[-1].become(SET_ASIDE, reason)
            self._forget_risk()
            warnings.warn(f"mission {len(entries)} is set aside: {reason}", stacklevel=3)
        else:
            self._learn(seed)
        row["seconds_fit"] = time.perf_counter() - told
        if self.awareness is not None:
            self.awareness.update(mission)
        self._plan = self._believed = None
        self._write()

    def fail(
        self,
        reason: str,
        mission: Mission | None = None,
        *,
        where: Cell | None = None,
        other_path: bool = False,
        again: bool = False,
    ) -> xr.DataTree | None:
        """Give up the mission that was asked for; the next plan knows.

        Args:
            reason: Reason, for the record. One of `hazard.CAUSES`, such as "stuck", says that a
                bound of the plan failed, and is learned from as a hazard.
            mission: Bounds that were run, to learn from; None if there are none.
            where: Cell that it failed to enter, where it did not report but that is known.
            other_path: Whether it is known to have followed another path, as for `tell`.
            again: Whether another mission failed alike, with no `ask` in between; or one equal to
                an earlier one in every number, as for `tell`.

        Returns:
            Posterior of the parameters, if there was something to learn.

        Raises:
            TrustboError: The mission is one that `tell` refuses, or reached the goal in spite of
                a cause; a reason that is empty, or nearly a cause; a `where` that the plan does
                not enter, beside a mission, or for another reason; or a second failure of the
                mission that was asked for.
        """
        if mission is not None and where is not None:
            raise TrustboError(f"the mission tells where it failed; leave where = {where}.")
        require_reason(reason, mission)
        posterior, path = None, ()
        if mission is not None:
            posterior = self.tell(mission, other_path=other_path, again=again)
        else:
            if not again and self._plan is None:
                require_another(self.log.failures, len(self.missions))
            path = self.ask().path if where is not None or reason in CAUSES else ()
        failure = Failure.of(len(self.missions), reason, path, where)
        self.log.failures.append(failure._replace(told=mission is not None))
        self._plan = self._believed = None
        self._forget_risk()
        if self.log.entries:
            self._write()
        else:  # there is no result yet
            self._write_state()
        return posterior

    def recommend(self) -> Plan:
        """Plan the best path under the mean of the belief, whatever the policy would try next."""
        return self.planner_now().plan(self.belief.mean())

    def trust_map(self) -> xr.DataArray:
        """Compute the team's trust map under the mean of the belief, dims (row, col)."""
        return self.planner_now().trust_map(self.belief.mean())

    # --- results ---

    def result(self) -> Result:
        """Collect everything learned so far, as `iterate` returns it.

        Raises:
            TrustboError: Nothing was learned yet.
        """
        if not self.log.entries:
            raise TrustboError("the campaign has no mission yet; tell it one first.")
        best = self.recommend()
        return Result(
            self.workspace,
            self.missions,
            self.posteriors,
            list(best.path),
            best.trust,
            best.value,
            self.trust_map(),
            self.history,
            {**self.settings, **self.log.notes, "trustbo_version": VERSIONS["trustbo"]},
            self.log.stop_reason,
            self._believed_awareness(),
            tuple(self.log.failures),
        )

    # --- the folder ---

    def keep(self, directory: FilePath) -> None:
        """Write everything to a folder, replacing what is there, and keep it up to date from now.

        Raises:
            TrustboError: Another campaign holds the folder, or its name belongs to a file.
        """
        own, folder = self._folder, self._folder_for(directory)
        self._open(folder, overwrite=True)
        if own is not None and own is not folder:
            own.close()

    def _folder_for(self, directory: FilePath) -> CampaignFolder:
        """Folder of a name, the campaign's own if it is kept there."""
        own = self._folder
        here = own is not None and own.path.resolve() == as_path(directory).resolve()
        return own if own is not None and here else CampaignFolder(directory)

    def save(self, directory: FilePath) -> None:
        """Write everything to a folder that `Campaign.load` reads.

        Another campaign in it is replaced. To keep a campaign as it goes, make it with a
        `directory`.

        Raises:
            TrustboError: Another campaign holds the folder, or its name belongs to a file.
        """
        folder = self._folder_for(directory)
        try:
            self._replace(folder)
        finally:
            if folder is not self._folder:
                folder.close()

    @classmethod
    def load(
        cls,
        directory: FilePath,
        *,
        model: TrustModel | None = None,
        policy: Policy | None = None,
        **own: Any,
    ) -> Self:
        """Go on with a campaign where it stopped, in the same folder.

        A mission that was told and not yet learned from is learned from now.

        Args:
            directory: Folder of its `directory`, or of `save`.
            model: The same model, if it has priors of your own, or is your own.
            policy: The same policy, if it is your own.
            **own: The same `callbacks`, and the same `awareness`, as it was before the first
                mission, if it is your own.

        Raises:
            TrustboError: There is no campaign; another process is at work on it; or something of
                your own is missing.
        """
        folder = CampaignFolder(directory, begun=True)
        try:
            state, measured, extras, kept = folder.read()
            workspace = folder.read_workspace()
            with interpreting(folder.path / STATE):
                given, kind = _read_options(state, policy, **own)
                learner = model_from_record(kind) if model is None else None
            # Not within: an error of the user's own model is none of the file.
            learner = model_from_record(kind, model) if learner is None else learner
            campaign = cls(workspace, model=learner, **given)
            with interpreting(folder.path / STATE):
                campaign.log = History.from_state(state, measured, extras, kept, workspace)
                if (suggested := state.get("suggested")) is not None:
                    campaign._plan = plan_from_record(suggested, workspace)
            if campaign.awareness is not None:
                for mission in campaign.log.measured:
                    campaign.awareness.update(mission)
            if (last := campaign.log.last) is not None:
                tree = last()
                with interpreting(last.file or folder.path):
                    campaign.belief = params_of(tree)
            campaign._folder = folder
            for j in range(len(campaign.missions), len(measured)):
                campaign._take(measured[j], extras[j])
        except BaseException:
            folder.close()
            raise
        return campaign

    def stop(self, reason: str) -> Result:
        """End the campaign, which may still go on later, and return its result.

        Args:
            reason: Reason, for `Result.stop_reason`.
        """
        self.log.stop_reason = reason
        result = self.result()
        if self._folder is not None:
            self._folder.write(self._state(), result, ended=True)
        return result

    def folder_of_page(self) -> Path:
        """Folder that the campaign is kept in, for its page.

        Raises:
            TrustboError: There is none.
        """
        if self._folder is None:
            raise TrustboError(
                "a page is report.html in the campaign's folder; give directory=, or checkpoint= "
                "to iterate."
            )
        return self._folder.path

    def close(self) -> None:
        """Let go of the folder; the campaign is kept there no longer."""
        if self._folder is not None:
            self._folder.close()
            self._folder = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _open(self, folder: CampaignFolder, *, overwrite: bool) -> None:
        """Write all of it to a folder, and keep it there from now on."""
        if folder.is_used and not overwrite:
            folder.close()
            raise TrustboError(
                f"{str(folder.path)!r} holds a campaign already: go on with it by "
                "Campaign.load, or choose another folder."
            )
        try:
            self._replace(folder)
        except BaseException:
            if folder is not self._folder:
                folder.close()
            raise
        self._folder = folder

    def _replace(self, folder: CampaignFolder) -> None:
        """Write all of it in place of what the folder holds."""
        result = self.result() if self.log.entries else None
        with folder.replaced(self.workspace):
            if self.log.entries:
                folder.write_measured(self.log.measured, [e.extra for e in self.log.entries])
            folder.write(self._state(), result, whole=True)
        if result is not None:
            result.kept_in(folder.path)

    def _write(self) -> None:
        """Write what the last mission added."""
        if self._folder is not None:
            self._folder.write(self._state(), self.result())

    def _write_state(self) -> None:
        if self._folder is not None:
            self._folder.write(self._state(), None)

    def _state(self) -> dict[str, Any]:
        plan = None if self._plan is None else plan_to_record(self._plan)
        return {"options": self._record, "suggested": plan, **self.log.to_state()}

    # --- inside ---

    def _accept(self, plan: Plan, started: float) -> Plan:
        bands = self.planner_now().bands(plan.path, self.belief)
        now = time.perf_counter()
        self._asked = now - started, now
        if plan.infeasible and plan.p_fail is not None:
            p_fail = 1.0 - np.prod(1.0 - plan.p_fail)  # by which max_failure goes
            warnings.warn(
                f"the plan fails with a chance of {p_fail:.3g}, bounds taken for independent, "
                f"beyond max_failure = {self.options.max_failure:g}; no safer path keeps within "
                "it, or none was found.",
                stacklevel=4,
            )
        return replace(plan, bands=bands)

    def planner_now(self) -> Planner:
        """Planner with the awareness that is believed in now, away from bounds that stopped robots.

        A bound that did so twice is not entered again unless there is no other way, or its chance
        to fail fell below 0.2.
        """
        if self._believed is None:
            planner = self.planner.with_observation(self.observation)
            if self.awareness is not None:
                n_maps = min(_N_MAPS, self.belief.leading[0])
                maps = self.awareness.draw(n_maps, self.seed_of("awareness"))
                planner = planner.with_awareness(maps, self.awareness.mean())
            if self.log.entries or self.log.failures:
                avoided = to_avoid(self.risk)
                planner = planner.avoiding(avoided, self.risk.mean) if avoided.any() else planner
            self._believed = under_risk(planner, self.risk)
        return self._believed

    def known_along(self, path: Sequence[Cell]) -> np.ndarray:
        """Awareness expected in the bounds of a path, shape (bound, robot, feature).

        That of the map, or of the belief after the missions so far; what `TrustFilter` and
        missions take where robots do not measure it.

        Args:
            path: Cell where the team is and the cells to be entered; need not begin at the start.

        Raises:
            TrustboError: A cell is off the grid, or no neighbour of the one before.
        """
        cells = require_on_grid(path, self.workspace.grid.shape)
        moves_along(cells)
        return np.swapaxes(along(self.planner_now().mean_awareness, cells), 0, 1)

    def _believed_awareness(self) -> xr.Dataset | None:
        """`Result.believed`."""
        like, problem = self.workspace.awareness, self.planner_now().problem
        if problem.cells is None:
            return None
        # Single precision: they are written after every mission.
        maps = problem.cells[:_N_KEPT].astype(np.float32)
        draws = xr.DataArray(maps, like.coords, ("draw", *like.dims))
        return xr.Dataset({"mean": like.copy(data=problem.mean_cells), "draws": draws})


def _read_options(
    state: dict[str, Any], policy: Policy | None, **own: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arguments of `Campaign` that a state holds, see `load`, and the record of its model."""
    record = dict(state["options"])
    if "replan" in state["notes"]:  # of version 0.1
        record.setdefault("replan", state["notes"]["replan"])
    given: dict[str, Any] = {name: tuple(record.pop(name)) for name in ("start", "goal")}
    given["policy"] = again("policy", record.pop("policy"), policy, record.pop("own_policy"))
    given |= {name: record.pop(name) for name in ("objective", "sampler", "seed")}
    model = record.pop("model")
    given["options"] = CampaignOptions.restore(record, record.pop("own_awareness"), **own)
    return given, model
