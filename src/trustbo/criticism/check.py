"""Check a fitted model for problems in its posterior and its predictions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.arrays import joined_draws
from trustbo.data import Mission, Station
from trustbo.display import Rows, Summary, joined
from trustbo.errors import TrustboError
from trustbo.inference.place_maps import of_workspace
from trustbo.inference.posterior import is_by_position, is_of_people, model_of, names_in
from trustbo.inference.score import Posteriors, last_posterior, predictions, score
from trustbo.inference.stored import missions_of, parameters_of
from trustbo.models.families import FAMILIES
from trustbo.parallel import computing
from trustbo.stacking import list_of_missions

SIZE = 0.1
"""Smallest effect on contact that is considered large enough to change a plan."""
SURE = 0.95
"""Probability above which such an effect, or the sign of an effect, is reported."""
_PAIR = 2
"""Number of robots for which robots are compared with each other instead of with their median."""
_SIGNED = 0.6
"""Prior probability above which a sign counts as expected."""
_COVERAGE = 0.9
"""Probability of the intervals whose coverage is checked."""
_TOLERANCE = 0.05
"""Tolerated error of the coverage of these intervals."""
_ERRORS = 2.0
"""Number of standard errors above which a difference is significant."""
_FEWEST = 4
"""Fewest predicted missions from which such an error is estimated."""
_OF_DRAWS = ("chain", "draw")
_NOT_TESTED = "not tested: "
"""Start of a finding that states why a check was not possible."""


@dataclass(frozen=True, eq=False, repr=False)
class Check(Summary):
    """Result of the check of a fitted model.

    Attributes:
        verdict: The findings that stand out, and the checks that were not tested, as text.
        table: One row per check (index `check`). The columns are the text of the `finding`, whether
            it `stands_out`, the most affected `label`, and the `size` and `probability` of the
            effect.
        robots: One row per `mission` (counted from 1; negative for earlier campaigns) and `robot`.
            The columns are the `effect`
            (share of line of sight minus the median), its `sd`, the `probability` that it is below
            -.1 or above .1, whichever is larger, and `stands_out`. With two robots, the effect is
            the difference from the other robot in the same mission, so the two rows of a mission
            have opposite signs.
    """

    verdict: str
    table: pd.DataFrame
    robots: pd.DataFrame

    def _rows(self) -> Rows:
        rows = [(str(name), str(row["finding"])) for name, row in self.table.iterrows()]
        return [("verdict", self.verdict), *rows]


@runtime_checkable
class HasPosteriors(Protocol):
    """Result or campaign, whose classes are defined in a package above this one."""

    @property
    def posteriors(self) -> Posteriors:
        """Posteriors after each mission, with None where there was none yet."""
        ...


class Finding(NamedTuple):
    """One row of `Check.table`."""

    finding: str
    stands_out: bool = False
    label: str = ""
    size: float = np.nan
    probability: float = np.nan

    @property
    def is_tested(self) -> bool:
        """Whether the model and the data allowed the check."""
        return not self.finding.startswith(_NOT_TESTED)


@computing()
def check(
    posterior: xr.DataTree | Sequence[xr.DataTree | None] | HasPosteriors,
    missions: Iterable[Mission] | None = None,
) -> Check:
    """Check a fitted model of contact rates for possible problems.

    A robot stands out in a mission if its effect differs from the median over all robots and
    missions by more than .1 of line of sight, with a probability above .95. With two robots, the
    median lies halfway between them, so the difference between the robots is tested instead.

    A place stands out if the mean of its effect differs from the median over the visited places by
    more than .1 of contact, and the sign of the difference has a probability above .95. The median
    is subtracted because a shift that most places share cannot be distinguished from the intercept.
    A weight stands out if its sign contradicts its prior. The coverage of 90 % intervals one
    mission ahead stands out if it differs from .9 by more than .05 and two standard errors over
    missions, and at least four missions are predicted. It is also computed for new bounds only, in
    which none of the missions before had measured a rate. Intervals there can be too narrow
    although those on a path that is repeated are not.

    The verdict also names the checks that the model or the data do not allow: robots and places
    need the effects of the model, weights a variable `beta` or `B` with the dim `feature`, coverage
    all posteriors of a campaign, and new bounds also paths. Effects of places in a NumPyro function
    also need a variable `beta0`.

    See also `pit` of `tb.inference.score` for the shape of predictions, `tb.compare` for other
    models, and `az.psense_summary(posterior)` for the sensitivity to the priors.

    Args:
        posterior: Posterior from `fit`; a result or campaign, whose `posteriors` are then used; or
            all posteriors of a campaign (`Result.posteriors`). For a campaign, the last posterior
            is checked, and the predictions of the others are scored.
        missions: All missions of the campaign; by default, those of `Result.posteriors`, or the
            missions in the last posterior. Missions without an earlier posterior and excluded
            missions are not predicted.

    Raises:
        TrustboError: If the posterior is not from `fit`, if it was fitted to people's reports, or
            if it contains no data and `missions` is None.

    Example:
        >>> result = tb.iterate(workspace, (9, 0), (0, 9), n_iterations=2)
        >>> tb.check(result).verdict
    """
    if isinstance(posterior, HasPosteriors):
        posterior = posterior.posteriors
    trees = posterior if isinstance(posterior, Sequence) else [posterior]
    tree = last_posterior("check", trees)
    if is_of_people(tree):
        raise TrustboError(
            "check needs a posterior of contact rates; got a posterior of HumanTrust. Use "
            "trustbo.inference.predict_reports instead."
        )

    given = None if missions is None else list_of_missions(missions)
    robots = effects_of_robots(tree)
    coverage, in_new_bounds = _check_coverage(trees, tree, given)
    findings = {
        "robots": _check_robots(robots),
        "places": _check_places(tree),
        "weights": _check_weights(tree),
        "coverage": coverage,
        "new bounds": in_new_bounds,
    }

    table = pd.DataFrame(list(findings.values()), pd.Index(findings, name="check"))
    return Check(_verdict(findings), table, robots)


def _verdict(findings: Mapping[str, Finding]) -> str:
    """Return what stands out, and what was not tested, as one sentence."""
    tested = [name for name, finding in findings.items() if finding.is_tested]
    others = [name for name in findings if name not in tested]
    words = [finding.finding for finding in findings.values() if finding.stands_out]

    if tested and not words:
        words = [f"nothing stands out in {joined(tested)}"]
    if others:
        was = "was" if others == ["coverage"] else "were"
        words.append(f"{joined(others)} {was} not tested")
    return "; ".join(words) + "."


def effects_of_robots(posterior: xr.DataTree) -> pd.DataFrame:
    """Tabulate the robot effects as in `Check.robots`; the table is empty if there are none."""
    if "robots" not in posterior.children:
        return pd.DataFrame()
    group = posterior["robots"].to_dataset()
    effect = group["robot_effect"].astype(float) + _in_all_bounds(posterior)

    if effect.sizes["robot"] == _PAIR:
        # The median would lie halfway between the two robots, and neither would stand out.
        effect = effect - effect.roll(robot=1)
    else:
        # The weight of line of sight already includes the part that all robots and missions share.
        effect = effect - effect.median(("mission", "robot"))
    effect = effect / FAMILIES[posterior.attrs["family"]].line_of_sight[0]

    # Missions of earlier campaigns, which have negative indices, only serve as a reference for the
    # campaign's own missions, if there are any.
    is_own = effect["mission"] >= 0
    if is_own.any():
        effect = effect.isel(mission=is_own)
    # Sums have the same rounding errors for any order of the axes in memory.
    effect = effect.copy(data=np.ascontiguousarray(effect))

    less = (effect < -SIZE).mean(_OF_DRAWS)
    more = (effect > SIZE).mean(_OF_DRAWS)
    columns = {"effect": effect.mean(_OF_DRAWS), "sd": effect.std(_OF_DRAWS)}
    columns["probability"] = less.where(less > more, more)
    table = xr.Dataset(columns).to_dataframe(["mission", "robot"]).reset_index()
    table["mission"] += table["mission"] >= 0
    return table.assign(stands_out=table["probability"] > SURE)


def _in_all_bounds(posterior: xr.DataTree) -> xr.DataArray | float:
    """Return the mean effect of each robot in the visited bounds, (chain, draw, robot), or 0.

    If all missions take the same path, a robot that is poor everywhere cannot be distinguished from
    bounds that are all bad for this robot. Its mean effect in these bounds therefore counts as an
    effect of the robot.
    """
    if "places" not in posterior.children:
        return 0.0

    places = of_workspace(posterior["places"].to_dataset())
    if "place_robot" not in places or not places.sizes["bound"]:
        return 0.0
    return places["place_robot"].astype(float).mean("bound")


def _check_robots(robots: pd.DataFrame) -> Finding:
    """Check whether the effect of a robot in a mission differs from the median."""
    if robots.empty:
        return Finding(_NOT_TESTED + "the model has no robot effects")
    odd = robots.loc[robots["stands_out"]]
    if odd.empty:
        return Finding("no robot stands out", size=robots["effect"].abs().to_numpy().max())

    # If there are two robots, both stand out. One sentence about the robot with less contact is
    # enough.
    names = robots["robot"].unique().tolist()
    if len(names) == _PAIR:
        odd = odd.loc[odd["effect"] < 0.0]

    words = []
    for name, rows in odd.groupby("robot", sort=False):
        if len(rows) == (robots["robot"] == name).sum():
            when = "all missions"
        else:
            when = f"mission {joined(rows['mission'].astype(str).tolist())}"
        size = rows["effect"].mean()
        if len(names) == _PAIR:
            [other] = (each for each in names if each != name)
            what = f"{name}: {-size:.2f} less contact at full line of sight than {other}"
        else:
            what = f"{name}: {size:+.2f} contact at full line of sight"
        words.append(f"{what} in {when}")

    most = odd.loc[odd["effect"].abs().idxmax()]
    return Finding(joined(words), True, most["robot"], most["effect"], most["probability"])


def _check_places(posterior: xr.DataTree) -> Finding:
    """Check whether the effect of a place on stationary trust is large."""
    if "places" not in posterior.children:
        return Finding(_NOT_TESTED + "the model has no place effects")
    places = of_workspace(posterior["places"].to_dataset())
    if not places.sizes["bound"]:
        return Finding(_NOT_TESTED + "no place of the workspace was visited")

    cells = pd.MultiIndex.from_arrays([places["cell_row"].values, places["cell_col"].values])
    where = pd.MultiIndex.from_arrays([places["bound_row"].values, places["bound_col"].values])
    of_cells = joined_draws(places["place"])[:, cells.get_indexer(where)]
    total = joined_draws(places["place_bound"]) + of_cells
    inverse_gain = _inverse_gain(posterior)
    if inverse_gain is None:
        return Finding(
            f"{_NOT_TESTED}the function has no variable 'beta0' below 1, one number or one of each "
            "robot, which relates its place effects to trust"
        )
    per_drift = inverse_gain.reshape(len(total), -1).mean(1, keepdims=True)
    draws = total / per_drift  # effects on stationary trust
    draws = draws / FAMILIES[posterior.attrs["family"]].line_of_sight[0]

    # A shift that most places share cannot be distinguished from the intercept, so it must not make
    # any place stand out.
    draws = draws - np.median(draws, axis=1, keepdims=True)

    table = pd.DataFrame({"effect": draws.mean(0), "place": where.map("({0[0]}, {0[1]})".format)})
    table["sure"] = (draws * np.sign(draws.mean(0)) > 0.0).mean(0)
    odd = table.loc[(table["sure"] > SURE) & (table["effect"].abs() > SIZE)]
    among = table if odd.empty else odd
    most = among.loc[among["effect"].abs().idxmax()]

    size = most["effect"]
    words = f"{len(odd)} of {len(table)} places stand out; the largest effect is {size:+.2f}"
    return Finding(words, not odd.empty, most["place"], size, most["sure"])


def _inverse_gain(posterior: xr.DataTree) -> np.ndarray | None:
    """Return the drift that raises stationary trust by 1, shape (draw,) or (draw, robot).

    For a function, it is that of its variable `beta0`; None if there is no such variable.
    """
    if not is_by_position(posterior):
        model = model_of(posterior)
        return model.derived(parameters_of(posterior, model))["inverse_gain"]
    variables = posterior["posterior"].to_dataset()
    if "beta0" not in variables:
        return None

    beta0 = joined_draws(variables["beta0"])
    is_memory = beta0.shape[1:] in ((), (1,), (len(names_in(posterior, "robot")),))
    return 1.0 - beta0 if is_memory and (beta0 < 1.0).all() else None


def _check_weights(posterior: xr.DataTree) -> Finding:
    """Check whether the sign of a weight contradicts the prior."""
    variables = posterior["posterior"].to_dataset()
    name = "B" if "B" in variables and not is_by_position(posterior) else "beta"
    if name not in variables or "feature" not in variables[name].dims:
        return Finding(f"{_NOT_TESTED}the model has no variable 'beta' with the dim 'feature'")
    if "prior" not in posterior.children or name not in posterior["prior"]:
        return Finding(f"{_NOT_TESTED}the posterior contains no prior draws of {name!r}")

    features = variables["feature"].values
    prior = _weights(posterior, "prior", name)
    draws = _weights(posterior, "posterior", name)

    sign = np.sign(prior.mean(0))
    expected = (prior * sign > 0.0).mean(0) > _SIGNED
    wrong = (draws * sign < 0.0).mean(0) * expected

    most = int(wrong.argmax())
    odd = [str(feature) for feature in features[wrong > SURE]]
    words = "no weight has a sign that contradicts its prior"
    if odd:
        words = f"the sign of the weight contradicts the prior for {joined(odd)}"

    size = float(draws[:, most].mean())
    p = float(wrong[most])
    return Finding(words, bool(odd), str(features[most]), size, p)


def _weights(posterior: xr.DataTree, group: str, name: str) -> np.ndarray:
    """Return the draws (draw, feature) of the weights in a group, for all robots."""
    array = posterior[group].to_dataset()[name].transpose(..., "feature")
    weights = joined_draws(array)
    if name == "B":  # keep the weights of each robot's own features, which have an expected sign
        weights = np.einsum("diim->dim", weights)
    return weights.reshape(-1, weights.shape[-1])


def _check_coverage(
    trees: Sequence[xr.DataTree | None], last: xr.DataTree, missions: list[Mission] | None
) -> tuple[Finding, Finding]:
    """Check whether 90 % intervals one mission ahead contain 90 % of the rates.

    Returns:
        The findings for all bounds, and for bounds in which no mission before had measured a rate.
    """
    if len(trees) < 2:
        untested = Finding(_NOT_TESTED + "this check needs all posteriors of a campaign")
        return untested, untested

    if missions is None:
        missions = trees.missions if isinstance(trees, Posteriors) else missions_of(last)
    if not predictions("check", trees, missions)[0]:
        untested = Finding(_NOT_TESTED + "no mission has an earlier posterior that predicts it")
        return untested, untested

    pit = score(trees, missions)["pit"]
    is_new = np.zeros((pit.sizes["mission"], pit.sizes["bound"]), bool)
    for row, j in zip(is_new, pit["mission"].values, strict=True):
        measured = {bound for mission in missions[:j] for bound in _measured(mission)}
        new = [bound not in measured for bound in pairwise(missions[j].stations)]
        row[: len(new)] = new[: len(row)]

    is_inside = (abs(pit - 0.5) <= 0.5 * _COVERAGE).where(pit.notnull())
    of_new = is_inside.where(xr.DataArray(is_new, dims=("mission", "bound")))
    return (
        _coverage(is_inside, "90 % intervals one mission ahead"),
        _coverage(of_new, "90 % intervals in bounds that no mission before had measured"),
    )


def _measured(mission: Mission) -> list[tuple[Station, Station]]:
    """Return the bounds of a mission in which a rate was measured."""
    has_rate = np.isfinite(mission.contact_rate).any(-1)
    bounds = pairwise(mission.stations)
    return [bound for bound, known in zip(bounds, has_rate, strict=False) if known]


def _coverage(is_inside: xr.DataArray, intervals: str) -> Finding:
    """Compare the share of rates inside intervals with its nominal value.

    Rates of a mission have common errors, so the standard error is that of a ratio over missions,
    and at least that of independent rates.

    Args:
        is_inside: Whether each rate (mission, bound, robot) is inside; NaN where it is not tested.
        intervals: Name of the intervals, for the finding.
    """
    n = is_inside.count(("bound", "robot")).values
    n_inside = is_inside.sum(("bound", "robot")).values[n > 0]
    n = n[n > 0]
    if not n.size:
        return Finding(f"{_NOT_TESTED}no rate was measured that {intervals} predict")

    share = float(n_inside.sum() / n.sum())
    error = np.sqrt(_COVERAGE * (1.0 - _COVERAGE) / n.sum())
    if n.size >= _FEWEST:
        residuals = n_inside - share * n
        over_missions = np.sqrt(n.size / (n.size - 1) * (residuals**2).sum()) / n.sum()
        error = max(error, over_missions)

    off = share - _COVERAGE
    is_off = n.size >= _FEWEST and abs(off) > max(_TOLERANCE, _ERRORS * error)
    words = f"{intervals} contain {share:.0%} of {n.sum()} rates"
    if is_off:
        words += " and are too wide" if off > 0.0 else " and are too narrow"
    return Finding(words, is_off, "90 %", off)
