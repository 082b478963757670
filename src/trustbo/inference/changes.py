"""Changes of the world: probabilities of candidates, and of none, from rank-one Bayes factors.

With theta drawn given a hypothesis H* and the rates, the evidence of any other one relative to it
is the mean over the draws of BF_H(theta) / BF_H*(theta). Draws given no change are contaminated by
a large one, which inflates the noises and hides: once a change is more probable than none, theta is
drawn again with the column of the most probable one, and every weight is relative to it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from scipy.special import logsumexp

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.inference.draws import is_of_people
from trustbo.inference.evidence.evidence import ColumnEvidence, at
from trustbo.inference.fit_data import FitData
from trustbo.inference.posterior_tree import require_posterior
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.posterior import evidence_of, posterior_of
from trustbo.inference.samplers.student import proposal_of
from trustbo.models.effects.change import KINDS, Candidates, Change
from trustbo.models.effects.effect import Theta, rest_of
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.model import TrustModel
from trustbo.models.pooled import PooledTrust
from trustbo.parallel import one_blas_thread
from trustbo.workspace import Workspace

ALARM = 0.9  # probability of a change
LARGE = 0.1  # effect on stationary trust, from which on a change counts: a tenth of contact
N_DRAWS = 24  # of theta in a scan
_FIRST = 4  # draws by which every candidate is weighed
_FAR = 7.0  # nats less than all together, from which on further draws do not weigh a candidate
_MOST_FITS = 3  # with one change or another
_LISTED = 1e-3  # probability of a change in a table


class Weighed(NamedTuple):
    """Probabilities of the candidates of a scan, and what they add to trust."""

    candidates: Candidates
    p: np.ndarray  # (candidate,)
    p_none: float
    effect: np.ndarray  # (candidate,), mean of d in units of contact, given the candidate
    sd: np.ndarray  # (candidate,), of d
    believed: Change | None
    """Change with which theta was drawn: the most probable one, if any is more probable than not;
    else None."""

    @property
    def best(self) -> int:
        """Index of the most probable candidate."""
        return int(self.p.argmax())

    @property
    def large(self) -> np.ndarray:
        """Whether each candidate's effect counts, (candidate,): rates drift by less, and show it.

        A path that is driven again and again has rates that differ by .02, and a change of .04 that
        matters to no plan is then certain.
        """
        return np.abs(self.effect) > LARGE

    @property
    def alarm(self) -> bool:
        """Whether the probability of a change exceeds `ALARM`."""
        return 1.0 - self.p_none > ALARM

    def by_kind(self) -> dict[str, float]:
        """Probability of each kind of change."""
        kind = self.candidates.profile[self.candidates.first, 0]
        p = np.bincount(kind, self.p, len(KINDS))
        return {name: float(p[i]) for i, name in enumerate(KINDS)}

    def table(self) -> pd.DataFrame:
        """Changes in the order of their probability, down to one in a thousand, and none.

        Columns kind, where, from_mission, earliest (the first mission whose start would give the
        same rates), effect, sd, probability and ties, the changes equal at every bound.
        """
        rows: list[tuple] = [("none", (), -1, -1, 0.0, 0.0, self.p_none, "")]
        for i in np.argsort(-self.p, kind="stable"):
            if self.p[i] < _LISTED:
                break
            change = self.candidates.change(i)
            ties = "; ".join(str(other) for other in self.candidates.ties(i))
            numbers = float(self.effect[i]), float(self.sd[i]), float(self.p[i])
            earliest = int(self.candidates.earliest[self.candidates.first[i]])
            rows.append((change.kind, change.where, change.from_mission, earliest, *numbers, ties))
        names = ("kind", "where", "from_mission", "earliest", "effect", "sd", "probability", "ties")
        return pd.DataFrame(rows, columns=list(names))


def changes(
    posterior: xr.DataTree,
    missions: Sequence[Mission] | None = None,
    workspace: Workspace | None = None,
    *,
    model: TrustModel | None = None,
    seed: int = 0,
) -> pd.DataFrame:
    """Weigh changes of the world from some mission on, of all robots, one robot, or an area.

    Every start and place that the paths separate is weighed, with two missions on each side; areas
    are the cells within a radius of 0, 1 or 2 cells. A change of all robots, or of one, is d times
    their line of sight, and of an area d at each bound into it. Effects of robots in the model
    stand for bad days and slow drifts, against which a change has to stand out.

    Args:
        posterior: Posterior of `PooledTrust` for rates that measure trust, with any effects, of any
            family of observations but `"student_t"`.
        missions: Missions that it was fitted to, in order; by default those it holds.
        workspace: Workspace of the missions, to fill in awareness that they lack, as for `fit`; its
            grid is that of the areas.
        model: Model of the posterior; needed with custom priors.
        seed: Seed of the draws of the hyperparameters.

    Returns:
        Table of the changes in the order of their probability, down to one in a thousand, with
        "none" as its first row: kind; where, the index of the robot or (row, col, radius);
        from_mission, the index of the first mission after the change; earliest, that of the
        earliest start that gives the same rates; effect and sd, the mean and sd of d in units of
        stationary trust; probability; and ties, changes that these paths do not separate from it.

    Raises:
        TrustboError: A posterior of another model, without its missions, or with custom priors and
            no model.
    """
    return scan_posterior(posterior, missions, workspace, model=model, seed=seed).table()


def scan_posterior(
    posterior: xr.DataTree,
    missions: Sequence[Mission] | None = None,
    workspace: Workspace | None = None,
    *,
    model: TrustModel | None = None,
    seed: int = 0,
) -> "Weighed":
    """Weigh the changes of `changes`."""
    seed = require_whole("seed", seed, 0)
    attrs = require_posterior("changes", posterior).attrs
    if is_of_people(posterior):
        raise TrustboError(
            "changes are of robots' contact, and this posterior is of reports of people, whose "
            "trust moves by the gains beta and each person's; give one of the robots' missions."
        )
    data = FitData.of(posterior, missions, workspace, model)
    model, n_given, n_fitted = data.model, len(data.missions), len(data.missions)
    if "constant_data" in posterior.children:
        n_fitted = posterior["constant_data"].sizes["mission"]
    elif "missions" in attrs:
        n_fitted = len(np.atleast_1d(attrs["missions"]))
    if n_given != n_fitted:
        raise TrustboError(
            f"the posterior is of {n_fitted} missions; got {n_given}. Give those that it was "
            'fitted to, of a campaign those of posterior.attrs["missions"].'
        )
    if reason := why_no_changes(model):
        raise TrustboError(f"{reason} Fit the missions with PooledTrust().")
    slots = data.slots(PlaceEffect() if model.place is None else model.place, workspace)
    names = "beta0", "delta_w", "delta_v", *(name for e in model.all_effects for name in e.names)

    def draw_theta(change: Change | None) -> Theta:
        if change is None:
            drawn = posterior["posterior"].to_dataset().stack(sample=("chain", "draw"))
            chosen = np.random.default_rng(seed).permutation(drawn.sizes["sample"])[:N_DRAWS]
            params = {name: drawn[name].values[chosen] for name in names}
        else:
            start = proposal_of(posterior)
            target = posterior_of(model, slots, [change])
            params = sample_scores(target, N_DRAWS, seed, start).draws.params
        return {name: params[name] for name in names} | {
            "rest": rest_of(params["beta0"], model.memory)
        }

    candidates = Candidates.of(slots, unit=model.family.line_of_sight[0])
    return find_changes(evidence_of(model, slots), candidates, draw_theta)


def why_no_changes(model: TrustModel) -> str:
    """Reason why changes cannot be weighed under a model; empty if they can."""
    if isinstance(model, PooledTrust) and not model.lag and model.why_not_exact is None:
        return ""
    return (
        "changes are weighed under PooledTrust for rates of trust that the exact sampler treats; "
        f"got {model.describe()}."
    )


def weigh(
    evidence: ColumnEvidence, theta: Theta, candidates: Candidates, believed: int | None = None
) -> Weighed:
    """Weigh candidates, and none, by draws of theta.

    Args:
        evidence: Evidence without any of the candidates.
        theta: Draws of the hyperparameters (draw,) given the rates and the believed candidate.
        candidates: Changes to weigh.
        believed: Index of the candidate whose column theta was drawn with; None for no change.
    """
    rest = candidates.unit * np.abs(theta["rest"])[:, None]
    n, n_candidates = len(rest), len(candidates.first)
    log_w = np.concatenate([np.zeros((n, 1)), np.full((n, n_candidates), -np.inf)], axis=1)
    a, b = np.zeros((2, n, n_candidates))

    def scan(draws: slice, kept: np.ndarray) -> None:
        a[draws, kept], b[draws, kept] = _scanned(evidence, at(theta, draws), candidates, kept)
        variance = (rest[draws] * candidates.sd) ** 2
        misfit = variance * b[draws] ** 2 / (1.0 + variance * a[draws])
        log_bf = 0.5 * (misfit - np.log1p(variance * a[draws]))
        log_w[draws, 1 + kept] = (log_bf + candidates.log_odds)[:, kept]
        if believed is not None:
            log_w[draws] -= log_bf[:, believed, None]

    # The first draws weigh all candidates, further ones those that count; the weight of the others
    # is their mean over the first.
    scan(slice(0, _FIRST), np.arange(n_candidates))
    first = log_w[:_FIRST]
    likely = first[:, 1:].max(0) > logsumexp(first) - _FAR
    if believed is not None:
        likely[believed] = True
    if n > _FIRST:
        scan(slice(_FIRST, n), np.flatnonzero(likely))
    of_draw = log_w[:, 1:].copy()
    log_w[_FIRST:, 1:][:, ~likely] = logsumexp(first[:, 1:][:, ~likely], axis=0) - np.log(_FIRST)
    variance = (rest * candidates.sd) ** 2
    total = logsumexp(log_w)
    p = np.exp(logsumexp(log_w, axis=0) - total)
    share = np.exp(of_draw - logsumexp(of_draw, axis=0))  # of a draw, by candidate
    posterior = 1.0 / (a + 1.0 / variance)
    mean = posterior * b / rest
    effect = (share * mean).sum(0)
    sd = np.sqrt((share * (posterior / rest**2 + (mean - effect) ** 2)).sum(0))
    change = None if believed is None else candidates.change(believed)
    return Weighed(candidates, p[1:], float(p[0]), effect, sd, change)


def _scanned(
    evidence: ColumnEvidence, theta: Theta, candidates: Candidates, kept: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Products of `ColumnEvidence.scan` of some candidates, each (point, candidate kept)."""
    first = candidates.first[kept]
    needed = np.isin(candidates.run, candidates.run[first])
    a, b = evidence.scan(theta, candidates.columns[:, needed], candidates.run[needed])
    where = (np.cumsum(needed) - 1)[first]
    return a[:, where], b[:, where]


@one_blas_thread()
def find_changes(
    evidence: ColumnEvidence, candidates: Candidates, draw_theta: Callable[[Change | None], Theta]
) -> Weighed:
    """Weigh candidates by theta drawn with the believed one.

    Args:
        evidence: Evidence without any of the candidates.
        candidates: Changes to weigh.
        draw_theta: Draws of the hyperparameters given the rates, `N_DRAWS` or so, under a model
            with the change among its effects; None for the model without.
    """
    weighed = weigh(evidence, draw_theta(None), candidates)
    believed = None
    for _ in range(_MOST_FITS):
        if not len(weighed.p) or weighed.p_none > 0.5 or weighed.best == believed:
            break
        believed = weighed.best
        weighed = weigh(evidence, draw_theta(candidates.change(believed)), candidates, believed)
    return weighed
