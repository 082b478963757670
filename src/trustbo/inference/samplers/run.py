"""Draws from a model's posterior by the chosen sampler."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from trustbo.errors import PosteriorError
from trustbo.inference.evidence.statistics import gather, split_robots
from trustbo.inference.samplers.choice import by_sums, why_not_scores
from trustbo.inference.samplers.convergence import (
    MAX_KHAT,
    complaints_of,
    complaints_of_means,
)
from trustbo.inference.samplers.coupled_target import CoupledTarget
from trustbo.inference.samplers.exact import ExactDraws, sample_exact
from trustbo.inference.samplers.importance import (
    ScoreTarget,
    UnevenWeightsError,
    sample_scores,
)
from trustbo.inference.samplers.nuts_scores import run_nuts_of_scores
from trustbo.inference.samplers.nuts_sites import SitesInJax, run_nuts_of_sites
from trustbo.inference.samplers.people import PeoplePosterior
from trustbo.inference.samplers.posterior import Posterior, posterior_of
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.inference.samplers.student import Student
from trustbo.inference.samplers.watching import SILENT, Watch
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Slots
from trustbo.models.effects.sampled import SampledDrift
from trustbo.models.model import TrustModel
from trustbo.models.place import Visited
from trustbo.parallel import one_blas_thread
from trustbo.stacking import MissionBatch

_RETRY = 7919  # of the seed, from one try to the next


class Draws(NamedTuple):
    """Draws and statistics with leading axes (chain, draw), and a summary of all."""

    params: dict[str, np.ndarray]
    stats: dict[str, np.ndarray]
    summary: dict[str, Any]
    sampler: str
    places: Mapping[str, np.ndarray] = {}
    """Effects of visited places, see `place_maps.place_group`."""
    effects: Mapping[str, Mapping[str, np.ndarray]] = {}
    """Variables (chain, draw, ...) of the model's other effects, by noun and name."""
    fallback: str = ""
    """Failure of the exact sampler, where NUTS was used for it."""


def draw_posterior(
    model: TrustModel,
    sampler: str,
    settings: NutsSettings,
    seed: int,
    batch: MissionBatch,
    weight: np.ndarray | None = None,
    places: Visited | None = None,
    start: Student | None = None,
    slots: Slots | None = None,
    *,
    check: bool,
    watch: Watch = SILENT,
) -> tuple[Draws, list[str]]:
    """Draws given a batch, and their failed diagnostics.

    Args:
        model: Trust model.
        sampler: `"nuts"` or `"exact"`.
        settings: Length of the run.
        seed: Seed; the same seed gives the same draws.
        batch: Missions, padded.
        weight: Weight of each mission, shape (mission,); 1 by default.
        places: Visited places, where these have effects.
        start: First proposal of the exact sampler with effects or coupled robots, from an earlier
            posterior.
        slots: Rates by chain, where robots have effects; `places` are among them.
        check: Whether to check the diagnostics, and try again for longer if they are bad.
        watch: Observer of the progress.

    Where the exact sampler fails, NUTS takes over with a warning if it can treat the model.

    Raises:
        PosteriorError: The exact sampler fails, and NUTS cannot treat the model.
    """
    weight = np.ones(len(batch.contact_rate)) if weight is None else weight
    task = _Task(model, settings, seed, batch, weight, places, slots, watch, check)
    failure = ""
    if sampler == "exact":
        try:
            if by_sums(model):
                return _sample_exact(task), []
            return _sample_scores(task, start), []
        except UnevenWeightsError as error:
            if not model.family.integrates_out or (slots is not None and why_not_scores(model)):
                raise PosteriorError(f"the exact sampler's {error}.") from None
            failure = str(error)
            warnings.warn(f"the exact sampler's {failure}; NUTS is used instead.", stacklevel=3)
    by_scores = slots is not None or why_not_scores(model) is None
    draws, complaints = (_sample_nuts_of_scores if by_scores else _sample_nuts)(task)
    return draws._replace(fallback=failure), complaints


class _Task(NamedTuple):
    """Arguments of `draw_posterior` that its parts share."""

    model: TrustModel
    settings: NutsSettings
    seed: int
    batch: MissionBatch
    weight: np.ndarray
    places: Visited | None
    slots: Slots | None
    watch: Watch
    check: bool

    @property
    def apart(self) -> bool:
        """Whether robots have nothing in common."""
        return self.model.robot_sets == "each"

    @property
    def targets(self) -> list[ScoreTarget]:
        """Posterior of the scores of all robots, or of each where they have nothing in common."""
        robots = [self.batch] if self.slots is not None else split_robots(self.model, self.batch)
        chains = [self.slots or self.chains(one) for one in robots]
        if (target_of := _TARGETS.get(self.model.robot_sets)) is not None:
            return [target_of(self.model, self.batch, self.weight, of_robot) for of_robot in chains]
        return [posterior_of(self.model, of_robot) for of_robot in chains]

    def chains(self, batch: MissionBatch) -> Slots:
        """Rates by chain of all robots, or of one."""
        return Slots.of(batch, len(self.weight), (), self.weight, self.places)


def _sample_exact(task: _Task) -> Draws:
    """Draws by importance sampling; UnevenWeightsError: its weights are too uneven."""
    shape = (task.settings.n_chains, task.settings.draws)
    posteriors = [
        sample_exact(statistics, task.model.priors, shape[0] * shape[1], task.seed + i)
        for i, statistics in enumerate(gather(task.model, task.batch, task.weight))
    ]
    _require_even(posteriors)
    params, stats = join(posteriors, shape, per_robot=task.apart)
    return Draws(params, stats, summarize(posteriors), "exact")


def _sample_scores(task: _Task, start: Student | None) -> Draws:
    """Draws by importance sampling of scores: effects, pooling, coupling, or rates not Gaussian."""
    shape, targets = (task.settings.n_chains, task.settings.draws), task.targets
    start = None if len(targets) > 1 else start  # that of the first robot
    slow = targets[0].compiles
    task.watch.stage(f"exact sampler {'compiles, and ' if slow else ''}seeks the mode", slow=slow)
    sampled = [
        sample_scores(target, shape[0] * shape[1], task.seed + i, start, task.watch)
        for i, target in enumerate(targets)
    ]
    posteriors = [one.draws for one in sampled]
    _require_even(posteriors)
    params, stats = join(posteriors, shape, per_robot=task.apart)
    places, effects = _pop_effects(task.model, params)
    summary, proposal = summarize(posteriors), sampled[0].proposal
    summary["proposal_center"] = proposal.center.tolist()
    summary["proposal_scale"] = proposal.scale.ravel().tolist()
    return Draws(params, stats, summary, "exact", places=places, effects=effects)


def _pop_effects(
    model: TrustModel, params: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], dict[str, dict[str, np.ndarray]]]:
    """Effects of places by name, and others by noun and name, taken out of parameters."""
    places = {name: params.pop(name) for name in ("place", "place_bound") if name in params}
    effects = {e.noun: {name: params.pop(name) for name in e.variables} for e in model.effects}
    return places, effects


_TARGETS: dict[str, Callable[[Any, MissionBatch, np.ndarray, Slots], ScoreTarget]] = {
    "coupled": lambda model, batch, weight, _: CoupledTarget(model, batch, weight),
    "people": lambda model, batch, weight, slots: PeoplePosterior(model, slots),
}
"""Scores and evidence of models by `TrustModel.robot_sets`; `posterior_of` makes the others."""


def summarize(posteriors: list[ExactDraws]) -> dict[str, Any]:
    """Diagnostics of independent posteriors together."""
    return {
        "k_hat": max(exact.khat for exact in posteriors),
        "kish": min(exact.kish for exact in posteriors),
        "log_evidence": sum(exact.log_evidence for exact in posteriors),
    }


def _require_even(posteriors: list[ExactDraws]) -> None:
    """Refuse importance weights that are too uneven: UnevenWeightsError."""
    khat = max(exact.khat for exact in posteriors)
    if not khat <= MAX_KHAT:
        raise UnevenWeightsError(f"weights are too uneven (k-hat {khat:.2f}, limit {MAX_KHAT})")


def join(
    posteriors: list[ExactDraws], shape: tuple[int, ...], *, per_robot: bool
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws of all robots side by side, of leading axes `shape`, and statistics.

    Weights of robots multiply.
    """

    def joined(columns: list[np.ndarray]) -> np.ndarray:
        draws = np.stack(columns, axis=1) if per_robot else columns[0]
        return draws.reshape(*shape, *draws.shape[1:])

    params = {name: joined([e.params[name] for e in posteriors]) for name in posteriors[0].params}
    stats = {
        "lp": np.sum([e.lp for e in posteriors], axis=0).reshape(shape),
        "log_weight": np.sum([e.log_weight for e in posteriors], axis=0).reshape(shape),
    }
    return params, stats


def _sample_nuts(task: _Task) -> tuple[Draws, list[str]]:
    """Draws by NUTS, rerun for longer if diagnostics fail, and the failures of the last run."""
    model, batch = task.model, task.batch

    def attempt(tried: NutsSettings, retries: int) -> tuple[Draws, list[str]]:
        with own_settings(), one_blas_thread():
            drift = None
            if task.places is not None:
                drift = SampledDrift(
                    model.all_effects, task.chains(batch), batch.contact_rate.shape
                )
            density = SitesInJax.of(model, batch, task.weight, drift)
            params, stats = run_nuts_of_sites(
                tried, task.seed + _RETRY * retries, density, task.watch
            )
        stats = _with_tree_depth(stats)
        complaints = complaints_of(params, stats) if task.check else []
        places = {}
        if drift is not None:
            shape, rng = stats["lp"].shape, np.random.default_rng([task.seed, 3])
            flat = {n: values.reshape(-1, *values.shape[2:]) for n, values in params.items()}
            effects = drift.named(flat, rng)
            places = {n: values.reshape(*shape, -1) for n, values in effects.items()}
            params = {n: values for n, values in params.items() if n not in drift.names}
        summary = {"retries": retries}
        return Draws(params, stats, summary, "nuts", places), complaints

    return _retried(attempt, task)


def _sample_nuts_of_scores(task: _Task) -> tuple[Draws, list[str]]:
    """Draws of scores by NUTS, of all else given them by the evidence; see `_sample_nuts`."""
    targets = cast(list[Posterior], task.targets)
    reference = _draws_by_sums(task) if task.check else {}

    def attempt(tried: NutsSettings, retries: int) -> tuple[Draws, list[str]]:
        first = task.seed + _RETRY * retries
        drawn = [
            _scores_by_nuts(tried, first + i, one, task.watch) for i, one in enumerate(targets)
        ]
        draws, all_stats, moved = zip(*drawn, strict=True)
        stats = {
            name: over(np.stack([one[name] for one in all_stats]), axis=0)
            for name, over in _OVER_ROBOTS.items()
        }
        params = {
            name: np.stack([one[name] for one in draws], axis=2) if task.apart else values
            for name, values in draws[0].items()
        }
        complaints = [complaint for of_robot in moved for complaint in of_robot]
        if reference:
            n = len(reference["beta0"])
            complaints = complaints_of_means(params, reference, np.full(n, 1.0 / n), 0.15)
        complaints = [*complaints_of(params, stats), *complaints] if task.check else []
        places, effects = _pop_effects(task.model, params)
        summary, stats = {"retries": retries}, _with_tree_depth(stats)
        return Draws(params, stats, summary, "nuts", places=places, effects=effects), complaints

    return _retried(attempt, task)


def _draws_by_sums(task: _Task) -> dict[str, np.ndarray]:
    """Draws (draw, ...) of the exact sampler by sums, which seeks all modes; none if it fails.

    Means of NUTS are compared with theirs.
    """
    if not by_sums(task.model):
        return {}
    try:
        exact = _sample_exact(task)
    except UnevenWeightsError:
        return {}
    return {name: values.reshape(-1, *values.shape[2:]) for name, values in exact.params.items()}


_OVER_ROBOTS: dict[str, Any] = {
    "lp": np.sum,
    "energy": np.sum,
    "n_steps": np.sum,
    "diverging": np.any,
    "acceptance_rate": np.min,
    "step_size": np.min,
}
"""Statistics of robots that are sampled apart, taken together."""


def _scores_by_nuts(
    settings: NutsSettings, seed: int, target: Posterior, watch: Watch
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], list[str]]:
    """Draws of scores by NUTS and of all else given them, and statistics, each (chain, draw, ...).

    With them complaints of draws that the exact sampler's points contradict.
    """
    z, stats, points = run_nuts_of_scores(settings, seed, target, watch)
    shape, n = z.shape[:2], z.shape[0] * z.shape[1]
    rng = np.random.default_rng([seed, 3])
    drawn, _ = target.draw(z.reshape(n, -1), np.zeros(n), np.arange(n), rng)
    params = {name: values.reshape(*shape, *values.shape[1:]) for name, values in drawn.items()}
    moved = []
    if points.khat <= MAX_KHAT:
        moved = complaints_of_means(params, target.scores.named(points.z), np.exp(points.log_w))
    return params, stats, moved


def _with_tree_depth(stats: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return stats | {"tree_depth": np.ceil(np.log2(stats["n_steps"] + 1)).astype(int)}


def _retried(
    attempt: Callable[[NutsSettings, int], tuple[Draws, list[str]]], task: _Task
) -> tuple[Draws, list[str]]:
    """Draws of an attempt, or of a second, longer one where the diagnostics of the first fail."""
    draws, complaints = attempt(task.settings, 0)
    if not complaints:
        return draws, complaints
    task.watch.retry(task.settings.longer, complaints)
    return attempt(task.settings.longer, 1)
