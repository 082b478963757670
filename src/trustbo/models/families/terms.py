"""Terms of rates in latent trust: their log values, Gaussian sites that match them, exact draws.

A rate's term t(x) is its density or probability given trust x: nothing measured, N(y; x, dv^2),
Phi((x - 1) / dv) for a rate of 1, Phi(-x / dv) for one of 0, or the beta-binomial probability of a
count. A site exp(-lam x^2 / 2 + eta x) stands for it. Given the cavity N(m, v), the rest of the
posterior, the new site has the mean and variance of cavity times term: in closed form where rates
are censored, by 7 Gauss-Hermite nodes on cavity times old site for counts, whose log probability is
read from a table (concentration, count, trust), cubic in both; only sites see the table's error,
never weights. Sites are log-concave, as terms are, so that lam > 0.
"""

import math
from typing import Any, NamedTuple, Self

import numpy as np
from numba import njit
from scipy.stats import norm

from trustbo.parallel import PART

NONE, GAUSSIAN, AT_ONE, AT_ZERO, COUNT, INTERVAL = range(6)
_NUMERICS = {
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},  # NaN and inf keep their meaning
    "error_model": "numpy",
}
OPTIONS: dict[str, Any] = {"cache": True, **_NUMERICS}
PART_OPTIONS: dict[str, Any] = {**PART, **_NUMERICS}
LOG_2PI = 1.8378770664093453
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()
_X_LOW, _X_STEP, N_X = -14.0, 0.2, 141  # trust; log-linear beyond
_PHI_LOW, _PHI_STEP, _N_PHI = -2.5, 0.35, 48  # log concentration
_BINS = 4096
_KNOTS = norm.ppf(np.arange(_BINS + 1) / _BINS)
_KNOTS[0], _KNOTS[-1] = -6.0, 6.0  # 1e-9 of a normal's mass lies beyond
_LOG_DENSITY = -np.log(_BINS * np.diff(_KNOTS))
"""Log density within each bin of a variable that is uniform in bins of equal probability."""
_WIDE, _LOG_WIDE = 1.15, math.log(1.15)  # candidates' sd, in units of cavity times site


class Terms(NamedTuple):
    """Terms of rates, arrays of their shape, and first guesses of their sites."""

    kind: np.ndarray
    lam: np.ndarray
    eta: np.ndarray
    case: np.ndarray  # index of its count
    counts: np.ndarray  # (case, 2): ticks in contact, ticks

    @classmethod
    def of(
        cls,
        kind: np.ndarray,
        lam: np.ndarray | None = None,
        eta: np.ndarray | None = None,
        case: np.ndarray | None = None,
        counts: np.ndarray | None = None,
    ) -> Self:
        """Build terms, with defaults for counts and for first guesses of the sites."""
        zero = np.zeros(kind.shape)
        return cls(
            kind,
            zero if lam is None else lam,
            zero if eta is None else eta,
            np.zeros(kind.shape, dtype=int) if case is None else case,
            np.zeros((0, 2)) if counts is None else counts,
        )


@njit(**OPTIONS)
def log_count(n, N, phi, x):
    """Log probability of n of N ticks, beta-binomial of mean sigma(x) and concentration phi.

    Without what does not depend on x, see `constants`.
    """
    a, b, value = phi / (1.0 + math.exp(-x)), phi / (1.0 + math.exp(x)), 0.0
    if n > 0.0:
        value += math.lgamma(n + a) - math.lgamma(a)
    if n < N:
        value += math.lgamma(N - n + b) - math.lgamma(b)
    return value


@njit(**OPTIONS)
def constants(counts, phi):
    """Terms of the log probabilities of counts (case, 2) that do not depend on trust, (case,)."""
    out = np.empty(len(counts))
    for i in range(len(counts)):
        n, N = counts[i]
        out[i] = math.lgamma(N + 1.0) - math.lgamma(n + 1.0) - math.lgamma(N - n + 1.0)
        out[i] -= math.lgamma(N + phi) - math.lgamma(phi)
    return out


@njit(**OPTIONS)
def concentration(delta_v):
    """Concentration of counts, at most 1e6, as `families.beta_binomial` has it."""
    return 1.0 / (delta_v * delta_v + 1e-6)


@njit(**OPTIONS)
def count_tables(counts):
    """Log probabilities of distinct counts (case, 2), n and N: (phi, case, x)."""
    out = np.empty((_N_PHI, len(counts), N_X))
    for f in range(_N_PHI):
        phi = math.exp(_PHI_LOW + _PHI_STEP * f)
        constant = constants(counts, phi)
        for i in range(len(counts)):
            for g in range(N_X):
                x = _X_LOW + _X_STEP * g
                out[f, i, g] = constant[i] + log_count(counts[i, 0], counts[i, 1], phi, x)
    return out


@njit(**PART_OPTIONS)
def _lagrange(s):
    """Weights of the cubic through -1, 0, 1, 2."""
    return (
        -s * (s - 1.0) * (s - 2.0) / 6.0,
        (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
        -(s + 1.0) * s * (s - 2.0) / 2.0,
        (s + 1.0) * s * (s - 1.0) / 6.0,
    )


@njit(**PART_OPTIONS)
def new_table(tables):
    """Room for `table_at`, one row at least: rates that are no counts have the index 0 too."""
    return np.zeros((max(1, tables.shape[1]), N_X))


@njit(**OPTIONS)
def table_at(tables, delta_v, out):
    """Tables at one concentration, into out (case, x)."""
    position = (math.log(concentration(delta_v)) - _PHI_LOW) / _PHI_STEP
    position = (
        min(position, _N_PHI - 2.001) if position >= 1.0 else 1.0
    )  # of NaN too, which is no index
    i = int(position)
    a, b, c, d = _lagrange(position - i)
    for j in range(tables.shape[1]):
        for g in range(N_X):
            out[j, g] = (
                a * tables[i - 1, j, g]
                + b * tables[i, j, g]
                + c * tables[i + 1, j, g]
                + d * tables[i + 2, j, g]
            )


@njit(**OPTIONS)
def _read(row, x):
    """Log probability of a count at trust x, from its row of the table."""
    position = (x - _X_LOW) / _X_STEP
    if position < 1.0:
        return row[1] + (position - 1.0) * (row[1] - row[0])
    if not position <= N_X - 2.001:  # NaN too, which is no index
        return row[N_X - 2] + (position - (N_X - 2.0)) * (row[N_X - 1] - row[N_X - 2])
    i = int(position)
    a, b, c, d = _lagrange(position - i)
    return a * row[i - 1] + b * row[i] + c * row[i + 1] + d * row[i + 2]


@njit(**PART_OPTIONS)
def log_phi(h):
    """Log Phi(h) and phi(h) / Phi(h), with Phi and phi the normal distribution and density."""
    if h > -6.0:
        p = 0.5 * math.erfc(-0.7071067811865476 * h)
        return math.log(p), 0.3989422804014327 * math.exp(-0.5 * h * h) / p
    i = 1.0 / (h * h)  # asymptotic: to 1e-6 at h = -6, which only implausible parameters reach
    s = 1.0 - i * (1.0 - 3.0 * i * (1.0 - 5.0 * i * (1.0 - 7.0 * i * (1.0 - 9.0 * i))))
    return -0.5 * h * h - math.log(-h / s) - 0.5 * LOG_2PI, -h / s


@njit(**PART_OPTIONS)
def side_of(kind):
    """Side beyond which a censored rate lies, and its limit."""
    return (1.0, 1.0) if kind == AT_ONE else (-1.0, 0.0)


@njit(**PART_OPTIONS)
def match(kind, delta_v, row, m, v, lam, eta):
    """Log of the mass of cavity times term over that of cavity times old site; the new site."""
    if kind < COUNT:
        S = math.sqrt(delta_v * delta_v + v)
        side, limit = side_of(kind)
        h = side * (m - limit) / S
        log_p, rho = log_phi(h)
        g = rho * (h + rho)
        new, centre = 1e-12, m
        if g > 1e-12:
            new, centre = g / max(S * S - v * g, 1e-12), m + side * S / (h + rho)
        return log_p - log_overlap(m, v, lam, eta), new, new * centre
    D = 1.0 + lam * v
    center, sd = (m + eta * v) / D, math.sqrt(v / D)
    # Relative to the centre: unnormalised, terms of many ticks overflow.
    off = _read(row, center) - center * (eta - 0.5 * lam * center)
    f0 = f1 = f2 = 0.0
    for j in range(len(_NODES)):
        x = center + sd * _NODES[j]
        f = _WEIGHTS[j] * math.exp(min(_read(row, x) - x * (eta - 0.5 * lam * x) - off, 300.0))
        f0 += f
        f1 += f * _NODES[j]
        f2 += f * _NODES[j] ** 2
    a = f1 / f0
    mean, var = center + sd * a, sd * sd * max(f2 / f0 - a * a, 0.05)
    new = min(max(1.0 / var - 1.0 / v, 1e-6), 1e8)
    return off + math.log(f0), new, mean * (new + 1.0 / v) - m / v


@njit(**PART_OPTIONS)
def log_interval(a, b):
    """Log of Phi(b) - Phi(a), and the mean and variance of a standard normal between a and b."""
    if a > -b:  # mirrored: tails are accurate below
        log_p, mean, var = _below(-b, -a)
        return log_p, -mean, var
    return _below(a, b)


@njit(**PART_OPTIONS)
def _below(a, b):
    """`log_interval` of an interval whose middle is not above 0."""
    log_b, _ = log_phi(b)
    log_p, at_a, at_b, first = log_b, 0.0, 0.0, 0.0
    if a > -1e300:
        log_a, _ = log_phi(a)
        log_p += math.log(max(-math.expm1(min(log_a - log_b, 0.0)), 1e-300))
        at_a = math.exp(-0.5 * a * a - 0.5 * LOG_2PI - log_p)
        first = a * at_a
    if b < 1e300:
        at_b = math.exp(-0.5 * b * b - 0.5 * LOG_2PI - log_p)
        first -= b * at_b
    mean = min(max(at_a - at_b, a), b)
    return log_p, mean, min(max(1.0 + first - mean * mean, 1e-6), 1.0)


@njit(**PART_OPTIONS)
def match_interval(low, high, delta_v, noise, m, v, lam, eta):
    """`match` of a rate by which trust plus noise lies between two limits.

    `noise` (component, 2) has the weights of a mixture of normals, and their sds by `delta_v`.
    """
    log_p, mean, square = -np.inf, 0.0, 0.0
    for j in range(len(noise)):
        S2 = (noise[j, 1] * delta_v) ** 2 + v
        S = math.sqrt(S2)
        log_one, center, var = log_interval((low - m) / S, (high - m) / S)
        log_one += math.log(noise[j, 0])
        x = v / S * center  # mean of trust less m, and its variance, in this component
        rest = v - v * v / S2 * (1.0 - var)
        top = max(log_p, log_one)
        before, now = math.exp(log_p - top), math.exp(log_one - top)
        share = now / (before + now)
        mean += share * (x - mean)
        square += share * (rest + x * x - square)
        log_p = top + math.log(before + now)
    left = min(max(1.0 - (square - mean * mean) / v, 1e-12), 1.0 - 1e-12)
    new = left / (v * (1.0 - left))
    return log_p - log_overlap(m, v, lam, eta), new, new * (m + mean / left)


@njit(**OPTIONS)
def count_moments(mean, var, y, n_ticks, delta_v):
    """Mean and variance of trust N(mean, var) given counts, and their log probability.

    Newton's search for the mode takes the beta-binomial's slope and curvature by differences; its
    Gaussian fit carries the nodes. All arguments are (value,).
    """
    moments = np.empty((3, len(mean)))
    for t in range(len(mean)):
        N, m, v, phi = n_ticks[t], mean[t], var[t], concentration(delta_v[t])
        n, d = np.round(y[t] * n_ticks[t]), 0.05
        x, precision = m, 1.0 / v
        for _ in range(4):
            middle = log_count(n, N, phi, x)
            low, high = log_count(n, N, phi, x - d), log_count(n, N, phi, x + d)
            curvature = min((high - 2.0 * middle + low) / (d * d), 0.0)
            slope = (high - low) / (2.0 * d) - (x - m) / v
            precision = 1.0 / v - curvature
            step = slope / precision
            x += min(max(step, -2.0), 2.0)
            if abs(step) < 0.05 / np.sqrt(precision):
                break
        sd = 1.1 / np.sqrt(precision)
        off = log_count(n, N, phi, x) - 0.5 * (x - m) ** 2 / v
        f0 = f1 = f2 = 0.0
        for j in range(len(_NODES)):
            node = x + sd * _NODES[j]
            value = log_count(n, N, phi, node) - 0.5 * (node - m) ** 2 / v + 0.5 * _NODES[j] ** 2
            f = _WEIGHTS[j] * math.exp(min(value - off, 300.0))
            f0, f1, f2 = f0 + f, f1 + f * _NODES[j], f2 + f * _NODES[j] ** 2
        a = f1 / f0
        moments[0, t], moments[1, t] = x + sd * a, sd * sd * max(f2 / f0 - a * a, 0.05)
        constant = math.lgamma(N + 1.0) - math.lgamma(n + 1.0) - math.lgamma(N - n + 1.0)
        constant -= math.lgamma(N + phi) - math.lgamma(phi)
        moments[2, t] = off + math.log(f0) + math.log(sd / np.sqrt(v)) + constant
    return moments


@njit(**PART_OPTIONS)
def log_overlap(m, v, lam, eta):
    """Log of the integral of N(x; m, v) exp(-lam x^2 / 2 + eta x)."""
    D = 1.0 + lam * v
    return -0.5 * math.log(D) + (m * (eta - 0.5 * lam * m) + 0.5 * eta * eta * v) / D


@njit(**PART_OPTIONS)
def _beyond(h, log_p, rng):
    """Standard normal draw above -h, of log probability log_p."""
    if h < -4.0:  # Marsaglia's tail (1964), by rejection
        while True:
            e = math.sqrt(h * h - 2.0 * math.log(1.0 - rng.random()))
            if rng.random() * e < -h:
                return e
    if h > -0.5:  # by rejection too: three tries at most on average
        while True:
            e = rng.standard_normal()
            if e > -h:
                return e
    p = (1.0 - rng.random()) * math.exp(log_p)  # upper tail probability, below .31
    t = math.sqrt(-2.0 * math.log(p))
    e = t - (2.515517 + t * (0.802853 + t * 0.010328)) / (
        1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308))
    )
    for _ in range(2):  # Newton's steps take the error from 5e-4 to 1e-10 of the density
        f = 0.5 * math.erfc(0.7071067811865476 * e) - p
        e += f / (0.3989422804014327 * math.exp(-0.5 * e * e))
    return max(e, -h)


@njit(**PART_OPTIONS)
def _between(a, b, rng):
    """Standard normal draw between a and b, by rejection (Robert 1995)."""
    if a > -b:
        return -_between_below(-b, -a, rng)
    return _between_below(a, b, rng)


@njit(**PART_OPTIONS)
def _between_below(a, b, rng):
    """`_between` of an interval whose middle is not above 0."""
    top = min(b, 0.0)
    if b - a > 2.0 and (b > 0.0 or (b - a) * -b > 2.0):  # wide for the density: a tail, or all
        while True:
            e = rng.standard_normal() if b > 0.5 else -_beyond(b, log_phi(b)[0], rng)
            if a < e < b:
                return e
    while True:
        e = a + (b - a) * rng.random()
        if rng.random() < math.exp(0.5 * (top * top - e * e)):
            return e


@njit(**OPTIONS)
def draw_interval(low, high, delta_v, noise, mean, sd, rng):
    """`draw_censored` of a rate by which trust plus noise lies between two limits."""
    log_p, chosen = -np.inf, 0
    for j in range(len(noise)):
        S = math.hypot(sd, noise[j, 1] * delta_v)
        log_one = math.log(noise[j, 0]) + log_interval((low - mean) / S, (high - mean) / S)[0]
        top = max(log_p, log_one)
        log_p = top + math.log(math.exp(log_p - top) + math.exp(log_one - top))
        if math.log(1.0 - rng.random()) <= log_one - log_p:  # a choice by mass
            chosen = j
    own = noise[chosen, 1] * delta_v
    S = math.hypot(sd, own)
    e = S * _between((low - mean) / S, (high - mean) / S, rng)
    x = mean + sd * sd / (S * S) * e + sd * own / S * rng.standard_normal()
    return x, log_p


@njit(**OPTIONS)
def draw_censored(kind, delta_v, mean, sd, rng):
    """Trust drawn from N(mean, sd^2) times a censored rate's term, and the log of their integral.

    The rate before it was cut is drawn first, then trust given it.
    """
    side, limit = side_of(kind)
    S = math.hypot(sd, delta_v)
    h = side * (mean - limit) / S
    log_p, _ = log_phi(h)
    e = side * S * _beyond(h, log_p, rng)
    x = mean + sd * sd / (S * S) * e + sd * delta_v / S * rng.standard_normal()
    return x, log_p


@njit(**PART_OPTIONS)
def draw_count(count, phi, row, mean, sd, lam, eta, choice, rng):
    """Trust drawn from N(mean, sd^2) times term over site, and a log weight whose mean is right.

    One of some stratified candidates by its weight from the table; the table's error at the chosen
    one is corrected. The weight lacks the count's constant; `choice` (2, candidate) is for work.
    """
    candidates, weights = choice
    J, shift, best = len(candidates), rng.random(), -1e300
    for j in range(J):
        position = (j + shift) / J * _BINS
        i = min(int(position), _BINS - 1)
        e = _WIDE * (_KNOTS[i] + (position - i) * (_KNOTS[i + 1] - _KNOTS[i]))
        x = mean + sd * e
        candidates[j] = x
        value = _read(row, x) - x * (eta - 0.5 * lam * x)
        weights[j] = value - 0.5 * (e * e + LOG_2PI) - _LOG_DENSITY[i] + _LOG_WIDE
        best = max(best, weights[j])
    total = 0.0
    for j in range(J):
        weights[j] = math.exp(weights[j] - best)
        total += weights[j]
    left, j = rng.random() * total, 0
    while j < J - 1 and left > weights[j]:
        left -= weights[j]
        j += 1
    x = candidates[j]
    return x, best + math.log(total / J) + log_count(count[0], count[1], phi, x) - _read(row, x)
