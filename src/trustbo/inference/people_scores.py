"""Models of people's reports against baselines, on people who were left out."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import special

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_choice, require_kind, require_whole
from trustbo.inference.fit import fit
from trustbo.inference.people import GIVEN, predict_reports
from trustbo.models.people import FAILURE, SUCCESS, HumanTrust
from trustbo.stacking import MissionBatch, stack_missions

_PENALTY = 2.0  # of a standardised weight of the ridge, in reports
_LEAST = 0.02  # sd of a baseline's errors


def compare_people(
    missions: Sequence[Mission],
    models: Mapping[str, HumanTrust],
    *,
    given: str = "earlier",
    folds: int = 5,
    seed: int = 0,
) -> pd.DataFrame:
    """Score predictions of reports by models and baselines, on people that none was fitted to.

    People are divided into folds at random, and those of each predicted by fits to all others.
    Baselines: `persistence`, the last report about the same task; `means`, that of reports before
    any outcome, after a success and after a failure; and `ridge`, a linear regression on the
    inputs and, given earlier reports, the last one and the person's mean. Their errors are normal.

    Args:
        missions: People, as of `read_reports`.
        models: Models by name.
        given: `"earlier"`, each report is predicted from the person's reports at earlier bounds,
            and those without one are not scored; or `"none"`, from those of other people alone.
        folds: Number of folds.
        seed: Seed of the folds and of the fits.

    Returns:
        Table with a row for each method: the mean absolute error `mae`, of medians, the root mean
        square error `rmse`, of means, both on the scale that was answered, the mean `log_score`
        (nats a report; of its level, or density), `coverage_90`, and the number `n` of reports.

    Raises:
        TrustboError: Fewer people than folds, no model is a `HumanTrust`, or see `fit`.
    """
    require_choice("given", given, GIVEN)
    require_kind("compare_people", models, Mapping, 'give models by name, {"ours": model}')
    batch = stack_missions(missions, pad=False)
    folds = require_whole("folds", folds, 2)
    if len(missions) < folds:
        raise TrustboError(f"{folds} folds need as many people; got {len(missions)}.")
    if bad := [name for name, model in models.items() if not isinstance(model, HumanTrust)]:
        raise TrustboError(f"model {bad[0]!r} must be a HumanTrust; got {models[bad[0]]!r:.60}.")
    order = np.random.default_rng(seed).permutation(len(missions))
    names = [*(["persistence"] if given == "earlier" else []), "means", "ridge", *models]
    parts: dict[str, list[pd.DataFrame]] = {name: [] for name in names}
    for test in np.array_split(order, folds):
        train = np.setdiff1d(order, test)
        table = _Table.of(batch, missions[0].features, given)
        for name in names:
            if name in models:
                tree = fit([missions[int(i)] for i in train], models[name], seed=seed, whole=False,
                           progress=False)  # fmt: skip
                people = [missions[int(i)] for i in test]
                parts[name].append(_of_model(tree, people, table.scored[test], given, seed))
            else:
                parts[name].append(table.baseline(name, train, test))
    found = pd.concat({name: pd.concat(of_folds) for name, of_folds in parts.items()})
    by_name: Any = found.groupby(level=0, sort=False)
    scores = by_name.mean()
    return scores.assign(rmse=np.sqrt(scores["rmse"]), n=by_name.size().astype(float))


class _Table(NamedTuple):
    """Reports of all people with what they are predicted from; axes (mission, bound, robot)."""

    y: np.ndarray
    steps: np.ndarray  # of the scale, NaN on the unit scale
    kind: np.ndarray  # 0 before any outcome, 1 after a success, 2 after a failure
    inputs: np.ndarray  # (mission, bound, robot, column)
    last: np.ndarray  # NaN where there is none
    scored: np.ndarray

    @classmethod
    def of(cls, batch: MissionBatch, features: Sequence[str], given: str) -> "_Table":
        """Columns of a batch."""
        y, z = batch.contact_rate, batch.awareness
        happened = [
            z[..., [name.startswith(start) for name in features]].sum(-1) > 0.0
            for start in (SUCCESS, FAILURE)
        ]
        kind = np.where(happened[0], 1, np.where(happened[1], 2, 0))
        last, mean = np.full(y.shape, np.nan), np.full(y.shape, np.nan)
        for k in range(1, y.shape[1]):
            last[:, k] = np.where(np.isnan(y[:, k - 1]), last[:, k - 1], y[:, k - 1])
            known = ~np.isnan(y[:, :k])
            total = np.where(known, y[:, :k], 0.0).sum((1, 2))
            with np.errstate(invalid="ignore"):
                mean[:, k] = (total / known.sum((1, 2)))[:, None]
        last = np.where(np.isnan(last), mean, last)
        seen, inputs = ~np.isnan(y), [z, np.ones_like(z[..., :1])]
        if given == "earlier":
            seen &= ~np.isnan(last)
            own = np.nan_to_num(np.stack([last, mean], axis=-1))
            inputs += [own, own[..., :1] * (kind == 1)[..., None]]
        return cls(y, batch.n_ticks, kind, np.concatenate(inputs, -1), last, seen)

    def baseline(self, name: str, train: np.ndarray, test: np.ndarray) -> pd.DataFrame:
        """Predictions of a baseline."""
        a, b = (self.scored & np.isin(np.arange(len(self.y)), some)[:, None, None]
                for some in (train, test))  # fmt: skip
        if name == "persistence":
            fitted, mean = self.last[a], self.last[b]
        elif name == "means":
            means = np.array([self.y[a & (self.kind == k)].mean() if (a & (self.kind == k)).any()
                              else self.y[a].mean() for k in range(3)])  # fmt: skip
            fitted, mean = means[self.kind[a]], means[self.kind[b]]
        else:
            X, center = self.inputs[a], self.y[a].mean()
            scale = X.std(0) + 1e-9
            penalty = _PENALTY * np.where(X.std(0) > 0.0, scale**2, 1e-9)
            w = np.linalg.solve(X.T @ X + np.diag(penalty), X.T @ (self.y[a] - center))
            fitted, mean = (np.clip(v @ w + center, 0.0, 1.0) for v in (X, self.inputs[b]))
        sd = max(float((self.y[a] - fitted).std()), _LEAST)
        return _normal(self.y[b], self.steps[b], mean, sd)


def _normal(y: np.ndarray, steps: np.ndarray, mean: np.ndarray, sd: float) -> pd.DataFrame:
    """Normal predictions, of the level where reports have levels."""
    half = 0.5 / steps
    low, high = np.where(y <= 0.0, -np.inf, y - half), np.where(y >= 1.0, np.inf, y + half)
    mass = np.diff(special.ndtr((np.stack([low, high]) - mean) / sd), axis=0)[0]
    density = -0.5 * ((y - mean) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi))
    log_score = np.where(np.isnan(steps), density, np.log(np.maximum(mass, 1e-12)))
    within = np.abs(y - mean) <= 1.6449 * sd + np.nan_to_num(half)
    unit = np.nan_to_num(steps, nan=1.0)
    return _scored(unit * y, unit * mean, unit * mean, log_score, within)


def _of_model(
    tree: object, people: Sequence[Mission], scored: np.ndarray, given: str, seed: int
) -> pd.DataFrame:
    found = predict_reports(tree, people, given=given, seed=seed)  # pyright: ignore
    scored = scored[:, : found.sizes["bound"]]
    y, mean, log_score = (found[name].values[scored] for name in ("report", "mean", "log_score"))
    low, median, high = (found["quantile"].values[scored][:, i] for i in (0, 2, 4))
    return _scored(y, mean, median, log_score, (low <= y + 1e-9) & (y <= high + 1e-9))


def _scored(
    y: np.ndarray,
    mean: np.ndarray,
    median: np.ndarray,
    log_score: np.ndarray,
    covered: np.ndarray,
) -> pd.DataFrame:
    """Errors and scores of some reports, a row for each."""
    off = {"mae": np.abs(y - median), "rmse": (y - mean) ** 2}
    return pd.DataFrame({**off, "log_score": log_score, "coverage_90": covered.astype(float)})
