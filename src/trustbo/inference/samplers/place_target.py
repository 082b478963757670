"""The posterior of hyperparameters with place effects, coefficients and effects integrated out.

Given z, the scores of (beta0, noises, tau_s, length scale, tau_e), rates are normal and linear in
the coefficients c = (beta, b) and the effects g of visited units. Normal equations over the units,
then over the coefficients (`place_rows`, `place_prior`): P = sum a^2 S + K_g^-1, and

    G <- G - h' P^-1 h,    -2 log p = y'y - x'x + log |V| + log |K_g| + log |P| + log |G_c + prior|

with x the forward solution of the coefficients. One density costs a Cholesky factor of units and
one of cells: .03 ms for 60 bounds. Derivation: docs/derivations/places.md.
"""

from typing import NamedTuple

import numpy as np

from trustbo.inference.evidence import place_prior
from trustbo.inference.evidence.place_rows import Rows, filter_rows
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.laplace import laplace
from trustbo.inference.samplers.place_draws import split_units
from trustbo.inference.samplers.small_matrices import small_cholesky
from trustbo.inference.samplers.student import Student
from trustbo.models.place import PlaceEffect, Visited
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import half_normal, of_coefficients

_MEMORY = 8e6  # numbers per chunk of parameter values
_NUMBERS = 2e8  # bytes of factors kept at once


class Conditional(NamedTuple):
    """Conditional distribution of coefficients and effects at each of some parameter values."""

    theta: np.ndarray  # (point, 6): beta0, delta_w, delta_v, tau_s, length_scale, tau_e
    log_p: np.ndarray  # (point,)
    factor: np.ndarray  # (point, c, c), Cholesky's, of the precision of the coefficients
    half: np.ndarray  # (point, c), factor^-1 times the right side: mean = factor'^-1 half
    of_units: np.ndarray  # (point, c + 1, unit), L^-1 h, the rates' last
    L: np.ndarray  # (point, unit, unit), factor of P


def hyperparameters(priors: Priors, place: PlaceEffect, z: np.ndarray) -> np.ndarray:
    """Theta (point, 6) of scores (point, score)."""
    theta = np.zeros((len(z), 6))
    theta[:, :3] = scores.beta0_and_noises(priors, z)
    theta[:, 4], rest = 1.0, iter(z[:, 3:].T)
    if place.cells:
        theta[:, 3] = half_normal(next(rest), place.tau_s)
        length_scale = place.length_scale * np.exp(place.length_scale_sd * next(rest))
        # Clip: trial points of the mode search can over- or underflow exp.
        theta[:, 4] = np.clip(length_scale, *place_prior.LENGTH_SCALES)
    if place.bounds:
        theta[:, 5] = half_normal(next(rest), place.tau_e)
    return theta


def above_jitter(theta: np.ndarray) -> np.ndarray:
    """Theta (point, 6) with tau_e no less than a jitter that keeps K_g regular."""
    noise = np.hypot(theta[:, 1], theta[:, 2])
    least = place_prior.JITTER * np.maximum(theta[:, 3], noise)
    return np.column_stack([theta[:, :5], np.maximum(theta[:, 5], least)])


def prior_of_places(proposal: Student) -> Student:
    """Keep the fitted proposal of (beta0, noises); use the prior for the scores of places."""
    n, d = 3, len(proposal.center)
    cov = 1.5 * proposal.scale @ proposal.scale.T
    cov[n:], cov[:, n:] = 0.0, 0.0
    cov[n:, n:] = np.eye(d - n)
    center = np.append(proposal.center[:n], np.zeros(d - n))
    return proposal._replace(center=center, scale=np.linalg.cholesky(cov))


class PlaceTarget:
    """Log posterior density of the scores."""

    n_pilot, widths = 256, (1.25, 1.1)
    n_final = 512
    """Points of the last proposal."""
    n_corrected = None

    def __init__(self, rows: Rows, places: Visited, priors: Priors, place: PlaceEffect) -> None:
        """Take the rows of all missions and the priors."""
        self.rows, self.places, self.priors, self.place = rows, places, priors, place
        self.n_scores = 3 + len(place.names)
        self.mean, self.precision = of_coefficients(priors.beta, priors.b, rows.X.shape[2] - 2)
        self.n_c = np.bincount(places.cell_of, minlength=len(places.cells)).astype(float)
        K, q, kinds = rows.y.shape[1], rows.X.shape[2], int(rows.kind[-1]) + 1
        self._chunk = max(4, int(_MEMORY / (K * (len(rows.y) * q + K * kinds))))

    def constrain(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Theta (point, 6) and the log prior density of scores (point, score)."""
        return hyperparameters(self.priors, self.place, z), scores.log_prior(z)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log posterior density, not divided by the evidence; shape (point,)."""
        parts = [self._evaluate(z[i : i + self._chunk]) for i in range(0, len(z), self._chunk)]
        return np.concatenate([part.log_p for part in parts])

    def log_evidence(self, theta: np.ndarray) -> np.ndarray:
        """Log p(rates | theta), theta as from `hyperparameters`; shape (point,)."""
        theta = above_jitter(theta)
        parts = [theta[i : i + self._chunk] for i in range(0, len(theta), self._chunk)]
        return np.concatenate([self._integrate(part, keep=False).log_p for part in parts])

    def conditional(self, z: np.ndarray) -> Conditional:
        """Conditional distribution of coefficients and effects given scores (point, score)."""
        return self._evaluate(z, keep=True)

    def first(self) -> Student:
        """Gaussian fit at the best mode, found from the priors' middle and from little noise."""
        rates = self.rows.y[self.rows.seen]
        start = np.zeros((2, self.n_scores))
        start[:, 1] = np.log(np.clip(np.std(rates) / 0.2, 1e-2, 3.0)) - np.array([0.7, 2.5])
        z, value, scale = laplace(self.log_density, start, n_steps=12)
        best = int(np.argmax(value))
        return Student(z[best], scale[best])

    def defensive(self, proposal: Student) -> Student:
        """See `prior_of_places`."""
        return prior_of_places(proposal)

    def recentre(self, z: np.ndarray) -> None:
        """No-op: the density is exact everywhere."""

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], None]:
        """Parameters and effects at the points of sorted indices; these draws need no weights."""
        n, places, place = len(chosen), self.places, self.place
        n_units, n_coefficients = len(places.units), len(self.mean)
        c, g = rng.standard_normal((n, n_coefficients)), rng.standard_normal((n, n_units))
        theta, start = np.empty((n, 6)), 0
        unique, count = np.unique(chosen, return_counts=True)
        step = max(1, int(_NUMBERS / (8 * n_units**2)))
        for i in range(0, len(unique), step):
            conditional = self.conditional(z[unique[i : i + step]])
            for k, repeats in enumerate(count[i : i + step]):
                rows = slice(start, start := start + int(repeats))
                theta[rows] = conditional.theta[k]
                c[rows], g[rows] = _given_theta(conditional, k, c[rows], g[rows])
        return name_draws(theta, c, g, places, place, rng), None

    def _evaluate(self, z: np.ndarray, *, keep: bool = False) -> Conditional:
        with np.errstate(all="ignore"):  # far out noises under- and overflow: no density there
            theta, log_prior = self.constrain(z)
            total = np.hypot(theta[:, 1], theta[:, 2])
            ok = np.isfinite(theta).all(1) & (total > 1e-12) & np.isfinite(log_prior)
            theta = np.where(ok[:, None], theta, 0.1)
            integrated = self._integrate(above_jitter(theta), keep=keep)
            log_p = np.where(
                ok & np.isfinite(integrated.log_p), integrated.log_p + log_prior, -np.inf
            )
            return integrated._replace(log_p=log_p)

    def _integrate(self, theta: np.ndarray, *, keep: bool) -> Conditional:
        rows, n = self.rows, len(theta)
        S, R, G, log_det = filter_rows(
            theta, self.priors.x0_sd, rows.y, rows.seen, rows.X, rows.a, rows.weight, rows.length,
            rows.kind,
        )  # fmt: skip
        of_units, L = self._units(theta, S, R, log_det, keep=keep)
        G -= of_units @ of_units.transpose(0, 2, 1)
        rest = 1.0 - theta[:, :1] if self.priors.stationary else np.ones((n, 1))
        mean, precision = self.mean * rest, self.precision / rest**2
        of_c = G[:, :-1, :-1] + precision[:, :, None] * np.eye(len(self.mean))
        factor = np.ascontiguousarray(small_cholesky(of_c.transpose(1, 2, 0)).transpose(2, 0, 1))
        bad = ~np.isfinite(factor).all((1, 2)) | ~(G[:, -1, -1] > 0.0)
        factor[bad] = np.eye(factor.shape[1])
        half = np.linalg.solve(factor, (G[:, :-1, -1] + precision * mean)[..., None])[..., 0]
        misfit = G[:, -1, -1] + (precision * mean**2).sum(1) - (half**2).sum(1)
        log_det = log_det + 2.0 * np.log(np.einsum("tcc->tc", factor)).sum(1)
        log_det -= np.log(precision).sum(1)
        log_p = -0.5 * (misfit + log_det) - rows.n_measured * scores.LOG_ROOT_2PI
        return Conditional(theta, np.where(bad, np.nan, log_p), factor, half, of_units, L)

    def _units(
        self, theta: np.ndarray, S: np.ndarray, R: np.ndarray, log_det: np.ndarray, *, keep: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """L^-1 h and, if kept, L of each P; adds log |K_g| + log |P| to `log_det`."""
        rows, places, n_units = self.rows, self.places, len(self.places.units)
        n_cells, w = len(places.cells), np.sqrt(self.n_c)
        of_units = np.zeros((len(theta), R.shape[3], n_units))
        kept = np.zeros((len(theta) if keep else 0, n_units, n_units))
        A, M = np.zeros((n_units, n_units)), np.zeros((n_cells, n_cells))
        for t, (tau_s, length_scale, tau_e) in enumerate(theta[:, 3:]):
            place_prior.fill_cells(M, places.cells, places.shape, w, tau_s, length_scale, tau_e)
            failed = place_prior.factor(M)
            log_det[t] += 2.0 * np.log(M.diagonal()).sum()
            log_det[t] += 2.0 * (n_units - n_cells) * np.log(tau_e)
            place_prior.invert(M)
            place_prior.fill_units(A, M, places.cell_of, self.n_c, tau_e)
            place_prior.add_rows(
                A, of_units[t], S[t], R[t], rows.a, rows.weight, rows.length, rows.kind, rows.unit
            )
            failed = place_prior.factor(A) or failed
            log_det[t] = np.nan if failed else log_det[t] + 2.0 * np.log(A.diagonal()).sum()
            if failed:
                of_units[t] = np.nan
                continue
            of_units[t] = place_prior.solve(A, of_units[t])
            if keep:
                kept[t] = A
        return of_units, kept


def name_draws(
    theta: np.ndarray,
    c: np.ndarray,
    g: np.ndarray,
    places: Visited,
    place: PlaceEffect,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Posterior draws by name from theta (draw, 6), coefficients c and effects g of units."""
    params = dict(zip(("beta0", "delta_w", "delta_v"), theta.T, strict=False))
    names = ("tau_s", "length_scale", "tau_e")
    hyper: dict[str, np.ndarray] = dict(zip(names, theta[:, 3:].T, strict=True))
    params |= {"beta": c[:, :-1], "b": c[:, -1]}
    params |= {name: hyper[name] for name in place.names}
    return params | split_units(g, hyper, places, place, rng)


def _given_theta(
    conditional: Conditional, k: int, c: np.ndarray, g: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients and effects of standard normal numbers (draw, ...), at the k-th point."""
    c = np.linalg.solve(conditional.factor[k].T, conditional.half[k][:, None] + c.T).T
    right = conditional.of_units[k, -1] - c @ conditional.of_units[k, :-1]
    return c, place_prior.solve(conditional.L[k], right + g, transposed=True)
