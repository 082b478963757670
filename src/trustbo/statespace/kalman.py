"""The recursion over bounds: prediction, update, simulation and expected trust.

All functions are pure and take the parameters as a `StateSpace`. They work in NumPy and, unless
they draw random numbers, in JAX.
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

from trustbo.statespace.form import Inputs, StateSpace
from trustbo.statespace.matrices import apply, namespace, product, transpose

_JITTER = 1e-12  # added to covariances, which may be singular, before drawing


class MomentMatching(Protocol):
    """The method of a likelihood that `update` needs."""

    def moment_match(self, y: Any, n_ticks: Any, mean: Any, var: Any, sd: Any, /) -> Any:
        """Match the moments of N(f; mean, var) times the likelihood of the rate y.

        Returns the log mass, mean and variance of the product; 0, mean and var where y is NaN.
        """
        ...


class Likelihood(MomentMatching, Protocol):
    """Likelihood of a contact rate, such as an observation family."""

    def sample(self, f: Any, sd: Any, n_ticks: Any, rng: np.random.Generator, /) -> Any:
        """Draw rates given the linear predictor f."""
        ...


class Belief(NamedTuple):
    """Normal distribution N(mean, cov) of trust x = d + o after a bound, at each point."""

    mean: Any  # (point, group, member)
    cov: Any  # (point, group, member, member)
    offset: Any  # o of the last bound, (point, group, member)
    noise: Any  # g of the last bound, (point, group, member)


def initial(space: StateSpace, n_groups: int, offset: Any = 0.0) -> Belief:
    """Return the belief before the first bound.

    Args:
        space: Parameters.
        n_groups: Number of groups of robots.
        offset: Offset before the first bound; it only shifts the reported trust.
    """
    xp = namespace(space.transition)
    n_points = len(space.transition)
    shape = n_points, n_groups, space.n_members
    mean = xp.broadcast_to(space.initial_mean + offset, shape)
    cov = xp.broadcast_to(space.initial_cov, (*shape, space.n_members))
    offset = xp.broadcast_to(xp.asarray(offset, dtype=mean.dtype), shape)
    return Belief(mean, cov, offset, xp.ones(shape))


def step(A: Any, state: Any, drift: Any) -> Any:
    """Return A d + u, the expected state after a bound, for states d (..., member)."""
    return apply(A, state) + drift


def predict(space: StateSpace, belief: Belief, inputs: Inputs) -> Belief:
    """Predict trust after a bound, with inputs (point, group, member).

    m = A m + u,    P = A P A' + Q,

    where m is the mean of the state d. Since a belief describes trust d + o, the old offset is
    subtracted and the new one is added.
    """
    A = space.transition
    state = belief.mean - belief.offset
    mean = step(A, state, inputs.drift) + inputs.offset
    cov = product(product(A, belief.cov), transpose(A)) + space.process_cov
    xp = namespace(mean)
    offset = xp.broadcast_to(inputs.offset, mean.shape)
    return Belief(mean, cov, offset, xp.broadcast_to(inputs.noise, mean.shape))


def update(
    space: StateSpace, predicted: Belief, y: Any, n_ticks: Any, likelihood: MomentMatching
) -> tuple[Belief, Any]:
    """Update trust with rates y and tick counts (..., group, member), one member at a time.

    The likelihood matches the moments of the linear predictor f, which is exact for Gaussian rates.
    The regression of trust on f transfers the change to trust:

    K = cov(x, f) / var(f),    m = m + K (E[f | y] - E[f]),    P = P - K K' (var(f) - var(f | y))

    Returns:
        The updated belief, and the log density (point,) of the rates.
    """
    xp = namespace(predicted.mean)
    n = space.n_members
    sd = space.noise_sd * predicted.noise
    mean = predicted.mean
    cov = predicted.cov
    first = 0
    if space.shared_cov is not None:  # the joint normal has trust first, then linear predictors
        shared = xp.broadcast_to(space.shared_cov, cov.shape)
        mean = xp.concatenate([mean, mean], axis=-1)
        cov = xp.block([[cov, cov], [cov, cov + shared]])
        first = n

    log_density = xp.zeros(len(mean))
    for i in range(n):
        rate = y[..., i]
        if xp is np and np.isnan(rate).all():
            continue

        mean, cov, log_mass = condition(
            mean, cov, first + i, rate, n_ticks[..., i], sd[..., i], likelihood
        )
        log_density = log_density + xp.broadcast_to(log_mass, mean.shape[:-1]).sum(-1)

    updated = predicted._replace(mean=mean[..., :n], cov=cov[..., :n, :n])
    return updated, log_density


def condition(
    mean: Any, cov: Any, k: int, rate: Any, n_ticks: Any, sd: Any, likelihood: MomentMatching
) -> tuple[Any, Any, Any]:
    """Condition joint normals (..., n) on a rate whose linear predictor is entry k.

    Returns:
        The mean (..., n) and covariance (..., n, n) given the rate, and its log mass (...,).
    """
    xp = namespace(mean)
    m = mean[..., k]
    v = cov[..., k, k]
    log_mass, m_after, v_after = likelihood.moment_match(rate, n_ticks, m, v, sd)

    # A known predictor, with v = 0 and hence no covariance with the others, has no gain.
    gain = cov[..., k] / xp.where(v > 0.0, v, 1.0)[..., None]
    mean = mean + gain * (m_after - m)[..., None]
    cov = cov - gain[..., :, None] * gain[..., None, :] * (v - v_after)[..., None, None]
    return mean, cov, log_mass


class Ahead(NamedTuple):
    """Predictions of rates from the earlier rates of their block, each (draw, block, row)."""

    mean: np.ndarray
    """Mean of the linear predictor."""
    var: np.ndarray
    """Variance of the linear predictor."""
    log_p: np.ndarray
    """Log density of the rate given all rates of earlier rows; 0 where it was not measured."""


def one_step_ahead(
    mean: np.ndarray,
    cov: np.ndarray,
    sd: np.ndarray,
    y: np.ndarray,
    n_ticks: np.ndarray,
    likelihood: MomentMatching,
    n_at_once: int = 1,
) -> Ahead:
    """Predict the rate of each row of joint normals from the rates of earlier rows.

    Args:
        mean: Means of the linear predictors before any rate, shape (draw, block, row).
        cov: Their covariances, shape (draw, block or 1, row, row).
        sd: Standard deviation of each rate's own noise, shape (draw, block or 1, row or 1).
        y: Rates (block, row); NaN where not measured.
        n_ticks: Tick counts (block, row).
        likelihood: Observation family.
        n_at_once: Number of rows of one bound, whose mean and variance do not depend on the rates
            of the same bound.
    """
    shape = mean.shape
    n_rows = shape[-1]
    cov = np.broadcast_to(cov, (*shape, n_rows))
    sd = np.broadcast_to(sd, shape)
    ahead = Ahead(np.zeros(shape), np.zeros(shape), np.zeros(shape))
    for k in range(n_rows):
        if k % n_at_once == 0:
            of_bound = slice(k, k + n_at_once)
            ahead.mean[..., of_bound] = mean[..., of_bound]
            ahead.var[..., of_bound] = np.diagonal(cov, axis1=-2, axis2=-1)[..., of_bound]

        if not np.isnan(y[:, k]).all():
            mean, cov, ahead.log_p[..., k] = condition(
                mean, cov, k, y[:, k], n_ticks[:, k], sd[..., k], likelihood
            )

    return ahead


def marginal_log_densities(
    space: StateSpace, predicted: Belief, y: np.ndarray, n_ticks: np.ndarray, likelihood: Likelihood
) -> np.ndarray:
    """Compute the marginal log density (point, robot) of each rate; it is 0 for NaN rates."""
    cov = predicted.cov
    if space.shared_cov is not None:
        cov = cov + space.shared_cov

    var = np.diagonal(cov, axis1=-2, axis2=-1)
    sd = space.noise_sd * predicted.noise
    log_mass = likelihood.moment_match(y, n_ticks, predicted.mean, var, sd)[0]
    return np.where(np.isnan(y), 0.0, log_mass).reshape(len(var), -1)


def draw(belief: Belief, rng: np.random.Generator) -> Belief:
    """Draw trust, and return the draws as beliefs with zero variance."""
    mean = belief.mean + _noise(belief.cov, rng)
    return belief._replace(mean=mean, cov=np.zeros_like(belief.cov))


def simulate(
    space: StateSpace,
    drawn: Belief,
    inputs: Inputs,
    n_ticks: np.ndarray,
    likelihood: Likelihood,
    rng: np.random.Generator,
) -> tuple[Belief, np.ndarray]:
    """Draw trust after a bound given drawn trust before it, and rates (point, robot)."""
    now = draw(predict(space, drawn, inputs), rng)
    f = now.mean
    if space.shared_cov is not None:
        f = f + _noise(np.broadcast_to(space.shared_cov, now.cov.shape), rng)

    rates = likelihood.sample(f, space.noise_sd * now.noise, n_ticks, rng)
    return now, rates.reshape(len(rates), -1)


def forecast(
    space: StateSpace,
    belief: Belief,
    inputs: Iterable[Inputs],
    n_ticks: Iterable[np.ndarray],
    likelihood: Likelihood,
    rng: np.random.Generator,
) -> Iterator[tuple[Belief, np.ndarray]]:
    """Yield predicted trust and jointly drawn rates (point, robot), one bound at a time."""
    drawn = draw(belief, rng)
    for of_bound, ticks in zip(inputs, n_ticks, strict=True):
        belief = predict(space, belief, of_bound)
        drawn, rates = simulate(space, drawn, of_bound, ticks, likelihood, rng)
        yield belief, rates


def gaussian_match(y: Any, mean: Any, var: Any, sd: Any) -> tuple[Any, Any, Any]:
    """Match the moments of N(f; mean, var) times N(y; f, sd^2), without NaN."""
    xp = namespace(mean)
    total = var + sd**2
    error = y - mean
    log_mass = -0.5 * (error**2 / total + xp.log(2.0 * np.pi * total))
    return log_mass, mean + var / total * error, var - var**2 / total


class GaussianRates:
    """Likelihood of Gaussian rates in NumPy or JAX; tick counts are not used.

    NaN marks rates that were not measured.
    """

    def moment_match(
        self, y: Any, n_ticks: Any, mean: Any, var: Any, sd: Any, /
    ) -> tuple[Any, Any, Any]:
        """See `MomentMatching.moment_match`."""
        xp = namespace(mean)
        seen = ~xp.isnan(y)
        log_mass, after, left = gaussian_match(xp.where(seen, y, 0.0), mean, var, sd)
        return xp.where(seen, log_mass, 0.0), xp.where(seen, after, mean), xp.where(seen, left, var)


def _noise(cov: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw normal noise with covariances (..., member, member), which may be singular."""
    root = np.linalg.cholesky(cov + _JITTER * np.eye(cov.shape[-1]))
    return apply(root, rng.standard_normal(cov.shape[:-1]))
