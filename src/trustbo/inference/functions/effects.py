"""Effects on the drift of a NumPyro function, such as those of places, and their coefficients.

Given the function's variables, the rates of all missions and the coefficients of the effects are
jointly normal. The coefficients are therefore integrated out, as in model classes, while the
variables are sampled, and are drawn afterwards.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import sparse

from trustbo.data import Mission
from trustbo.inference.density import chunks
from trustbo.inference.engine import Blocks, Fit, Prior, coefficients_of, evidence
from trustbo.models.effects.effect import Effect, Theta
from trustbo.models.families import FAMILIES
from trustbo.models.observations import Observations
from trustbo.statespace import StateSpace
from trustbo.statespace.blocks import Layout, LinearPredictor, each
from trustbo.workspace import Workspace

_LEAST_NOISE = 1e-8
"""Smallest standard deviation of a rate's own noise with which the density is computed."""


class AddedEffects:
    """Effects that a function adds to the drift in some missions.

    Attributes:
        effects: The effects.
        observations: Rates and awareness of the missions, with the data that the effects need.
    """

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
        self.effects = tuple(effects)
        self.observations = observations

        designs = [effect.design(observations) for effect in effects]
        self._ends = np.cumsum([0, *(U.shape[1] for U in designs)])
        self._U = sparse.csr_array(sparse.hstack(designs, format="csr"))
        self._known: tuple[Layout, Blocks] | None = None  # see `_blocks`

        self._log_resolution = 0.0
        of_ticks = FAMILIES["gaussian"].log_resolution(
            observations.contact_rate, observations.n_ticks
        )
        if of_counts and not np.isnan(of_ticks).any():
            self._log_resolution = float(of_ticks.sum())

    def log_evidence(self, space: StateSpace, drift: np.ndarray, theta: Theta) -> np.ndarray:
        """Compute the log density (point,) of the rates, with the coefficients integrated out.

        Args:
            space: Parameters at each point; the axis `group` has one entry, or one of each robot.
            drift: Drift without effects, shape (point, mission, bound, robot).
            theta: Hyperparameters (point, ...) by name.
        """
        n = len(drift)
        log_p = np.full(n, -np.inf)
        fields = [value for value in space if value is not None]
        flat = [values.reshape(n, -1) for values in (*fields, drift, *theta.values())]
        is_possible = np.isfinite(np.concatenate(flat, axis=1)).all(1)
        is_possible &= (space.noise_sd.reshape(n, -1) > _LEAST_NOISE).all(1)
        is_possible &= (theta["inverse_gain"].reshape(n, -1) != 0.0).all(1)

        some = np.flatnonzero(is_possible)
        with np.errstate(all="ignore"):  # extreme values overflow and get zero density
            for where, chunk in chunks({name: v[some] for name, v in theta.items()}):
                fit, _ = self._fit(space.take(some[where]), drift[some[where]], chunk)
                log_p[some[where]] = fit.log_p
        return np.where(np.isfinite(log_p), log_p + self._log_resolution, -np.inf)

    def draw(
        self, space: StateSpace, drift: np.ndarray, theta: Theta, rng: np.random.Generator
    ) -> dict[str, dict[str, np.ndarray]]:
        """Draw the variables (draw, ...) of each effect given the rates, by group and name.

        The arguments have the axis (draw,); see `log_evidence`. As in model classes, effects are
        stored in single precision.
        """
        parts = []
        for where, chunk in chunks(theta):
            fit, prior = self._fit(space.take(where), drift[where], chunk)
            mean, deviation, _ = coefficients_of(prior, fit, 1, rng)
            parts.append(mean + deviation[:, 0])
        return self._variables(np.concatenate(parts), theta)

    def sum_of(self, values: Mapping[str, Mapping[str, np.ndarray]], theta: Theta) -> np.ndarray:
        """Compute the sum (draw, mission, bound, robot) of effects, given by group and name."""
        c = [
            effect.coefficients(values[effect.group], theta, self.observations)
            for effect in self.effects
        ]
        return self._sum(np.concatenate(c, axis=1))

    def sum_of_prior(self, theta: Theta, rng: np.random.Generator) -> np.ndarray:
        """Draw the sum (draw, mission, bound, robot) of the effects from the prior."""
        parts = [self._prior(chunk).draw(rng) for _, chunk in chunks(theta)]
        return self._sum(np.concatenate(parts))

    def _sum(self, c: np.ndarray) -> np.ndarray:
        """Compute the sum (draw, mission, bound, robot) for coefficients c (draw, column)."""
        return (self._U @ c.T).T.reshape(len(c), *self.observations.contact_rate.shape)

    def _variables(self, c: np.ndarray, theta: Theta) -> dict[str, dict[str, np.ndarray]]:
        """Return the variables of coefficients c (draw, column), by group and name."""
        variables = {}
        ends = zip(self._ends[:-1], self._ends[1:], strict=True)
        for effect, (start, end) in zip(self.effects, ends, strict=True):
            found = effect.to_variables(c[:, start:end].copy(), theta, self.observations)
            variables[effect.group] = {name: v.astype(np.float32) for name, v in found.items()}
        return variables

    def _prior(self, theta: Theta) -> Prior:
        """Return the prior on the coefficients at each theta."""
        return Prior.from_groups(
            [effect.prior(theta, self.observations) for effect in self.effects]
        )

    def _fit(self, space: StateSpace, drift: np.ndarray, theta: Theta) -> tuple[Fit, Prior]:
        """Compute the evidence at each point; also return the prior."""
        prior = self._prior(theta)
        layout, blocks = self._blocks(space, prior)
        predictor = LinearPredictor.from_space(space, layout)

        # The drift of the function is known, so its mean contribution is taken off the rates.
        u = layout.rows(drift)
        known = (each(predictor.response, blocks.label[blocks.kind]) @ u[..., None])[..., 0]
        precision = blocks.seen / each(predictor.noise_sd, blocks.label) ** 2
        return evidence(blocks, predictor, prior, precision, blocks.y - known), prior

    def _blocks(self, space: StateSpace, prior: Prior) -> tuple[Layout, Blocks]:
        """Return the layout and the blocks of the rates, which are the same at all points."""
        if self._known is None:
            is_joint = space.n_members > 1
            layout = Layout.from_rates(self.observations.contact_rate, joint=is_joint)
            n_groups = space.transition.shape[1]
            label = layout.label
            if n_groups > 1:  # robots with parameters of their own
                label = np.tile(np.arange(n_groups), self.observations.n_missions)
            y = layout.rows(self.observations.contact_rate)
            blocks = Blocks.from_rows(y, layout.design(self._U), label, prior=prior)
            self._known = layout, blocks
        return self._known
