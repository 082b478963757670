"""Criticism of a fitted trust model: tests, residuals and comparisons, with a verdict."""

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.criticism.ablation import ablate
from trustbo.criticism.departures import Departure, departures
from trustbo.criticism.findings import changes_plans, coverage_row, family_test, finding, verdict_of
from trustbo.criticism.joint_normal import (
    Data,
    Normal,
    gather,
    joint_normal,
    posterior_point,
    with_start,
)
from trustbo.criticism.prior_moments import Coefficients, coefficients_of, test_prior
from trustbo.criticism.residuals import curves_of, groups_of, table_of_rates
from trustbo.criticism.robots import effects_of_robots, finding_on_robots
from trustbo.criticism.score import Derivatives, Innovations, Outcome, derivatives, holm
from trustbo.data import Mission
from trustbo.display.card import Card, Displayed
from trustbo.errors import TrustboError, require_whole
from trustbo.inference.fit import fit
from trustbo.inference.posterior_tree import missions_of
from trustbo.models.model import TrustModel
from trustbo.models.record import model_from_record
from trustbo.parallel import one_blas_thread

_LEVEL = 0.05
_LEAST = 1e-6
"""Lower limit of probabilities in tables; a smaller one is 0."""
_SITES = ({"beta0", "beta", "b", "delta_w", "delta_v"}, {"B0", "B", "b", "Delta_w", "Delta_v"})
_ATTRIBUTES = ("observation", "response", "x0_mean", "x0_sd", "seed")


@dataclass(frozen=True, eq=False, repr=False)
class Criticism(Displayed):
    """Criticism of a fitted model.

    Attributes:
        verdict: Verdict in words.
        fault: Check that explains most of what is wrong, `"none"` if nothing is found.
        table: Row of each check (index `check`): the label with the strongest evidence; its
            statistic; p, of this check alone; p_adjusted, for the number of checks (Holm); p_after,
            once the fault that explains most is accounted for; and the finding in words. A
            probability below 1e-6, which is extrapolated, is 0.
        rates: Row of each measured rate: mission, bound, robot, row, col, contact_rate, expected
            and sd given the rates before, standardised residual, pit, and `ahead`, the standardised
            residual of predictions one mission ahead.
        groups: Mean residual by kind (mission, bound, robot, cell, contact: class of expected
            rate) and group, the half-width `band` of its simultaneous 95 % band, and whether it
            stands out.
        curves: PIT (u, its distribution less the uniform one), autocorrelation (lag, in bounds;
            mission_lag) and coverage one mission ahead (level), each with `_low` and `_high` of its
            simultaneous 95 % band.
        robots: Row of each mission and robot, where the model has effects of robots: its effect as
            a share of line of sight, sd, the probabilities that it is below -0.1 and above 0.1,
            and whether it stands out: one of them exceeds 0.95.
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

    @property
    def worth(self) -> pd.DataFrame:
        """Former name of `ablation`."""
        warnings.warn(
            "Criticism.worth is Criticism.ablation since version 0.3; the old name will go.",
            FutureWarning,
            stacklevel=2,
        )
        return self.ablation

    def _card(self) -> Card:
        rows = [(str(name), str(row["finding"])) for name, row in self.table.iterrows()]
        ablation = [(str(name), str(row["finding"])) for name, row in self.ablation.iterrows()]
        return Card(f"Criticism: {self.verdict}", rows, (), {"without each component": ablation})


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

    Checks: effects of places, a robot that differs, a change from some mission on, a response to a
    feature that bends, a prior in conflict with the rates, correlated noise, and the family of
    observations. Each is a score test by the standardised residuals of predictions one bound ahead,
    calibrated by replicates; Holm's method holds the chance of any finding, where the model is
    right, to 5 %. Each finding is put into the model and the others are tested again: the one that
    leaves the least evidence is named, of those that leave none the one of least p. Where the model
    has effects of robots, one that stands out in a mission is named before all else: it is the
    fault `"robot in a mission"`. A shape
    of residuals whose skewness is below 0.5 and excess kurtosis below 1 changes no plan, and is no
    fault, however small its p. Missions are counted from 0, as in the posterior.

    Args:
        posterior: DataTree from `fit`, or one of `Result.posteriors`. Of observations that are not
            Gaussian the model is fitted again, to the same rates taken for Gaussian ones, whose
            residuals are tested for all but the family.
        missions: Missions that it was fitted to, or all of its campaign; needed where it holds no
            data.
        model: Its model, needed for comparisons if its priors are custom.
        compare: Whether to compare, by LOO, with the model without each feature, and with and
            without places and separate coefficients of robots: each is a fit.
        n_replicates: Number of replicates for p-values and bands.
        seed: Seed of the replicates.

    Raises:
        TrustboError: The posterior is not of a linear model, or holds no data and no missions are
            given; the missions are others than it was fitted to; there are
            too few rates, or more than 2000; or they are all but equal.
    """
    require_whole("n_replicates", n_replicates, 100)
    missions = _checked(posterior, missions)
    if posterior.attrs["observation"] != "gaussian":
        posterior, model = _of_gaussian_rates(posterior, missions, model)
    try:
        return _criticise(posterior, missions, model, compare, n_replicates, seed)
    except np.linalg.LinAlgError:
        raise TrustboError(
            "the rates are all but equal, so that residuals say nothing of the model; criticise "
            "missions that differ."
        ) from None


def _criticise(
    posterior: xr.DataTree,
    missions: list[Mission],
    model: TrustModel | None,
    compare: bool,
    n_replicates: int,
    seed: int,
) -> Criticism:
    """See `criticise`; LinAlgError: rates are all but equal."""
    point, place = posterior_point(posterior)
    data = gather(missions, place)
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
    family = posterior.attrs.get("criticised_for", "gaussian")
    coefficients = coefficients_of(posterior, point, by_parameter, list(missions[0].features))
    outcomes = _test_all(innovations, tests, coefficients, seed)
    if family != "gaussian":
        del outcomes["family"]
        left_out["family"] = (
            f"residuals are those of Gaussian rates, the posterior is of {family} ones; see "
            "tb.inference.by_rate and az.plot_ppc_pit."
        )
    adjusted = holm(np.array([outcome.p for outcome in outcomes.values()]))
    wrong = [name for name, p in zip(outcomes, adjusted, strict=True) if p <= _LEVEL]
    if not changes_plans(innovations):
        wrong = [name for name in wrong if name != "family"]
    # No component of a model accounts for the prior or the family: they leave all others.
    after: dict[str, dict[str, Outcome]] = {name: {} for name in wrong}
    for outcome in (outcome for outcome in tests if outcome.name in wrong):
        wider = _account_for(
            outcome, outcomes[outcome.name].label, innovations, data, by_parameter, draws
        )
        after[outcome.name] = _test_all(
            wider, [o for o in tests if o is not outcome], coefficients, seed
        )
    if "family" in left_out:
        after = {
            name: {k: o for k, o in one.items() if k != "family"} for name, one in after.items()
        }
    fault = _most_explaining(outcomes, after)
    rows = {}
    for (name, one), p in zip(outcomes.items(), adjusted, strict=True):
        sentence = "nothing found."
        if name in wrong:
            sentence = finding(name, one, innovations, data, missions, tests, coefficients)
        p_after = after[fault][name].p if name in after.get(fault, {}) else np.nan
        rows[name] = one.label, one.statistic, one.p, p, p_after, sentence
    rows |= {name: ("", *[np.nan] * 4, f"not tested: {why}") for name, why in left_out.items()}
    rates = table_of_rates(missions, data, innovations)
    groups = groups_of(rates, missions, data, innovations)
    curves, rates["ahead"] = curves_of(data, innovations, coefficients, draws)
    rows["coverage"] = coverage_row(curves)
    robots = effects_of_robots(posterior)
    if len(robots):
        label, effect, sentence = finding_on_robots(robots)
        rows["robot in a mission"] = label, effect, np.nan, np.nan, np.nan, sentence
        fault = "robot in a mission" if label else fault
    head = ["label", "statistic", "p", "p_adjusted", "p_after", "finding"]
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

    `after` has, by finding, the outcomes of the others with it in the model. Of findings that leave
    no other one, it is that of least p.
    """
    enough = np.log(_LEVEL / len(outcomes))

    def rank(name: str) -> tuple[float, float]:
        left = [one.log_p for other, one in {**outcomes, **after[name]}.items() if other != name]
        return min(*left, enough), -outcomes[name].log_p

    return max(after, key=rank, default="none")


def _account_for(
    fault: Departure,
    label: str,
    innovations: Innovations,
    data: Data,
    by_parameter: Derivatives,
    draws: np.ndarray,
) -> Innovations:
    """Innovations of the model extended by one label of a departure."""
    normal = innovations.normal
    if label in fault.sources:
        U = fault.sources[label]
        wider = Normal(normal.mean, normal.cov + innovations.size_of(U) * U, normal.carry)
        return Innovations.of_rates(wider, data.y, by_parameter, draws)
    columns = normal.carry @ fault.effects[label]
    names = [*by_parameter.names, *[label] * columns.shape[1]]
    more = Derivatives(names, np.column_stack([by_parameter.mean, columns]), by_parameter.cov)
    return Innovations.of_rates(normal, data.y, more, draws)


def _checked(posterior: xr.DataTree, missions: Sequence[Mission] | None) -> list[Mission]:
    """Missions of a posterior that can be criticised."""
    if not isinstance(posterior, xr.DataTree) or "posterior" not in posterior.children:
        raise TrustboError(
            f"criticise takes a posterior of trustbo.fit; got {type(posterior).__name__}."
        )
    missing = [name for name in _ATTRIBUTES if name not in posterior.attrs]
    sites = set(posterior["posterior"].data_vars)
    linear = "gamma" in sites or any(sites_of <= sites for sites_of in _SITES)
    if missing or not linear or "prior" not in posterior.children:
        what = f"the attribute {missing[0]!r}" if missing else "the group 'prior'"
        what = what if linear else "beta0, beta, b, delta_w and delta_v of a linear drift"
        raise TrustboError(
            f"this posterior lacks {what}, so that its residuals are not known; criticise takes "
            "posteriors of PooledTrust, HierarchicalTrust and CoupledTrust from trustbo.fit."
        )
    if missions is not None:
        return _learned(posterior, missions)
    if "constant_data" not in posterior.children:
        raise TrustboError(
            "this posterior holds parameters alone: give the missions it was fitted to, such as "
            "criticise(result.posteriors[j], result.missions[: j + 1])."
        )
    return missions_of(posterior)


def _of_gaussian_rates(
    posterior: xr.DataTree, missions: Sequence[Mission], model: TrustModel | None
) -> tuple[xr.DataTree, TrustModel]:
    """Posterior and model of the same missions, the rates taken for Gaussian ones.

    Priors are the default ones, as those of counts are of another scale.
    """
    if model is None:
        record = json.loads(posterior.attrs["model_record"])
        model = model_from_record(record, features=missions[0].features)
    model = replace(model, observation="gaussian", priors=None)
    seed = int(posterior.attrs["seed"])
    fitted = fit(missions, model, seed=seed, draws=250, check=False)
    fitted.attrs["criticised_for"] = posterior.attrs["observation"]
    return fitted, model


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
