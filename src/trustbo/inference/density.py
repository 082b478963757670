"""The density of rates given a model's form, with the coefficients of its effects integrated out.

A model says at a point what its `Outer` contains: its log prior, its form, its inputs and the
hyperparameters of its effects. Model classes say so in NumPy (`class_target`), and NumPyro
functions in JAX (`functions.target`). All that follows is the same for both, and is done here.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from scipy import special

from trustbo.inference.columns import Columns
from trustbo.inference.engine import Blocks, Fit, Prior, coefficients_of, evidence
from trustbo.models.effects.effect import Theta
from trustbo.models.families import Family
from trustbo.statespace import Inputs, StateSpace
from trustbo.statespace.blocks import Layout, LinearPredictor, each, rate_precision

CHUNK = 32
"""Largest number of points evaluated at once."""
_LEAST_CHUNK = 8
"""Smallest number of points evaluated at once, for which vector instructions still pay."""
_NUMBERS = 12_000_000
"""Largest number of precision entries of the points evaluated at once."""
_LEAST_NOISE = 1e-8
"""Smallest standard deviation of a rate's own noise with which the density is computed."""
_DEVIATIONS = 4
"""Number of draws of the coefficients that are kept at each visited point."""
_LEAST_DEGREES = 8.0
"""Smallest number of degrees of freedom of a proposal of coefficients."""
_SQUARED = 3.0
"""Squared number of columns per degree of freedom of a proposal of coefficients."""


class Outer(NamedTuple):
    """What a model says at points, of which the first axis of all arrays is (point,)."""

    log_p: Any
    """Log density (point,) of all but the rates and coefficients; -inf where impossible."""
    space: StateSpace
    """The form."""
    inputs: Inputs
    """Known inputs (point, mission, bound, robot or 1), to which effects are added; or numbers."""
    theta: Theta
    """Hyperparameters of the effects, by name."""
    random: Inputs | None = None
    """Inputs of random effects of single missions; see `TrustModel.random_effects`."""
    log_prior: Mapping[str, Any] = {}
    """Log prior density (point, ...) of each variable by name, where it is known."""

    def take(self, index: Any) -> Self:
        """Select points by an index array, a mask or a slice."""

        def of(inputs: Inputs) -> Inputs:
            return Inputs(*(value[index] if np.ndim(value) else value for value in inputs))

        return type(self)(
            self.log_p[index],
            self.space.take(index),
            of(self.inputs),
            at(self.theta, index),
            None if self.random is None else of(self.random),
            at(self.log_prior, index),
        )

    @property
    def is_possible(self) -> np.ndarray:
        """Whether the density of the rates may be positive, shape (point,)."""
        n = len(self.log_p)
        values = [*self.space, *self.inputs, *self.theta.values(), self.log_p]
        flat = [v.reshape(n, -1) for v in values if v is not None and np.ndim(v)]
        noise = self.space.noise_sd.reshape(n, -1).min(1)
        if np.ndim(self.inputs.noise):
            noise = noise * self.inputs.noise.reshape(n, -1).min(1)

        possible = np.isfinite(np.concatenate(flat, axis=1)).all(1) & (noise > _LEAST_NOISE)
        return possible & (self.theta["inverse_gain"].reshape(n, -1) != 0.0).all(1)


class JointDraws(NamedTuple):
    """Draws of hyperparameters and coefficients."""

    theta: dict[str, np.ndarray]  # (draw, ...)
    c: np.ndarray  # (draw, column)

    def at(self, index: np.ndarray) -> Self:
        """Select draws by index."""
        return self._replace(theta=at(self.theta, index), c=self.c[index])


class Coefficients(NamedTuple):
    """Normal distributions of the coefficients at points, represented by draws."""

    mean: np.ndarray  # (point, column)
    deviation: np.ndarray  # (point, deviation, column), independent draws minus the mean
    gram: np.ndarray  # (point, deviation, deviation), products of the whitened deviations
    log_det: np.ndarray  # (point,), of the factor of the precision

    @classmethod
    def empty(cls, n_points: int, n_columns: int) -> Self:
        """Make room for the distributions at n points."""
        k = _DEVIATIONS
        shapes = (n_columns,), (k, n_columns), (k, k), ()
        return cls(*(np.zeros((n_points, *shape)) for shape in shapes))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Join the distributions of several groups of points."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def draw(self, index: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw coefficients (draw, column) at the points with the given index (draw,).

        A combination of independent deviations with a random unit vector has the same normal
        distribution as each deviation, so a point can be drawn any number of times.
        """
        return self._combined(index, self._directions(len(index), rng))

    def propose(self, index: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw coefficients from Student-t distributions; also return log densities (draw,).

        These distributions have the means and precisions of the normal distributions. The fewer
        columns, the heavier their tails, which cover the errors of EP.
        """
        p = self.mean.shape[1]
        nu = max(_LEAST_DEGREES, p**2 / _SQUARED)
        unit = self._directions(len(index), rng)
        unit /= np.sqrt(rng.chisquare(nu, (len(index), 1)) / nu)

        square = np.einsum("ni,nij,nj->n", unit, self.gram[index], unit)
        log_q = special.gammaln(0.5 * (nu + p)) - special.gammaln(0.5 * nu)
        log_q = log_q - 0.5 * p * np.log(nu * np.pi) + self.log_det[index]
        log_q = log_q - 0.5 * (nu + p) * np.log1p(square / nu)
        return self._combined(index, unit), log_q

    def _directions(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw random unit vectors (draw, deviation)."""
        unit = rng.standard_normal((n, self.deviation.shape[1]))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        return unit

    def _combined(self, index: np.ndarray, factors: np.ndarray) -> np.ndarray:
        """Add the sums of the deviations times factors (draw, deviation) to the means."""
        drawn = self.mean[index]
        for point in np.unique(index):
            here = index == point
            drawn[here] += factors[here] @ self.deviation[point]
        return drawn


class Density:
    """Density of Gaussian rates at points, and draws of the coefficients given the rates.

    Attributes:
        columns: Effects, with the rates and awareness of the missions.
        observations: These rates and awareness.
        layout: Layout of the rates in blocks.
        likelihood: Observation family.
        U: Design of all blocks, a sparse matrix (block * input, column).
        blocks: Data of all blocks, from the first point on that is evaluated. Which columns depend
            on each other a priori, and which blocks have equal noise, is the same at all points.
    """

    is_gaussian = True

    blocks: Blocks

    def __init__(self, columns: Columns, layout: Layout, likelihood: Family) -> None:
        self.columns = columns
        self.observations = columns.observations
        self.layout = layout
        self.likelihood = likelihood
        self.U = layout.design(columns.U)

    def prepare(self, outer: Outer) -> None:
        """Arrange rates and columns in blocks, given what the model says at any points."""
        predictor, prior = self.given(outer.take(slice(1)))
        self.blocks = Blocks.from_rows(
            self.layout.rows(self.observations.contact_rate), self.U, self.layout.label,
            predictor.noise_sd[0], prior=prior, apart=not self.is_gaussian,
        )  # fmt: skip

    def chunks(self, outer: Outer) -> Iterator[tuple[np.ndarray, Outer]]:
        """Yield the possible points in chunks, which limits the memory for their matrices."""
        some = np.flatnonzero(outer.is_possible)
        if not len(some):
            return
        if not hasattr(self, "blocks"):
            self.prepare(outer.take(some[:1]))

        size = int(np.clip(_NUMBERS // self.blocks.order.size, _LEAST_CHUNK, CHUNK))
        for start in range(0, len(some), size):
            index = some[start : start + size]
            yield index, outer.take(index)

    def log_density(self, outer: Outer) -> np.ndarray:
        """Compute the log joint density (point,) of points and rates, up to a constant."""
        log_p = np.full(len(outer.log_p), -np.inf)
        with np.errstate(all="ignore"):  # extreme values overflow and get zero density
            for index, part in self.chunks(outer):
                log_p[index] = self.fitted(part)[0].log_p + part.log_p
        return np.where(np.isfinite(log_p), log_p, -np.inf)

    def visit(
        self, outer: Outer, rng: np.random.Generator, **options: Any
    ) -> tuple[np.ndarray, Coefficients]:
        """Compute `log_density`, and the coefficients at each point.

        `options` are those of `fitted`, with the axis (point,).
        """
        log_p = np.full(len(outer.log_p), -np.inf)
        found = Coefficients.empty(len(log_p), self.columns.n)
        with np.errstate(all="ignore"):  # extreme values overflow and get zero density
            for index, part in self.chunks(outer):
                own = {name: value.of(index) for name, value in options.items()}
                fit, prior = self.fitted(part, **own)
                log_p[index] = fit.log_p + part.log_p
                parts = coefficients_of(prior, fit, _DEVIATIONS, rng)
                for values, one in zip(found, (*parts, fit.F.log_det), strict=True):
                    values[index] = one
        return np.where(np.isfinite(log_p), log_p, -np.inf), found

    def log_evidence(self, outer: Outer) -> np.ndarray:
        """Compute log p(rates | point), shape (point,)."""
        log_p = np.full(len(outer.log_p), -np.inf)
        for index, part in self.chunks(outer):
            log_p[index] = self.fitted(part)[0].log_p
        return log_p

    def draw_coefficients(self, outer: Outer, rng: np.random.Generator) -> np.ndarray:
        """Draw the coefficients (point, column) once at each point, given Gaussian rates."""
        drawn = np.empty((len(outer.log_p), self.columns.n))
        for index, part in self.chunks(outer):
            fit, prior = self.fitted(part)
            mean, deviation, _ = coefficients_of(prior, fit, 1, rng)
            drawn[index] = mean + deviation[:, 0]
        return drawn

    def given(self, outer: Outer) -> tuple[LinearPredictor, Prior]:
        """Return the distribution of the linear predictors and the prior at each point."""
        return self.predictor(outer), self.columns.prior(outer.theta)

    def predictor(self, outer: Outer, layout: Layout | None = None) -> LinearPredictor:
        """Return the distribution of the linear predictors at each point, without known inputs."""
        layout = self.layout if layout is None else layout
        return LinearPredictor.from_space(outer.space, layout, outer.random, outer.inputs.noise)

    def fitted(self, outer: Outer) -> tuple[Fit, Prior]:
        """Compute the evidence at each point; also return the prior.

        Here, the noise of a measured rate enters: its sd is `delta_v`, to which the resolution of
        the rate was added, times the scale of the noise.
        """
        predictor, prior = self.given(outer)
        blocks = self.blocks
        precision = rate_precision(blocks.seen, predictor.noise_sd, blocks.first)

        y = None
        if np.ndim(outer.inputs.drift):  # its mean contribution is taken off the rates
            u = self.layout.rows(outer.inputs.drift)
            response = each(predictor.response, self.layout.label)
            y = blocks.y - (response @ u[..., None])[..., 0]
        return evidence(blocks, predictor, prior, precision, y), prior

    def run_ep(self, outer: Outer) -> None:
        """Do nothing, as Gaussian rates need no EP; see `ByEP`."""

    def reset_ep(self) -> None:
        """Do nothing; see `run_ep`."""


def at(theta: Mapping[str, Any], index: Any) -> dict[str, Any]:
    """Select the hyperparameters at the given points."""
    return {name: values[index] for name, values in theta.items()}


def chunks(theta: Mapping[str, Any], size: int = CHUNK) -> Iterator[tuple[slice, dict[str, Any]]]:
    """Yield the slice and the hyperparameters of each chunk of points."""
    for start in range(0, len(theta["inverse_gain"]), size):
        where = slice(start, start + size)
        yield where, at(theta, where)
