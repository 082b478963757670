"""Test of the prior of coefficients against their estimates from the rates alone."""

import re
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from trustbo.criticism.joint_normal import Point
from trustbo.criticism.score import Derivatives, Innovations, Outcome, judge
from trustbo.models.params import CoupledParams, assemble_params


class Coefficients(NamedTuple):
    """Coefficients that the mean of rates is linear in: weights and intercepts."""

    labels: list[str]
    is_weight: np.ndarray  # (coefficient,), whether it is a weight of a robot's own awareness
    fitted: np.ndarray  # posterior mean, (coefficient,)
    mean: np.ndarray  # of the prior at the posterior mean of beta0, (coefficient,)
    cov: np.ndarray  # (coefficient, coefficient)
    jacobian: np.ndarray  # of the mean of the rates, (rate, coefficient)
    columns: list[int]  # among all parameters


def coefficients_of(
    posterior: xr.DataTree, point: Point, by_parameter: Derivatives, features: list[str]
) -> Coefficients:
    """Coefficients of a posterior and the moments of their prior, from the group `prior`."""
    sites = {
        str(n): a.transpose("chain", "draw", ...).values[0]
        for n, a in posterior["prior"].to_dataset().items()
    }
    prior = assemble_params(sites, {"x0_mean": 0.0, "x0_sd": 0.0}).flat()
    fields = {"b": np.asarray(prior.b), prior.WEIGHTS: np.asarray(getattr(prior, prior.WEIGHTS))}
    coupled = isinstance(prior, CoupledParams)
    if posterior.attrs.get("prior_stationary") == "True" and not coupled:
        shrink = (1.0 - point.params.beta0) / (1.0 - prior.beta0)  # pyright: ignore
        fields["b"] = fields["b"] * shrink
        fields["beta"] = fields["beta"] * shrink[..., None]
    labels, is_weight, columns, fitted, draws = [], [], [], [], []
    for column, name in enumerate(by_parameter.names):
        field, _, rest = name.partition("[")
        if field not in fields:
            continue
        where: tuple[int, ...] = tuple(map(int, re.findall(r"\d+", rest)))
        is_own = field != "b" and (not coupled or where[1] == where[2])
        label = name
        if field != "b":
            feature = features[where[0] if coupled else where[-1]]
            others = where[1:] if coupled else where[:-1]
            label = feature + "".join(f"[{i}]" for i in others)
        labels.append(label)
        is_weight.append(is_own)
        columns.append(column)
        fitted.append(np.asarray(getattr(point.params, field))[where])
        draws.append(fields[field][:, *where])
    values = np.array(draws)
    return Coefficients(
        labels,
        np.array(is_weight),
        np.array(fitted, dtype=float),
        values.mean(1),
        np.atleast_2d(np.cov(values)),
        by_parameter.mean[:, columns],
        columns,
    )


def estimate(innovations: Innovations, coefficients: Coefficients) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the coefficients from the rates alone.

    Generalised least squares of all parameters of the mean, one step from the posterior's.
    """
    inverse = np.linalg.pinv(innovations.X.T @ innovations.X, rcond=1e-10)
    step = inverse @ (innovations.X.T @ innovations.white)
    columns = coefficients.columns
    return coefficients.fitted + step[columns], inverse[np.ix_(columns, columns)]


def test_prior(innovations: Innovations, coefficients: Coefficients, seed: int) -> Outcome:
    """Test each coefficient for conflict with its prior, and each weight for a wrong sign.

    Conflict: the estimate is too far from the prior's mean for the spread of both (Evans and
    Moshonov 2006). Wrong sign: the estimate is beyond 0, on the side away from the prior's mean;
    where that is 0, either sign is right.
    """
    (mean, cov), n_replicates = estimate(innovations, coefficients), innovations.e.shape[1] - 1
    rng = np.random.default_rng([seed, 1])
    signed = np.abs(coefficients.mean) >= 0.1 * np.sqrt(np.diag(coefficients.cov))
    weights = np.flatnonzero(coefficients.is_weight & signed)
    both = cov + coefficients.cov
    sd, se = np.sqrt(np.diag(both)), np.sqrt(np.diag(cov))
    noise = [
        np.linalg.cholesky(C + 1e-12 * np.trace(C) * np.eye(len(C)))
        @ rng.standard_normal((len(C), n_replicates))
        for C in (both, cov)
    ]
    far = np.column_stack([mean - coefficients.mean, noise[0]]) / sd[:, None]
    off = np.column_stack([mean, noise[1]]) * (-np.sign(coefficients.mean) / se)[:, None]
    off = off[weights]
    log_p = np.concatenate([np.log(2.0) + stats.norm.logsf(np.abs(far)), stats.norm.logsf(off)])
    labels = [*coefficients.labels, *(f"sign of {coefficients.labels[i]}" for i in weights)]
    statistic = np.concatenate([far, off])[:, 0]
    return judge(labels, statistic, log_p[:, 0], log_p[:, 1:])
