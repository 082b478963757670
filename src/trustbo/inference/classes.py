"""The learner of a model class, and the trust, predictions and log prior of its draws."""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from trustbo.arrays import evenly_spaced
from trustbo.data import Mission
from trustbo.display import slow_bar
from trustbo.errors import TrustboError
from trustbo.inference import ep
from trustbo.inference.ahead import read_params
from trustbo.inference.class_sampling import by_importance
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.density import JointDraws, Outer, at
from trustbo.inference.latent import (
    N_PRIOR,
    N_TRAJECTORIES,
    Given,
    Source,
)
from trustbo.inference.learns import Learner
from trustbo.inference.mixture import Mixture
from trustbo.inference.nuts import sample_by_nuts
from trustbo.inference.options import Options
from trustbo.inference.prior_draws import prior_mean, sample_prior, sample_prior_ahead
from trustbo.inference.stored import parameters_of, read_posterior, stored_draws
from trustbo.inference.tree import Fitted, by_chain, default_draws
from trustbo.inference.variables import prior_parameters, to_variables, with_prior_effects
from trustbo.inference.weights import MAX_KHAT
from trustbo.models.draws import Draws, NextMission
from trustbo.models.model import TrustModel
from trustbo.models.people import HumanTrust
from trustbo.models.record import model_to_record
from trustbo.models.scores import log_density
from trustbo.stacking import require_same_robots
from trustbo.workspace import Workspace

SAMPLERS = ("importance", "nuts")
"""Names of the samplers of model classes, the default first."""


class ClassLearner(Learner):
    """Learner of a model class."""

    samplers = SAMPLERS

    def record(self) -> dict[str, Any]:
        """See `Learner.record`."""
        return model_to_record(self.known)

    def sampled(
        self, missions: Sequence[Mission], workspace: Workspace | None, options: Options
    ) -> Fitted:
        """See `Learner.sampled`."""
        model = self.known.for_features(missions[0].features)
        target = ClassTarget(model, model.observations(missions, workspace))
        record = json.dumps(model_to_record(model))
        draws = options.draws or default_draws(model.effects, options.sampler)
        if options.sampler == "importance":
            first = _first_proposal(options.start, record)
            with slow_bar("fit", " points", options.progress) as bar:
                target.evaluated = bar.update
                drawn, stats, summary = by_importance(
                    target, options.chains * draws, options.seed, first
                )

            stats = {name: values[None] for name, values in stats.items()}  # in one chain
            notes = {"sample_stats": {"proposal": summary.pop("proposal")}}
            complaints = []
            if not summary["k_hat"] <= MAX_KHAT:
                reason = f"k-hat {summary['k_hat']:.2f}, limit {MAX_KHAT}"
                complaints.append(f"importance weights are uneven ({reason})")
        else:
            drawn, stats, summary, complaints = sample_by_nuts(
                target,
                chains=options.chains,
                draws=draws,
                warmup=options.warmup,
                seed=options.seed,
                progress=options.progress,
            )
            stats = by_chain(stats, options.chains)
            notes = {}

        resolution = target.observations.resolution if model.likelihood.adds_noise else 0.0
        return Fitted(
            variables=to_variables(target, drawn),
            prior=prior_parameters(target, N_PRIOR, np.random.default_rng([options.seed, 3])),
            dims=model.dims,
            labels={},
            effects=model.effects,
            observations=target.observations,
            statistics=stats,
            attrs={
                "model": type(model).__name__,
                "model_record": record,
                **_described(model),
                "resolution": resolution,
                "sampler": options.sampler,
                **summary,
            },
            notes=notes,
            by_position=False,
            complaints=complaints,
            source=lambda tree: OfClass(target, stored_draws(target, tree)),
        )

    def require_poolable(self, earlier: Sequence[Mission], robots: Sequence[str]) -> None:
        """See `Learner.require_poolable`.

        A robot has no rates in the missions of other robots. Only models in which robots influence
        each other cannot handle such gaps.
        """
        if self.known.joint and not self.known.exchangeable:
            require_same_robots(type(self.known).__name__, earlier, robots)

    def source(
        self, posterior: xr.DataTree, missions: Sequence[Mission], *, contrasts: bool = True
    ) -> Source:
        """See `Learner.source`."""
        found = read_posterior(posterior, missions, model=self.model)
        return OfClass(*found, contrasts=contrasts)

    def read(
        self, posterior: xr.DataTree, workspace: Workspace | None, next_mission: Sequence[bool]
    ) -> Sequence[Draws]:
        """See `Learner.read`."""
        return read_params(posterior, workspace, next_mission)

    def of_prior(self, n_draws: int, seed: int, whole: Workspace) -> Draws:
        """See `Learner.of_prior`."""
        model = self.known.for_features(whole.features)
        sizes = len(whole.features), n_draws, seed
        return sample_prior(model, *sizes, n_robots=whole.team.n_robots)

    def of_prior_ahead(self, n_draws: int, seed: int, whole: Workspace) -> NextMission:
        """See `Learner.of_prior_ahead`."""
        model = self.known.for_features(whole.features)
        return sample_prior_ahead(model, whole, n_draws, seed)

    def mean_of_prior(self, whole: Workspace) -> Draws:
        """See `Learner.mean_of_prior`."""
        model = self.known.for_features(whole.features)
        return prior_mean(model, len(whole.features), n_robots=whole.team.n_robots)

    def require_plannable(self, workspace: Workspace, sampler: str | None) -> None:
        """See `Learner.require_plannable`."""
        if isinstance(self.model, HumanTrust):
            raise TrustboError("model: HumanTrust cannot plan paths; give PooledTrust() instead.")


def _first_proposal(start: xr.DataTree | None, record: str) -> Mixture | None:
    """Return the proposal of a posterior of a model with this record, or None."""
    if start is None or start.attrs["model_record"] != record:
        return None

    text = start["sample_stats"].attrs.get("proposal")
    return None if text is None else Mixture.from_text(text)


def _described(model: TrustModel) -> dict[str, Any]:
    """Return the options and priors of a model as attributes of a posterior."""
    options = {name: int(v) if isinstance(v, bool) else v for name, v in model.options().items()}
    priors = {f"prior_{name}": text for name, text in model.priors.describe().items()}
    return {**options, **model.x0, **priors}


class OfClass(Source):
    """Draws of a model class, with missions."""

    def __init__(self, target: ClassTarget, draws: JointDraws, *, contrasts: bool = True) -> None:
        """See `Source`; draws are those of hyperparameters and coefficients."""
        super().__init__(target.density, len(draws.c), contrasts=contrasts)
        self.target = target
        self.draws = draws

    @property
    def first_equal(self) -> np.ndarray:
        """See `Source.first_equal`; draws of EP are resampled together with their coefficients."""
        if self.target.is_gaussian:
            return super().first_equal

        theta = [values.reshape(self.n_draws, -1) for values in self.draws.theta.values()]
        rows = np.column_stack([*theta, self.draws.c])
        _, first, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        return first[place.ravel()]

    def outer(self, some: np.ndarray) -> tuple[Outer, np.ndarray]:
        """See `Source.outer`."""
        draws = self.draws.at(some)
        return self.target.outer_of(draws.theta), draws.c

    def log_prior(self, given: Given) -> dict[str, np.ndarray]:
        """See `Source.log_prior`."""
        return at(self._log_prior, given.some)

    @cached_property
    def _log_prior(self) -> dict[str, np.ndarray]:
        """Log prior density (draw,) of each parameter, at all draws."""
        return log_prior(self.target, to_variables(self.target, self.draws)["posterior"])

    @cached_property
    def near(self) -> ep.Nearby:
        """EP sites near the mean of the draws, whatever was computed before."""
        self.density.reset_ep()
        self.target.run_ep(self.draws.theta)
        return self.target.density.near

    def prior(self, posterior: xr.DataTree, rng: np.random.Generator) -> "OfClass":
        """See `Source.prior`."""
        if "prior" in posterior.children:
            parameters = parameters_of(posterior, group="prior")
        else:  # the user has dropped it
            parameters = prior_parameters(self.target, N_PRIOR, rng)

        n_draws = len(next(iter(parameters.values())))
        some = at(parameters, evenly_spaced(n_draws, N_TRAJECTORIES))
        return OfClass(self.target, with_prior_effects(self.target, some, rng))


def log_prior(fitted: ClassTarget, parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Compute the log prior density (draw,) of each parameter with an independent prior.

    Deviations of robots from a common mean belong to the model and not to the prior, so only means
    and standard deviations are included for `HierarchicalTrust`. In the coupled model, the LKJ
    prior on correlations R has the density det(R)^(concentration - 1), up to a constant. The prior
    on `delta_v` does not include the noise that is due to the resolution of the rates.

    Args:
        fitted: ClassTarget of the model given missions.
        parameters: Draws (draw, ...) of the parameters by name.
    """
    model = fitted.model
    priors = fitted.scores.priors
    resolution = fitted.observations.resolution
    inverse_gain = model.derived(parameters)["inverse_gain"]

    with_prior = dict(parameters)
    if "delta_v" in parameters:
        with_prior |= model.noise_without(parameters, resolution)
    densities = {n: log_density(p, with_prior[n]) for n, p in priors.items() if n in parameters}
    for name, (field, values) in model.prior_terms(parameters).items():
        if field == "delta_v":
            values = model.noise_without({"delta_v": values}, resolution)["delta_v"]
        given = inverse_gain.reshape(*inverse_gain.shape, *(1,) * (values.ndim - inverse_gain.ndim))
        densities[name] = model.priors.log_density(field, values, given)

    for noise in ("Delta_w", "Delta_v"):
        if noise in parameters:
            sd = np.sqrt(np.einsum("...ii->...i", parameters[noise]))
            correlation = parameters[noise] / (sd[..., :, None] * sd[..., None, :])
            log_det = np.linalg.slogdet(correlation)[1]
            densities[f"correlation_{noise[-1]}"] = (model.priors.concentration - 1.0) * log_det

    return {name: values.reshape(len(values), -1).sum(1) for name, values in densities.items()}
