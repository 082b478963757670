"""Check a fitted model for problems in its posterior and its predictions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.data import Mission
from trustbo.display import Rows, Summary, joined
from trustbo.errors import TrustboError
from trustbo.inference.draws import (
    is_of_people,
    joined_draws,
    missions_of,
    sites_of,
    theta_of,
)
from trustbo.inference.score import last_posterior, predictions, score
from trustbo.models.families import FAMILIES
from trustbo.parallel import computing

SIZE, SURE = 0.1, 0.95
"""Smallest effect on contact that may change a plan, and the probability required to report it."""
_SIGNED = 0.6  # prior probability of a sign above which the sign is expected
_TOLERANCE = 0.05  # tolerated error of the coverage of 90 % intervals
_ERRORS = 2.0  # number of standard errors above which a difference is significant


@dataclass(frozen=True, eq=False, repr=False)
class Check(Summary):
    """Result of the check of a fitted model.

    Attributes:
        verdict: The findings that stand out, as text.
        table: One row per check (index `check`). The columns are the text of the `finding`, whether
            it `stands_out`, the most affected `label`, and the `size` and `probability`.
        robots: One row per `mission` (counted from 1) and `robot`, with the `effect` (share of line
            of sight minus the median), its `sd`, the `probability` that it exceeds .1 in size, and
            `stands_out`.
    """

    verdict: str
    table: pd.DataFrame
    robots: pd.DataFrame

    def _rows(self) -> Rows:
        rows = [(str(name), str(row["finding"])) for name, row in self.table.iterrows()]
        return [("verdict", self.verdict), *rows]


class Finding(NamedTuple):
    """One row of `Check.table`."""

    finding: str
    stands_out: bool = False
    label: str = ""
    size: float = np.nan
    probability: float = np.nan


@computing()
def check(
    posterior: xr.DataTree | Sequence[xr.DataTree | None],
    missions: Sequence[Mission] | None = None,
) -> Check:
    """Check a fitted model of contact rates for possible problems.

    A robot stands out in a mission if its effect differs from the team's median by more than .1 of
    line of sight, with a probability above .95. A place stands out if its effect exceeds .1 of
    contact, and a weight if its sign contradicts its prior. The coverage of 90 % intervals one
    mission ahead stands out if it differs from .9 by more than .05 and two standard errors over
    missions. See also `pit` of `tb.inference.score` for the shape of predictions, `tb.compare` for
    other models, and `az.psense_summary(posterior)` for the sensitivity to the priors.

    Args:
        posterior: Posterior from `fit`, or all posteriors of a campaign (`Result.posteriors`). For
            a campaign, the last posterior is checked, and the predictions of the others are scored.
        missions: All missions of the campaign; by default, the missions in the last posterior.
            Missions without an earlier posterior and excluded missions are not predicted.

    Raises:
        TrustboError: If the posterior is not from `fit`, was fitted to people's reports, or
            contains no data although `missions` is None.
    """
    trees = list(posterior) if isinstance(posterior, Sequence) else [posterior]
    tree = last_posterior("check", trees)
    if is_of_people(tree):
        raise TrustboError(
            "check needs a posterior of contact rates; got a posterior of HumanTrust. Use "
            "trustbo.inference.predict_reports instead."
        )
    robots = effects_of_robots(tree)
    findings = {
        "robots": _check_robots(robots),
        "places": _check_places(tree),
        "weights": _check_weights(tree),
        "coverage": _check_coverage(trees, tree, missions),
    }
    table = pd.DataFrame(list(findings.values()), pd.Index(findings, name="check"))
    odd = [finding.finding for finding in findings.values() if finding.stands_out]
    return Check(("; ".join(odd) or "nothing stands out") + ".", table, robots)


def effects_of_robots(posterior: xr.DataTree) -> pd.DataFrame:
    """Tabulate the robot effects as in `Check.robots`; the table is empty if there are none."""
    if "robots" not in posterior.children:
        return pd.DataFrame()
    group = posterior["robots"].to_dataset()
    draws = joined_draws(group["robot_effect"])
    # The weight of line of sight already includes what all robots and missions have in common.
    draws = draws - np.median(draws, axis=(1, 2), keepdims=True)
    draws = draws / FAMILIES[posterior.attrs["observation"]].line_of_sight[0]
    probability = np.maximum((draws < -SIZE).mean(0), (draws > SIZE).mean(0))
    columns = {"effect": draws.mean(0), "sd": draws.std(0), "probability": probability}
    columns["stands_out"] = probability > SURE
    labels = group["mission"].values + 1, group["robot"].values
    index = pd.MultiIndex.from_product(labels, names=("mission", "robot"))
    return pd.DataFrame({n: v.ravel() for n, v in columns.items()}, index).reset_index()


def _check_robots(robots: pd.DataFrame) -> Finding:
    """Check whether the effect of a robot in a mission differs from the median."""
    if not len(robots):
        return Finding("not tested: the model has no robot effects")
    effect, odd = robots["effect"].to_numpy(), robots["stands_out"].to_numpy()
    if not odd.any():
        return Finding("no robot stands out", size=float(np.abs(effect).max()))
    mission, robot = robots["mission"].to_numpy(), robots["robot"].to_numpy()
    words = []
    for name in dict.fromkeys(robot[odd]):
        rows = odd & (robot == name)
        when = f"mission {joined(mission[rows].astype(str).tolist())}"
        when = "all missions" if rows.sum() == (robot == name).sum() else when
        words.append(f"{name}: {effect[rows].mean():+.2f} contact at full line of sight in {when}")
    most = int(np.argmax(np.abs(effect) * odd))
    size, p = float(effect[most]), float(robots["probability"].to_numpy()[most])
    return Finding(joined(words), True, str(robot[most]), size, p)


def _check_places(posterior: xr.DataTree) -> Finding:
    """Check whether the effect of a place on stationary trust is large."""
    if "places" not in posterior.children:
        return Finding("not tested: the model has no place effects")
    places = posterior["places"].to_dataset()
    cells, where = (
        list(zip(places[f"{kind}_row"].values, places[f"{kind}_col"].values, strict=True))
        for kind in ("cell", "bound")
    )
    of_cells = joined_draws(places["place"])[:, [cells.index(cell) for cell in where]]
    total = joined_draws(places["place_bound"]) + of_cells
    inverse_gain = theta_of(posterior, sites_of(posterior))["inverse_gain"]
    draws = total / inverse_gain.reshape(len(total), -1).mean(
        1, keepdims=True
    )  # of stationary trust
    draws = draws / FAMILIES[posterior.attrs["observation"]].line_of_sight[0]
    effect = draws.mean(0)
    sure = (draws * np.sign(effect) > 0.0).mean(0)
    odd = (sure > SURE) & (np.abs(effect) > SIZE)
    most = int(np.argmax(np.abs(effect) * (odd if odd.any() else 1.0)))
    row, col = (int(i) for i in where[most])
    words = f"{odd.sum()} of {len(odd)} places stand out; the largest effect is {effect[most]:+.2f}"
    size, p = float(effect[most]), float(sure[most])
    return Finding(words, bool(odd.any()), f"({row}, {col})", size, p)


def _check_weights(posterior: xr.DataTree) -> Finding:
    """Check whether the sign of a weight contradicts the prior."""
    name = "beta" if "beta" in posterior["posterior"] else "B"
    if "prior" not in posterior.children or name not in posterior["prior"]:
        return Finding("not tested: the posterior contains no prior draws")
    features = posterior["posterior"].to_dataset()["feature"].values
    groups = (posterior[group].to_dataset() for group in ("prior", "posterior"))
    prior, draws = (joined_draws(group[name]) for group in groups)
    if name == "B":  # keep the weights of each robot's own features, which have an expected sign
        prior, draws = (np.einsum("dmii->dim", B) for B in (prior, draws))
    prior, draws = (weights.reshape(-1, len(features)) for weights in (prior, draws))
    sign = np.sign(prior.mean(0))
    expected = (prior * sign > 0.0).mean(0) > _SIGNED
    wrong = (draws * sign < 0.0).mean(0) * expected
    most, odd = int(wrong.argmax()), [str(feature) for feature in features[wrong > SURE]]
    words = "no weight has a sign that contradicts its prior"
    if odd:
        words = f"the sign of the weight contradicts the prior for {joined(odd)}"
    size, p = float(draws[:, most].mean()), float(wrong[most])
    return Finding(words, bool(odd), str(features[most]), size, p)


def _check_coverage(
    trees: Sequence[xr.DataTree | None], last: xr.DataTree, missions: Sequence[Mission] | None
) -> Finding:
    """Check whether 90 % intervals one mission ahead contain 90 % of the rates."""
    if len(trees) < 2:
        return Finding("not tested: this check needs all posteriors of a campaign")
    missions = missions_of(last) if missions is None else missions
    if not predictions("check", trees, missions)[0]:
        return Finding("not tested: no mission has an earlier posterior that predicts it")
    pit = score(trees, missions)["pit"]
    within = (abs(pit - 0.5) <= 0.45).where(pit.notnull()).mean(("bound", "robot")).values
    within = within[np.isfinite(within)]
    if not len(within):
        return Finding("not tested: no rate of the predicted missions was measured")
    off = float(within.mean() - 0.9)
    error = within.std(ddof=1) / np.sqrt(len(within)) if len(within) > 1 else np.inf
    words = f"90 % intervals one mission ahead contain {within.mean():.0%} of the rates"
    return Finding(words, bool(abs(off) > max(_TOLERANCE, _ERRORS * error)), "90 %", off)
