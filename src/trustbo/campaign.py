"""A campaign: ask for a path, run it by whatever means, tell what was measured."""

import warnings
from dataclasses import replace
from typing import cast

import numpy as np
import xarray as xr
from jax import random

from trustbo.data import Cell, Mission
from trustbo.errors import ShapeError, TrustboError, require_choice, require_whole
from trustbo.models import (
    PooledTrust,
    TrustModel,
    TrustParams,
    fit,
    moment_matched,
    params_of,
    sample_prior,
)
from trustbo.models.gram import require_forgetting
from trustbo.models.params import Params
from trustbo.models.sampling import SAMPLERS, require_sampler
from trustbo.planning import AwarenessBelief, Plan, Planner, Policy
from trustbo.planning.policies import greedy, resolve_policy
from trustbo.stacking import fill_awareness
from trustbo.terrain import Workspace

INITIAL = ("prior_draw", "prior_mean")
UPDATES = ("refit", "moment_matched")
AWARENESS = ("map", "belief")
_STREAMS = ("policy", "fit", "mission", "prior", "awareness")
_N_MAPS = 500  # drawn of the awareness that is believed in


class Campaign:
    """Learns from missions and proposes the next path.

    Attributes:
        workspace: Where.
        planner: Finds the paths.
        missions: All missions told so far.
        posteriors: The posterior after each of them.
        plans: The plan each of them was asked for with.
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

        Raises:
            TrustboError: Start, goal or a name that does not exist; a sampler that does not suit
                the model; or a model that cannot be updated so.
            NoPathError: The goal cannot be reached.
        """
        self.sampler = require_choice("sampler", sampler, SAMPLERS)
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
        _require_model(self.model)
        require_sampler(self.model, sampler)
        self.update = require_choice("update", update, UPDATES)
        self.forgetting = require_forgetting(forgetting)
        _require_update(self.model, self.update, self.forgetting)
        self.missions: list[Mission] = []
        self.posteriors: list[xr.DataTree] = []
        self.plans: list[Plan] = []
        self._plan: Plan | None = None
        self.awareness = _belief_in(workspace, awareness)
        self._believed: Planner | None = None
        self.belief: Params = self._prior_belief(initial)
        self.settings = {
            "model": type(self.model).__name__,
            "policy": policy if isinstance(policy, str) else getattr(policy, "__name__", "custom"),
            "objective": self.planner.objective,
            "sampler": sampler,
            "initial": initial,
            "observation": self.model.observation,
            "response": self.model.response,
            "update": update,
            "forgetting": self.forgetting,
            "connectivity": connectivity,
            "team": team,
            "length_weight": length_weight,
            "awareness": "map" if self.awareness is None else "belief",
            "max_bounds": max_bounds if isinstance(max_bounds, str) else self.planner.longest,
            "seed": self.seed,
        }

    @property
    def posterior(self) -> xr.DataTree | None:
        """The posterior after the last mission; None before the first."""
        return self.posteriors[-1] if self.posteriors else None

    def ask(self) -> Plan:
        """The next path to run; the same one until `tell`.

        Raises:
            TrustboError: The policy returned a path that is broken, or no plan.
        """
        if self._plan is None:
            key, planner = random.key(self.seed_of("policy")), self._planner_now()
            plan = self._policy(key, self.belief, planner)
            if not isinstance(plan, Plan):
                raise TrustboError(
                    f"the policy {self.settings['policy']!r} must return a Plan; got {plan!r}."
                )
            try:
                planner.require_path(plan.path)
            except TrustboError as error:
                raise TrustboError(f"the policy {self.settings['policy']!r}: {error}") from None
            self._plan = replace(plan, bands=planner.bands(plan.path, self.belief))
        return self._plan

    def tell(self, mission: Mission) -> xr.DataTree:
        """Learn from a mission.

        Awareness that the mission did not measure (NaN) is taken from the workspace's map. The
        mission may have followed another path than the one asked for.

        Args:
            mission: What was measured, whether or not the goal was reached.

        Returns:
            The posterior given all missions so far.

        Raises:
            ShapeError: Robots or features differ from the workspace's.
            TrustboError: The path leaves the grid, or what `fit` refuses.
            PosteriorError: The posterior's diagnostics are bad; the mission is then not kept.
        """
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
        measured = mission
        mission = fill_awareness(mission, self._planner_now().mean_awareness)
        plan = self.ask()
        missions = [*self.missions, mission]
        posterior = self._learn(missions)
        # Only now, all at once: a failed fit leaves the campaign as it was.
        self.missions = missions
        self.posteriors.append(posterior)
        self.plans.append(plan)
        self.belief, self._plan, self._believed = params_of(posterior), None, None
        if self.awareness is not None:
            self.awareness.update(measured)
        return posterior

    def recommend(self) -> Plan:
        """The best path under the mean of the belief, whatever the policy would try next."""
        return greedy(random.key(0), self.belief, self._planner_now())

    def trust_map(self) -> xr.DataArray:
        """The team's trust map under the mean of the belief, dims (row, col)."""
        return self._planner_now().trust_map(self.belief.mean())

    def _planner_now(self) -> Planner:
        """The planner, going by what is believed of the awareness now."""
        if self.awareness is None:
            return self.planner
        if self._believed is None:
            n_maps = min(_N_MAPS, self.belief.leading[0])
            maps = self.awareness.draw(n_maps, self.seed_of("awareness"))
            self._believed = self.planner.with_awareness(maps, self.awareness.mean())
        return self._believed

    def _learn(self, missions: list[Mission]) -> xr.DataTree:
        seed = self.seed_of("fit")
        if self.update == "moment_matched":
            matched = self.model.priors
            if self.posteriors:
                matched = moment_matched(cast(TrustParams, self.belief), self.model.priors)
            return fit(missions[-1:], replace(self.model, priors=matched), self.sampler, seed=seed)
        weights = None
        if self.forgetting < 1.0:
            weights = self.forgetting ** np.arange(len(missions) - 1, -1, -1)
        return fit(missions, self.model, self.sampler, weights=weights, seed=seed)

    def _prior_belief(self, initial: str) -> Params:
        """One draw from the prior, or its mean, as draws with leading axis (draw,) of length 1."""
        n_robots, n_features = (self.workspace.awareness.sizes[n] for n in ("robot", "feature"))
        if initial == "prior_mean" and isinstance(self.model, PooledTrust):
            priors = self.model.priors
            x0 = {"x0_mean": priors.x0_mean, "x0_sd": priors.x0_sd}
            mean = TrustParams(**priors.mean(n_features), **x0)
        else:
            # What robots have in common has a mean in no closed form.
            n_draws, seed = 1 if initial == "prior_draw" else 1000, self.seed_of("prior")
            mean = sample_prior(self.model, n_features, n_draws, seed, n_robots=n_robots).mean()
        return type(mean)(*(np.asarray(value, dtype=float)[None] for value in mean))

    def seed_of(self, stream: str) -> int:
        """The seed of one stream of randomness ("policy", "fit", "mission") at this iteration."""
        entropy = [self.seed, _STREAMS.index(stream), len(self.missions)]
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])


def _require_model(model: TrustModel) -> None:
    if not isinstance(model, TrustModel):
        raise TrustboError(f"model must be a trust model, e.g. PooledTrust(); got {model!r}.")


def _belief_in(workspace: Workspace, awareness: object) -> AwarenessBelief | None:
    if isinstance(awareness, AwarenessBelief):
        return awareness
    chosen = require_choice("awareness", awareness, AWARENESS)
    return AwarenessBelief(workspace) if chosen == "belief" else None


def _require_update(model: TrustModel, update: str, forgetting: float) -> None:
    if forgetting < 1.0 and (update != "refit" or model.observation != "gaussian"):
        raise TrustboError(
            f'forgetting = {forgetting:g} needs update "refit" and Gaussian observations; got '
            f'"{update}" and "{model.observation}".'
        )
    if update == "moment_matched":
        if not isinstance(model, PooledTrust):
            raise TrustboError(
                f'update="moment_matched" is for PooledTrust; got {type(model).__name__}.'
            )
        warnings.warn(
            'update="moment_matched" is for comparison with the 2023 code: over 20 missions it is '
            'off by up to 1.15 posterior standard deviations. update="refit" is exact.',
            stacklevel=3,
        )
