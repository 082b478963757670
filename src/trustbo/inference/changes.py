"""Changes of the world: probabilities of candidates, and of none, from rank-one Bayes factors.

With theta drawn given a hypothesis H* and the rates, the evidence of any other one relative to it
is the mean over the draws of BF_H(theta) / BF_H*(theta). Draws given no change are contaminated by
a large one, which inflates the noises and hides: once a change is more probable than none, theta is
drawn again with the column of the most probable one, and every weight is relative to it.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import pandas as pd
from scipy.special import logsumexp

from trustbo.models.effects.change import KINDS, Candidates, Change
from trustbo.models.effects.effect import Columns, Theta

ALARM = 0.9  # probability of a change
N_DRAWS = 24  # of theta in a scan
_MOST_FITS = 3  # with one change or another
_LISTED = 1e-3  # probability of a change in a table


class Scanned(Protocol):
    """An evidence that scans further columns, see `evidence.gaussian.Gaussian.scan`."""

    def scan(
        self, theta: Theta, columns: Columns, run: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Products z'C^-1 z and z'C^-1 r of further columns z, each (point, column)."""
        ...


class Weighed(NamedTuple):
    """Probabilities of the candidates of a scan, and what they add to trust."""

    candidates: Candidates
    p: np.ndarray  # (candidate,)
    p_none: float
    effect: np.ndarray  # (candidate,), mean of d in units of stationary trust, given the candidate
    sd: np.ndarray  # (candidate,), of d
    largest_share: float
    """Largest share of one draw of theta in all weights together: near 1, they are of one draw."""
    believed: Change | None
    """Change with which theta was drawn: the most probable one, if any is more probable than not;
    else None."""

    @property
    def best(self) -> int:
        """Index of the most probable candidate."""
        return int(self.p.argmax())

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


def weigh(
    evidence: Scanned, theta: Theta, candidates: Candidates, believed: int | None = None
) -> Weighed:
    """Weigh candidates, and none, by draws of theta.

    Args:
        evidence: Evidence without any of the candidates.
        theta: Draws of the hyperparameters (draw,) given the rates and the believed candidate.
        candidates: Changes to weigh.
        believed: Index of the candidate whose column theta was drawn with; None for no change.
    """
    rest, first = np.abs(theta["rest"])[:, None], candidates.first
    a, b = (ab[:, first] for ab in evidence.scan(theta, candidates.columns, candidates.run))
    variance = (rest * candidates.sd) ** 2
    log_bf = 0.5 * (variance * b**2 / (1.0 + variance * a) - np.log1p(variance * a))
    log_w = np.concatenate([np.zeros((len(a), 1)), log_bf + candidates.log_odds], axis=1)
    if believed is not None:
        log_w -= log_bf[:, believed, None]
    total = logsumexp(log_w)
    p = np.exp(logsumexp(log_w, axis=0) - total)
    share = np.exp(log_w[:, 1:] - logsumexp(log_w[:, 1:], axis=0))  # of a draw, by candidate
    posterior = 1.0 / (a + 1.0 / variance)
    mean = posterior * b / rest
    effect = (share * mean).sum(0)
    sd = np.sqrt((share * (posterior / rest**2 + (mean - effect) ** 2)).sum(0))
    largest = float(np.exp(logsumexp(log_w, axis=1).max() - total))
    change = None if believed is None else candidates.change(believed)
    return Weighed(candidates, p[1:], float(p[0]), effect, sd, largest, change)


def find_changes(
    evidence: Scanned, candidates: Candidates, draw_theta: Callable[[Change | None], Theta]
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
