"""Trust and predictions of model classes, and the log prior of their parameters."""

from collections.abc import Iterator, Mapping
from functools import cached_property

import numpy as np
import xarray as xr
from scipy.special import logsumexp

from trustbo.arrays import evenly_spaced
from trustbo.inference import ep
from trustbo.inference.density import Density, JointDraws, at
from trustbo.inference.draws import parameters_of
from trustbo.inference.engine import inputs
from trustbo.inference.latent import (
    N_PRIOR,
    N_TRAJECTORIES,
    Given,
    Source,
    by_mission,
    draw_exactly,
    root_of,
)
from trustbo.inference.variables import prior_parameters, to_variables, with_prior_effects
from trustbo.models.scores import log_density
from trustbo.statespace.blocks import each

_CHUNK = 32
"""Number of draws evaluated at once."""
_PARTICLES = 4
"""Number of linear predictors drawn for each draw of the coefficients."""


class OfClass(Source):
    """Draws of a model class, with missions."""

    def __init__(self, density: Density, draws: JointDraws, *, contrasts: bool = True) -> None:
        """Arrange the rates in blocks.

        Args:
            density: Density of the model given the missions.
            draws: Draws of hyperparameters and coefficients.
            contrasts: Whether blocks may be contrasts of robots; see `TrustModel.layout`.
        """
        layout = density.layout
        if not contrasts:
            layout = density.model.layout(density.observations, contrasts=False)
        likelihood = density.model.likelihood
        super().__init__(len(draws.c), density.observations, likelihood, layout, layout.label)
        self.density = density
        self.draws = draws
        self._U = layout.design(density.columns.U)

    @property
    def first_equal(self) -> np.ndarray:
        """See `Source.first_equal`; draws of EP are resampled together with their coefficients."""
        if self.density.exact:
            return super().first_equal

        theta = [values.reshape(self.n_draws, -1) for values in self.draws.theta.values()]
        rows = np.column_stack([*theta, self.draws.c])
        _, first, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        return first[place.ravel()]

    def given(self, some: np.ndarray) -> Iterator[Given]:
        """See `Source.given`."""
        for start in range(0, len(some), _CHUNK):
            index = some[start : start + _CHUNK]
            draws = self.draws.at(index)
            model = self.density.model
            predictor = model.linear_predictor(draws.theta, self.observations, self.layout)

            u = inputs(self._U, len(self.label), draws.c)
            yield Given(index, predictor, predictor.mean_given(u, self.label))

    def draw(
        self, given: Given, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """See `Source.draw`; unless rates are Gaussian, draws are weighted particles."""
        draw = draw_exactly if self.density.exact else _draw_particles
        x, log_p = draw(self, given, rng)
        if self.of_counts:
            log_p = log_p + self.shift
        return x, log_p, at(self._log_prior, given.some)

    @cached_property
    def _log_prior(self) -> dict[str, np.ndarray]:
        """Log prior density (draw,) of each parameter, at all draws."""
        return log_prior(self.density, to_variables(self.density, self.draws)["posterior"])

    @cached_property
    def sites(self) -> ep.Nearby:
        """EP sites near the mean of the draws, whatever was computed before."""
        self.density.reset_ep()
        self.density.run_ep(self.draws.theta)
        return self.density.near

    def prior(self, posterior: xr.DataTree, rng: np.random.Generator) -> "OfClass":
        """See `Source.prior`."""
        if "prior" in posterior.children:
            parameters = parameters_of(posterior, group="prior")
        else:  # the user has dropped it
            parameters = prior_parameters(self.density, N_PRIOR, rng)

        n_draws = len(next(iter(parameters.values())))
        some = at(parameters, evenly_spaced(n_draws, N_TRAJECTORIES))
        return OfClass(self.density, with_prior_effects(self.density, some, rng))


def _draw_particles(
    source: OfClass, given: Given, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw trust given non-Gaussian rates by weighted particles; see `latent.draw_exactly`."""
    density = source.density
    predictor = given.predictor
    mean = given.mean
    joint = ep.Joint(
        density.blocks, predictor, density.prior(at(source.draws.theta, given.some)), density.rates
    )
    sites, _ = source.sites.at(density.rates, predictor.noise_sd)

    # Draw particles of the predictor f; for each block, Gumbel noise chooses one by weight.
    drawn = [ep.draw_predictors(joint, mean, sites, rng) for _ in range(_PARTICLES)]
    f, log_w = (np.stack(part) for part in zip(*drawn, strict=True))
    chosen = np.argmax(log_w + rng.gumbel(size=log_w.shape), axis=0)
    f = np.take_along_axis(f, chosen[None, ..., None], axis=0)[0]
    log_p = by_mission(logsumexp(log_w, axis=0) - np.log(_PARTICLES), source)

    if predictor.shared_cov is None:  # the predictor is trust
        return f, log_p

    # Trust given the predictor f = trust + shared noise.
    V = each(predictor.covariance, source.label)
    S = each(predictor.trust_cov, source.label)
    gain = np.swapaxes(np.linalg.solve(V, S), 2, 3)
    x = mean + (gain @ (f - mean)[..., None])[..., 0]
    return x + (root_of(S - gain @ S) @ rng.standard_normal((*x.shape, 1)))[..., 0], log_p


def log_prior(fitted: Density, parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Compute the log prior density (draw,) of each parameter with an independent prior.

    Deviations of robots from a common mean belong to the model and not to the prior, so only means
    and standard deviations are included for `HierarchicalTrust`. In the coupled model, the LKJ
    prior on correlations R has the density det(R)^(concentration - 1), up to a constant. The prior
    on `delta_v` does not include the noise that is due to the resolution of the rates.

    Args:
        fitted: Density of the model given missions.
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
