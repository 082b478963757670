"""Effects on the drift of a NumPyro function, such as those of places, and their coefficients.

Given the function's variables, the rates of all missions and the coefficients of the effects are
jointly normal. The coefficients are therefore integrated out, as in model classes, while the
variables are sampled, and are drawn afterwards.
"""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Mission
from trustbo.inference.columns import Columns
from trustbo.inference.density import chunks
from trustbo.inference.engine import Blocks, Fit, Prior, coefficients_of, evidence
from trustbo.models.effects.effect import Effect, Theta
from trustbo.models.families import FAMILIES
from trustbo.models.observations import Observations
from trustbo.statespace import Inputs, StateSpace
from trustbo.statespace.blocks import Layout, LinearPredictor, each, rate_precision
from trustbo.workspace import Workspace

_LEAST_NOISE = 1e-8
"""Smallest standard deviation of a rate's own noise with which the density is computed."""


class AddedEffects(Columns):
    """Effects that a function adds to the drift in some missions; there may be none."""

    def __init__(
        self,
        effects: Sequence[Effect],
        observations: Observations,
        missions: Sequence[Mission],
        workspace: Workspace | None = None,
        *,
        of_counts: bool = False,
    ) -> None:
        """Set the design matrices.

        Args:
            effects: The effects.
            observations: Rates and awareness of the missions.
            missions: The missions.
            workspace: Workspace of the missions, if known.
            of_counts: Whether the evidence is that of the tick counts, if all are known.
        """
        for effect in effects:
            observations = effect.add_data(observations, missions, workspace)
        super().__init__(effects, observations)

        self._blocks: Blocks | None = None  # the same at all points
        self._log_resolution = 0.0
        of_ticks = FAMILIES["gaussian"].log_resolution(
            observations.contact_rate, observations.n_ticks
        )
        if of_counts and not np.isnan(of_ticks).any():
            self._log_resolution = float(of_ticks.sum())

    def log_evidence(self, space: StateSpace, inputs: Inputs, theta: Theta) -> np.ndarray:
        """Compute the log density (point,) of the rates, with the coefficients integrated out.

        Args:
            space: Parameters at each point; the axis `group` has one entry, or one of each robot.
            inputs: Drift without effects and scale of the noise, shape (point, mission, bound,
                robot). There is no offset.
            theta: Hyperparameters (point, ...) by name.
        """
        n = len(inputs.drift)
        log_p = np.full(n, -np.inf)
        fields = [value for value in space if value is not None]
        flat = [values.reshape(n, -1) for values in (*fields, *inputs, *theta.values())]
        is_possible = np.isfinite(np.concatenate(flat, axis=1)).all(1)
        least = space.noise_sd.reshape(n, -1).min(1) * inputs.noise.reshape(n, -1).min(1)
        is_possible &= least > _LEAST_NOISE
        is_possible &= (theta["inverse_gain"].reshape(n, -1) != 0.0).all(1)

        some = np.flatnonzero(is_possible)
        with np.errstate(all="ignore"):  # extreme values overflow and get zero density
            for where, chunk in chunks({name: v[some] for name, v in theta.items()}):
                at = some[where]
                fit, _ = self._fit(space.take(at), Inputs(*(v[at] for v in inputs)), chunk)
                log_p[some[where]] = fit.log_p
        return np.where(np.isfinite(log_p), log_p + self._log_resolution, -np.inf)

    def draw(
        self, space: StateSpace, inputs: Inputs, theta: Theta, rng: np.random.Generator
    ) -> dict[str, dict[str, np.ndarray]]:
        """Draw the variables (draw, ...) of each effect given the rates, by group and name.

        The arguments have the axis (draw,); see `log_evidence`.
        """
        parts = []
        for where, chunk in chunks(theta):
            fit, prior = self._fit(space.take(where), Inputs(*(v[where] for v in inputs)), chunk)
            mean, deviation, _ = coefficients_of(prior, fit, 1, rng)
            parts.append(mean + deviation[:, 0])
        return self.to_variables(np.concatenate(parts), theta)

    def _fit(self, space: StateSpace, inputs: Inputs, theta: Theta) -> tuple[Fit, Prior]:
        """Compute the evidence at each point; also return the prior."""
        rates = self.observations.contact_rate
        prior = self.prior(theta)
        layout, label = layout_of(space, rates)
        predictor = LinearPredictor.from_space(space, layout, noise=inputs.noise)
        if self._blocks is None:
            U = layout.design(self.U)
            noise = predictor.noise_sd[0]
            self._blocks = Blocks.from_rows(layout.rows(rates), U, label, noise, prior=prior)
        blocks = self._blocks

        # The drift of the function is known, so its mean contribution is taken off the rates.
        u = layout.rows(inputs.drift)
        known = (each(predictor.response, label) @ u[..., None])[..., 0]
        precision = rate_precision(blocks.seen, predictor.noise_sd, blocks.first)
        return evidence(blocks, predictor, prior, precision, blocks.y - known), prior


def layout_of(space: StateSpace, rates: np.ndarray) -> tuple[Layout, np.ndarray]:
    """Return the blocks of rates (mission, bound, robot), and the label (block,) of each block.

    Blocks have equal labels if the form has equal parameters for them.
    """
    layout = Layout.from_rates(rates, joint=space.n_members > 1)
    n_groups = max(field.shape[1] for field in space if field is not None)
    label = layout.label
    if n_groups > 1:  # robots with parameters of their own
        label = np.tile(np.arange(n_groups), len(rates))
    return layout, label
