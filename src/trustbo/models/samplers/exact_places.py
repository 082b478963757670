"""Near-independent draws from the posterior of a model with place effects, without Markov chains.

Coefficients and the effects of all visited places integrate out (`place_target`), which leaves at
most six scores. They are drawn by importance sampling:

1. A first proposal: Student-t densities with the moments of an earlier posterior, or else around
   the modes that Newton's searches find.
2. Rounds of some 256 points give the mean and covariance of the next proposal, until their
   effective number is fair. Half of the points are drawn with the places' scores from their prior:
   s of a short length scale and e stand in for each other, and that second mode lies far out.
3. Points of the last rounds and 512 more are pooled, the mixture of all their proposals being the
   density that weights are relative to, and the weights Pareto-smoothed. Where k-hat says that they
   are uneven, more points follow.
4. Systematic resampling makes points equally weighted; coefficients and effects are drawn from
   their normal conditional at each.

Invariant: weights are target over proposal density whatever the proposals are.
"""

import itertools
from typing import NamedTuple

import numpy as np

from trustbo.models.likelihood import place_prior
from trustbo.models.place import PlaceEffect, Visited
from trustbo.models.samplers.convergence import GOOD_KHAT
from trustbo.models.samplers.exact import ExactDraws, smoothed_weights, systematic
from trustbo.models.samplers.laplace import laplace
from trustbo.models.samplers.place_target import Conditional, PlaceTarget
from trustbo.models.samplers.student import Student, log_mixture
from trustbo.parallel import one_blas_thread

_PILOT, _FINAL = 256, 512
_MAX_ROUNDS, _MAX_FINAL = 4, 3
_FAIR, _LOST = 0.1, 10.0  # effective number of a round's points: share of them; too few to go on
_RIDGE = 1e-3
_NUMBERS = 2e8  # bytes of factors kept at once


class PlaceDraws(NamedTuple):
    """Draws of parameters, effects of visited places among them, and what the next fit starts from.

    `params` of the draws has place (draw, cell) and place_bound (draw, unit) where there are such.
    """

    draws: ExactDraws
    proposal: Student


class _Points(NamedTuple):
    """Weighted points of all proposals so far."""

    z: np.ndarray
    log_p: np.ndarray
    log_w: np.ndarray  # smoothed and normalised
    khat: float
    log_evidence: float

    @property
    def kish(self) -> float:
        return float(np.exp(-np.logaddexp.reduce(2.0 * self.log_w)))


def sample_places(
    target: PlaceTarget, n_draws: int, seed: int, start: Student | None = None
) -> PlaceDraws:
    """Draw from the posterior of a target; the same seed and start give the same draws.

    Args:
        target: Posterior of the scores.
        n_draws: Number of equally weighted draws.
        seed: Seed.
        start: Proposal of an earlier posterior to begin with.
    """
    # Matrices are small: a second BLAS thread costs more than it brings.
    with one_blas_thread():
        points, proposal = _weigh(target, seed, start)
        rng = np.random.default_rng(seed)
        weights = np.exp(points.log_w)
        chosen = np.sort(systematic(weights, n_draws, rng))
        params = _draw(target, points.z, chosen, rng)
    order = rng.permutation(n_draws)
    return PlaceDraws(
        ExactDraws(
            {name: values[order] for name, values in params.items()},
            points.log_w[chosen][order],
            points.log_p[chosen][order],
            points.khat,
            points.kish,
            points.log_evidence,
        ),
        proposal,
    )


def _weigh(target: PlaceTarget, seed: int, start: Student | None) -> tuple[_Points, Student]:
    """Weighted points, and the Student-t with their moments."""
    cloud = _Cloud(target)
    proposal, warm = (start, True) if start is not None else (_at_mode(target), False)
    for k in range(1, _MAX_ROUNDS + 1):
        cloud.add(proposal.widened(1.25), _PILOT // 2, seed + k)
        cloud.add(_defensive(proposal, target), _PILOT // 2, seed + k)
        points = cloud.points()
        proposal = Student.of(points.z, points.log_w, _RIDGE)
        if k == 1 and not warm:  # a curvature's proposal only serves to be replaced
            cloud = _Cloud(target)
        elif points.kish > _FAIR * _PILOT:
            break
        elif k == 2 and points.kish < _LOST and warm:  # the posterior has moved far
            cloud, proposal, warm = _Cloud(target), _at_mode(target), False
    cloud.add(proposal.widened(1.1), _FINAL, seed + 77)
    points = cloud.points()
    for k in range(1, _MAX_FINAL):
        if points.khat < GOOD_KHAT:
            break
        proposal = Student.of(points.z, points.log_w, _RIDGE)
        cloud.add(proposal.widened(1.1), _FINAL, seed + 77 + k)
        points = cloud.points()
    return points, Student.of(points.z, points.log_w, 1e-9)


class _Cloud:
    """Points of several proposals."""

    def __init__(self, target: PlaceTarget) -> None:
        self._target = target
        self._proposals: list[Student] = []
        self._z: list[np.ndarray] = []
        self._log_p: list[np.ndarray] = []

    def add(self, proposal: Student, n: int, seed: int) -> None:
        z = proposal.draw(n, seed)
        self._proposals.append(proposal)
        self._z.append(z)
        self._log_p.append(self._target.log_density(z))

    def points(self) -> _Points:
        z, log_p = np.concatenate(self._z), np.concatenate(self._log_p)
        raw = log_p - log_mixture(self._proposals, [len(each) for each in self._z], z)
        if not np.isfinite(raw).any():
            return _Points(z, log_p, np.full(len(z), -np.log(len(z))), np.inf, -np.inf)
        return _Points(z, log_p, *smoothed_weights(raw))


def _at_mode(target: PlaceTarget) -> Student:
    """Gaussian fit at the best mode, found from the priors' middle and from little noise."""
    rates = target.rows.y[target.rows.seen]
    start = np.zeros((2, target.n_scores))
    start[:, 1] = np.log(np.clip(np.std(rates) / 0.2, 1e-2, 3.0)) - np.array([0.7, 2.5])
    z, value, scale = laplace(target.log_density, start, n_steps=12)
    best = int(np.argmax(value))
    return Student(z[best], scale[best])


def _defensive(proposal: Student, target: PlaceTarget) -> Student:
    """Proposal for beta0 and the noises as told, the prior for the scores of places."""
    n = 3
    cov = 1.5 * proposal.scale @ proposal.scale.T
    cov[n:], cov[:, n:] = 0.0, 0.0
    cov[n:, n:] = np.eye(target.n_scores - n)
    center = np.append(proposal.center[:n], np.zeros(target.n_scores - n))
    return proposal._replace(center=center, scale=np.linalg.cholesky(cov))


def _draw(
    target: PlaceTarget, z: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Parameters and effects at the points of sorted indices."""
    n, places, place = len(chosen), target.places, target.place
    n_units, n_coefficients = len(places.units), len(target.mean)
    c, g = rng.standard_normal((n, n_coefficients)), rng.standard_normal((n, n_units))
    theta, at = np.empty((n, 6)), 0
    unique, count = np.unique(chosen, return_counts=True)
    step = max(1, int(_NUMBERS / (8 * n_units**2)))
    for i in range(0, len(unique), step):
        law = target.conditional(z[unique[i : i + step]])
        for k, of in enumerate(count[i : i + step]):
            rows = slice(at, at := at + int(of))
            theta[rows] = law.theta[k]
            c[rows], g[rows] = _given_theta(law, k, c[rows], g[rows])
    params = dict(zip(("beta0", "delta_w", "delta_v"), theta.T, strict=False))
    names = ("tau_s", "length_scale", "tau_e")
    hyper: dict[str, np.ndarray] = dict(zip(names, theta[:, 3:].T, strict=True))
    params |= {"beta": c[:, :-1], "b": c[:, -1]}
    params |= {name: hyper[name] for name in place.names}
    return params | split_units(g, hyper, places, place, rng)


def split_units(
    g: np.ndarray,
    hyper: dict[str, np.ndarray],
    places: Visited,
    place: PlaceEffect,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Effects of cells, place (draw, cell), and bounds, place_bound (draw, unit), given their sums.

    Args:
        g: Effects of units, (draw, unit).
        hyper: Hyperparameters by name, each (draw,).
        places: Visited places.
        place: Effects there are.
        rng: Random number generator.
    """
    if not place.bounds:
        return {"place": g}
    if not place.cells:
        return {"place_bound": g}
    s = np.empty((len(g), len(places.cells)))
    theta = np.stack([hyper[name] for name in ("tau_s", "length_scale", "tau_e")], axis=1)
    new = np.flatnonzero(np.r_[True, (theta[1:] != theta[:-1]).any(1), True])
    for i, j in itertools.pairwise(new):  # equal neighbours share their factors
        s[i:j] = _cells_given_units(places, theta[i], g[i:j], rng)
    return {"place": s, "place_bound": g - s[:, places.cell_of]}


def _given_theta(
    law: Conditional, k: int, c: np.ndarray, g: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients and effects of standard normal numbers (draw, ...), at the k-th point."""
    c = np.linalg.solve(law.factor[k].T, law.half[k][:, None] + c.T).T
    right = law.of_units[k, -1] - c @ law.of_units[k, :-1]
    return c, place_prior.solve(law.L[k], right + g, transposed=True)


def _cells_given_units(
    places: Visited, theta: np.ndarray, g: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """S at visited cells given g (draw, unit), by Matheron's rule: a prior draw, corrected."""
    tau_s, length_scale, tau_e = theta
    n_cells, w = len(places.cells), np.sqrt(np.bincount(places.cell_of).astype(float))
    K, M = np.zeros((2, n_cells, n_cells))
    one = np.ones(n_cells)
    place_prior.fill_cells(K, places.cells, places.shape, one, tau_s, length_scale, 1e-5 * tau_s)
    place_prior.fill_cells(M, places.cells, places.shape, w, tau_s, length_scale, tau_e)
    place_prior.factor(K)
    place_prior.factor(M)
    s = rng.standard_normal((len(g), n_cells)) @ K.T  # its upper triangle is 0
    gap = g - s[:, places.cell_of] - tau_e * rng.standard_normal(g.shape)
    of_cells = gap @ np.eye(n_cells)[places.cell_of]
    v = place_prior.solve(M, place_prior.solve(M, of_cells / w), transposed=True) * w
    return s + (v @ K) @ K.T
