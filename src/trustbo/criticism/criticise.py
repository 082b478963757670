"""Criticism of a fitted trust model: tests, residuals and comparisons, with a verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.criticism.ablation import ablate
from trustbo.criticism.departures import Departure, departures
from trustbo.criticism.findings import (
    IN_CONTACT,
    LEAST,
    coverage_row,
    family_test,
    finding,
    size_of,
    verdict_of,
)
from trustbo.criticism.joint_normal import (
    Data,
    Normal,
    gather,
    joint_normal,
    posterior_point,
    with_start,
)
from trustbo.criticism.normal_scores import with_normal_rates
from trustbo.criticism.prior_moments import Coefficients, coefficients_of, test_prior
from trustbo.criticism.residuals import curves_of, groups_of, table_of_rates
from trustbo.criticism.robots import (
    SIZE,
    effects_of_robots,
    finding_on_robots,
    with_robots,
)
from trustbo.criticism.score import Derivatives, Innovations, Outcome, derivatives, holm
from trustbo.data import Mission
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, require_whole
from trustbo.inference.posterior_tree import missions_of
from trustbo.models.families import FAMILIES
from trustbo.models.model import TrustModel
from trustbo.parallel import one_blas_thread

_LEVEL = 0.05
_ROBOT = "robot in a mission"
_ALIKE = 1e-9
"""Range of rates below which they are all but equal."""
_LEAST = 1e-6
"""Lower limit of probabilities in tables; a smaller one is 0."""
_SITES = ({"beta0", "beta", "b", "delta_w", "delta_v"}, {"B0", "B", "b", "Delta_w", "Delta_v"})
_ATTRIBUTES = ("observation", "x0_mean", "x0_sd", "seed")


@dataclass(frozen=True, eq=False, repr=False)
class Criticism(Summary):
    """Criticism of a fitted model.

    Attributes:
        verdict: Verdict in words.
        fault: Check that explains most of what is wrong, `"none"` if nothing is found.
        table: Row of each check (index `check`): the label with the strongest evidence; its
            statistic; its size, and the limit from which on it is a fault, see `criticise`; p, of
            this check alone; p_adjusted, for the number of checks (Holm); p_after,
            once the fault that explains most is accounted for; and the finding in words. A
            probability below 1e-6, which is extrapolated, is 0.
        rates: Row of each measured rate: mission, bound, robot, row, col, contact_rate, expected
            and sd given the rates before (of the normal rates), standardised residual, pit, and
            `ahead`, the standardised residual of predictions one mission ahead.
        groups: Mean residual by kind (mission, bound, robot, cell, contact: class of expected
            rate) and group, the half-width `band` of its simultaneous 95 % band, and whether it
            stands out.
        curves: PIT (u, its distribution less the uniform one), autocorrelation (lag, in bounds;
            mission_lag) and coverage one mission ahead (level), each with `_low` and `_high` of its
            simultaneous 95 % band.
        robots: Row of each mission and robot: its effect as a share of line of sight, less the
            median of all, sd, the probabilities that it is below -0.1 and above 0.1, and whether it
            stands out: one of them exceeds 0.95.
        ablation: LOO with and without each component, and prior sensitivity: comparison,
            difference, its standard error and finding; empty without `compare`.
    """

    verdict: str
    fault: str
    table: pd.DataFrame
    rates: pd.DataFrame
    groups: pd.DataFrame
    curves: xr.Dataset
    robots: pd.DataFrame
    ablation: pd.DataFrame

    def _rows(self) -> Rows:
        rows = [(str(name), str(row["finding"])) for name, row in self.table.iterrows()]
        return [("verdict", self.verdict), *rows]


@one_blas_thread()
def criticise(
    posterior: xr.DataTree,
    missions: Sequence[Mission] | None = None,
    *,
    model: TrustModel | None = None,
    compare: bool = True,
    n_replicates: int = 1000,
    seed: int = 0,
) -> Criticism:
    """Test a fitted model for what may be wrong with it, and name it.

    Robots come first, of a model with effects of robots and places, which is fitted if the
    posterior is of another: a robot that stands out in a mission, `P(|d| > .1) > .95` for its share
    d of line of sight, less the team's median, is the fault `"robot in a mission"`.

    Then effects of places, a response to a feature that bends, a prior in conflict with the rates,
    correlated noise, and the family of observations, each by a score test of the standardised
    residuals of predictions one bound ahead, calibrated by replicates. A fault is found at 5 % of
    all these tests together (Holm's method), and is of a size that changes plans or coverage: .05
    of contact, root mean square over the rates; .2 of the variance, of correlation; .05 of the
    share of rates in 90 % intervals, of the family. Each fault is put into the model and the others
    are tested again: the one that leaves the least evidence is named, of those that leave none the
    one of least p. Missions are counted from 0, as in the posterior.

    Args:
        posterior: DataTree from `fit`, or one of `Result.posteriors`. Of rates that are not
            Gaussian, residuals are those of normal ones that stand for them, drawn once: trust
            drawn from the posterior, and a randomised normal score of the rate given it. Of
            censored rates, this is the rate before it was cut.
        missions: Missions that it was fitted to, or all of its campaign; needed where it holds no
            data.
        model: Its model, needed for comparisons if its priors are custom.
        compare: Whether to compare, by LOO, with the model without each feature, and with or
            without places: each is a fit.
        n_replicates: Number of replicates for p-values and bands.
        seed: Seed of the replicates, and of normal rates.

    Raises:
        TrustboError: The posterior is not of a linear model, or holds no data and no missions are
            given; the missions are others than it was fitted to; there are
            too few rates, or more than 2000; or they are all but equal.
    """
    require_whole("n_replicates", n_replicates, 100)
    missions = _checked(posterior, missions)
    rates = np.concatenate([mission.contact_rate for mission in missions])
    rates = rates[np.isfinite(rates)]
    alike = TrustboError(
        "the rates are all but equal, so that residuals say nothing of the model; criticise "
        "missions that differ."
    )
    if rates.size and np.ptp(rates) < _ALIKE:
        raise alike
    try:
        return _criticise(posterior, missions, model, compare, n_replicates, seed)
    except np.linalg.LinAlgError:
        raise alike from None


class _Tested(NamedTuple):
    """Tests of the residuals of one posterior."""

    data: Data
    by_parameter: Derivatives
    draws: np.ndarray
    innovations: Innovations
    departures: list[Departure]
    left_out: dict[str, str]
    coefficients: Coefficients
    outcomes: dict[str, Outcome]


def _tested(
    posterior: xr.DataTree, missions: list[Mission], n_replicates: int, seed: int
) -> _Tested:
    """Test the residuals; LinAlgError: rates are all but equal."""
    point, place = posterior_point(posterior)
    family = FAMILIES[posterior.attrs["observation"]]
    data = gather(missions, place, family.line_of_sight[0])
    data, point = with_normal_rates(posterior, missions, data, point, seed)
    point = with_start(point, data)
    normal, by_parameter = joint_normal(point, data), derivatives(point, data)
    n_parameters = len(by_parameter.names) - len(point.scales)  # scales of effects have priors
    if len(data.y) < 2 * n_parameters:
        raise TrustboError(
            f"{len(data.y)} rates are too few to criticise {n_parameters} parameters; "
            "give more missions."
        )
    rng = np.random.default_rng([seed, len(data.y)])
    draws = rng.standard_normal((len(data.y), n_replicates))
    innovations = Innovations.of_rates(normal, data.y, by_parameter, draws)
    tests, left_out = departures(missions, data, normal, point, place)
    coefficients = coefficients_of(posterior, point, by_parameter, list(missions[0].features))
    outcomes = _test_all(innovations, tests, coefficients, seed)
    return _Tested(
        data, by_parameter, draws, innovations, tests, left_out, coefficients, outcomes
    )  # fmt: skip


def _criticise(
    posterior: xr.DataTree,
    missions: list[Mission],
    model: TrustModel | None,
    compare: bool,
    n_replicates: int,
    seed: int,
) -> Criticism:
    """See `criticise`; LinAlgError: rates are all but equal."""
    tested = _tested(posterior, missions, n_replicates, seed)
    outcomes, innovations, coefficients = tested.outcomes, tested.innovations, tested.coefficients
    adjusted = holm(np.array([outcome.p for outcome in outcomes.values()]))
    by_name = {test.name: test for test in tested.departures}
    sizes = {
        name: size_of(one, by_name.get(name), innovations, coefficients)
        / (tested.data.unit if name in IN_CONTACT else 1.0)
        for name, one in outcomes.items()
    }
    clear = [name for name, p in zip(outcomes, adjusted, strict=True) if p <= _LEVEL]
    wrong = [name for name in clear if sizes[name] > LEAST[name]]
    wider = with_robots(posterior, missions)
    robots = effects_of_robots(wider)
    (odd, effect, sentence), departure = finding_on_robots(robots, tested.data)
    if departure is not None:
        fault, left = _ROBOT, _outcomes_with(departure, odd, tested, seed)
    else:
        after = {
            name: _outcomes_with(by_name.get(name), outcomes[name].label, tested, seed)
            for name in wrong
        }
        fault = _most_explaining(outcomes, after)
        left = after.get(fault, {})
    rows = {}
    for (name, one), p in zip(outcomes.items(), adjusted, strict=True):
        words = "nothing found."
        if name in clear:
            words = finding(name, one, innovations, tested.data, missions, by_name, coefficients)
            if sizes[name] <= LEAST[name]:
                words += " It is too small to be a fault."
        p_after = left[name].p if name in left else np.nan
        size = sizes[name], LEAST[name]
        rows[name] = one.label, one.statistic, *size, one.p, p, p_after, words
    rows |= {n: ("", *[np.nan] * 6, f"not tested: {why}") for n, why in tested.left_out.items()}
    rates = table_of_rates(missions, tested.data, innovations)
    groups = groups_of(rates, missions, tested.data, innovations)
    curves, rates["ahead"] = curves_of(tested.data, innovations, coefficients, tested.draws)
    rows["coverage"] = coverage_row(curves)
    rows[_ROBOT] = odd, effect, abs(effect), SIZE, *[np.nan] * 3, sentence
    head = ["label", "statistic", "size", "limit", "p", "p_adjusted", "p_after", "finding"]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=head).rename_axis("check")
    chances = ["p", "p_adjusted", "p_after"]
    table[chances] = table[chances].mask(table[chances] < _LEAST, 0.0)
    ablation = ablate(posterior, missions, model) if compare else ablate(None, missions, None)
    verdict = verdict_of(fault, table, wrong)
    return Criticism(verdict, fault, table, rates, groups, curves, robots, ablation)


def _test_all(
    innovations: Innovations, tests: Sequence[Departure], coefficients: Coefficients, seed: int
) -> dict[str, Outcome]:
    """Outcome of each departure, of the prior and of the family."""
    outcomes = {test.name: innovations.test(test) for test in tests}
    return outcomes | {
        "prior": test_prior(innovations, coefficients, seed),
        "family": family_test(innovations),
    }


def _most_explaining(
    outcomes: Mapping[str, Outcome], after: Mapping[str, Mapping[str, Outcome]]
) -> str:
    """Finding that leaves the least evidence of others once in the model; `"none"` if none.

    `after` has, by finding, the outcomes of the others with it in the model: none of the prior and
    the family, as no component of a model accounts for them. Of findings that leave no other one,
    it is that of least p.
    """
    enough = np.log(_LEVEL / len(outcomes))

    def rank(name: str) -> tuple[float, float]:
        left = [{**outcomes, **after[name]}[other].log_p for other in after if other != name]
        return min(*left, enough, enough), -outcomes[name].log_p

    return max(after, key=rank, default="none")


def _outcomes_with(
    fault: Departure | None, label: str, tested: _Tested, seed: int
) -> dict[str, Outcome]:
    """Outcomes of all other tests with a label of a departure in the model; none without one."""
    if fault is None:
        return {}
    innovations = tested.innovations
    normal, by_parameter = innovations.normal, tested.by_parameter
    if label in fault.sources:
        U = fault.sources[label]
        normal = Normal(normal.mean, normal.cov + innovations.size_of(U) * U, normal.carry)
    else:
        columns = normal.carry @ fault.effects[label]
        names = [*by_parameter.names, *[label] * columns.shape[1]]
        mean = np.column_stack([by_parameter.mean, columns])
        by_parameter = Derivatives(names, mean, by_parameter.cov)
    wider = Innovations.of_rates(normal, tested.data.y, by_parameter, tested.draws)
    others = [test for test in tested.departures if test.name != fault.name]
    outcomes = _test_all(wider, others, tested.coefficients, seed)
    return {name: one for name, one in outcomes.items() if name in tested.outcomes}


def _checked(posterior: xr.DataTree, missions: Sequence[Mission] | None) -> list[Mission]:
    """Missions of a posterior that can be criticised."""
    if not isinstance(posterior, xr.DataTree) or "posterior" not in posterior.children:
        raise TrustboError(
            f"criticise takes a posterior of trustbo.fit; got {type(posterior).__name__}."
        )
    missing = [name for name in _ATTRIBUTES if name not in posterior.attrs]
    sites = set(posterior["posterior"].data_vars)
    linear = any(sites_of <= sites for sites_of in _SITES)
    if missing or not linear or "prior" not in posterior.children:
        what = f"the attribute {missing[0]!r}" if missing else "the group 'prior'"
        what = what if linear else "beta0, beta, b, delta_w and delta_v of a linear drift"
        raise TrustboError(
            f"this posterior lacks {what}, so that its residuals are not known; criticise takes "
            "posteriors of PooledTrust, HierarchicalTrust and CoupledTrust from trustbo.fit."
        )
    return missions_of(posterior) if missions is None else _learned(posterior, missions)


def _learned(posterior: xr.DataTree, missions: Sequence[Mission]) -> list[Mission]:
    """Missions of a posterior, among those given: a campaign may leave some out.

    TrustboError: some are not given, or differ from the posterior's data.
    """
    given, numbers = list(missions), np.atleast_1d(posterior.attrs.get("missions", []))
    if len(numbers) not in (0, len(given)):
        if len(given) <= numbers.max():
            raise TrustboError(
                f"the posterior learned from mission {numbers.max() + 1}, and {len(given)} are "
                "given; give all missions that the campaign had."
            )
        given = [given[j] for j in numbers]
    if "constant_data" in posterior.children:
        held = missions_of(posterior)
        if len(held) != len(given):
            raise TrustboError(
                f"the posterior is of {len(held)} missions, and {len(given)} are given; give "
                "those it was fitted to, or none, as it holds their data."
            )
        for j, (mission, other) in enumerate(zip(held, given, strict=True)):
            rates = mission.contact_rate, np.asarray(other.contact_rate)
            if rates[0].shape != rates[1].shape or not np.allclose(*rates, equal_nan=True):
                raise TrustboError(
                    f"mission {j} has other contact rates than the posterior was fitted to; give "
                    "the missions it was fitted to, or none, as it holds their data."
                )
    return given
