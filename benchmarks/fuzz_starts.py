"""Fuzz test of `fit(start=)` from posteriors that the new missions contradict.

    python benchmarks/fuzz_starts.py [kind ...] [-n N] [--first I] [--seed S] [--quick]

Each case draws a model and two groups of missions. They vary the kind of model (equal, different or
coupled robots, people, a NumPyro function), the family of the rates, the number of robots, effects,
what lasts, shared noise, and the level of contact. Four coupled robots with rates that are not
Gaussian are left out, as their fits take a minute each. The levels of the two groups contradict
each other; for example, contact is whole in the first group and almost none in the second. A
posterior of the first group is the start of fits of both groups together, with four seeds.

Each mean is compared with the mean of two fits without start, in standard deviations of these. The
largest difference of all parameters counts, and it should be at most a third of a standard
deviation. Larger differences are computed again with four more fits without start. The row `without
start` shows how far the first two fits without start differ, which is mostly Monte Carlo error. The
other rows are by kind of model. The columns count fits by outcome:

    foreign         an exception that is not a TrustboError
    refused         a TrustboError although the fits without start are accepted
    refused anyway  the first posterior or a fit without start is refused; there is no difference
    in doubt        the fits without start differ by more than the limit from each other, or have a
                    smaller evidence, so that they are no reference; the difference does not count
    > 0.34          other differences beyond the limit

Each of these but the third is printed with its case. Case I of a seed is always the same. The exit
status is 1 if there is a foreign error, a refusal or a difference beyond the limit.
"""

import sys
import warnings
from collections import defaultdict
from typing import NamedTuple

import numpy as np
import numpyro
import numpyro.distributions as dist
from common import Table, arguments, parsed

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.models import ContactRate

KINDS = ("pooled", "hierarchical", "coupled", "people", "function")
SHARES = (0.45, 0.2, 0.2, 0.1, 0.05)
"""Shares of the kinds of models."""
FAMILIES = ("gaussian", "censored", "beta_binomial")
LEVELS = ("whole", "high", "middle", "low", "none", "any", "falling")
CONTRADICTIONS = (
    ("whole", "none"), ("high", "low"), ("whole", "falling"), ("none", "any"), ("middle", "none"),
    ("none", "whole"), ("low", "high"), ("whole", "any"), ("falling", "whole"), ("middle", "whole"),
)  # fmt: skip
"""Levels of contact of the first and of the new missions."""
LIMIT = 0.34
"""Largest difference of means, in standard deviations."""
N_STARTED = 4
N_PLAIN = 2
"""Numbers of fits with start, and without, of each case."""
N_MORE = 4
"""Number of further fits without start after a difference beyond the limit."""
HIGHER = 1.0
"""Difference of log evidences above which a fit has found a part that others miss."""
QUANTILES = (0.5, 0.9, 0.99)
GRID = (6, 6)
OUTCOME_FEATURES = ("success", "failure")


class Case(NamedTuple):
    """A model, and missions that contradict each other."""

    name: str
    kind: str
    model: object
    first: list
    new: list


class Outcome(NamedTuple):
    """Differences of fits with start and of the fits without it, and texts of what is wrong."""

    with_start: list
    without: list
    foreign: list
    refused: list
    refused_anyway: int
    in_doubt: list
    wrong: list


def pick(rng, *values):
    return values[rng.integers(len(values))]


def linear(awareness, contact_rate=None, n_ticks=None):
    """Drift that is linear in the features, as a NumPyro function."""
    n_features = awareness.shape[-1]
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    beta = numpyro.sample("beta", dist.Normal(0.0, 0.5).expand([n_features]).to_event(1))
    b = numpyro.sample("b", dist.Normal(0.0, 0.3))
    delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.3))
    delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.3))
    with numpyro.plate("mission", len(awareness)):
        rates = ContactRate(awareness @ beta + b, beta0, delta_w, delta_v, n_ticks=n_ticks)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def rates_of(rng, level, shape):
    """Draw contact rates (bound, robot) of a level."""
    noise = pick(rng, 0.002, 0.02, 0.1)
    center = {"whole": 1.0, "high": 0.9, "middle": 0.5, "low": 0.1, "none": 0.0}
    if level in center:
        y = center[level] + noise * rng.standard_normal(shape)
    elif level == "falling":
        y = np.linspace(1.0, 0.0, shape[0])[:, None] + noise * rng.standard_normal(shape)
    else:
        y = rng.uniform(size=shape)
    return np.clip(y, 0.0, 1.0)


def path_of(rng, n_bounds):
    """Draw a random walk over the grid."""
    path = [tuple(rng.integers(GRID).tolist())]
    while len(path) <= n_bounds:
        cell = np.array(path[-1]) + rng.integers(-1, 2, 2)
        if (cell >= 0).all() and (cell < GRID).all() and tuple(cell.tolist()) != path[-1]:
            path.append(tuple(cell.tolist()))
    return path


def missions_of(rng, level, n_robots, n_features):
    """Draw missions of a level."""
    missions = []
    for _ in range(rng.integers(1, 4)):
        n_bounds = int(rng.integers(3, 10))
        z = rng.uniform(size=(n_bounds, n_robots, n_features))
        n_ticks = rng.integers(20, 200, (n_bounds, n_robots)).astype(float)
        y = np.round(rates_of(rng, level, n_ticks.shape) * n_ticks) / n_ticks
        y[1:][rng.random(y[1:].shape) < pick(rng, 0.0, 0.1)] = np.nan
        path = path_of(rng, n_bounds)
        missions.append(tb.Mission.from_arrays(path, z, y, n_ticks=n_ticks))
    return missions


def people_of(rng, level, scale):
    """Draw reports of persons at a level of trust."""
    people = []
    for _ in range(rng.integers(3, 10)):
        success = (rng.random((int(rng.integers(3, 8)), 1)) < 0.6).astype(float)
        z = np.stack([success, 1.0 - success], axis=-1)
        y = rates_of(rng, level, success.shape)
        n_ticks = None
        if scale == "likert7":
            y = np.round(6.0 * y) / 6.0
            n_ticks = np.full(y.shape, 6.0)
        one = tb.Mission.from_arrays(None, z, y, n_ticks=n_ticks, features=OUTCOME_FEATURES)
        people.append(one)
    return people


def case_of(seed, index):
    """Draw a case."""
    rng = np.random.default_rng([seed, index])
    kind = str(rng.choice(KINDS, p=SHARES))
    levels = pick(rng, *CONTRADICTIONS)
    if kind == "people":
        scale = pick(rng, "unit", "likert7")
        first, new = (people_of(rng, level, scale) for level in levels)
        model = tb.models.HumanTrust(scale=scale)
        return Case(f"people, {scale}, {' to '.join(levels)}", kind, model, first, new)

    n_robots = int(rng.integers(1 if kind in ("pooled", "function") else 2, 5))
    n_features = int(rng.integers(1, 4))
    first, new = (missions_of(rng, level, n_robots, n_features) for level in levels)
    name = f"{kind}, {n_robots} robots, {n_features} features, {' to '.join(levels)}"
    if kind == "function":
        return Case(name, kind, linear, first, new)

    options = {"family": pick(rng, *FAMILIES)}
    if kind != "coupled":
        options["memory"] = pick(rng, "level", "deviation")
        if options["family"] != "beta_binomial":
            options["shared_noise"] = pick(rng, False, True)

    effects = []
    if rng.random() < 0.3:
        effects.append(tb.models.PlaceEffect())
    if rng.random() < 0.3 and n_robots > 1:
        effects.append(tb.models.RobotEffect())
    classes = {
        "pooled": tb.models.PooledTrust,
        "hierarchical": tb.models.HierarchicalTrust,
        "coupled": tb.models.CoupledTrust,
    }
    model = classes[kind](effects=tuple(effects), **options)
    words = [str(value) for value in options.values()] + [type(one).__name__ for one in effects]
    return Case(f"{name}, {', '.join(words)}", kind, model, first, new)


def is_slow(case):
    """Return whether the fits of a case take very long."""
    is_coupled = isinstance(case.model, tb.models.CoupledTrust)
    return is_coupled and case.model.family != "gaussian" and len(case.first[0].robots) > 3


def fitted(missions, case, seed, start=None):
    """Fit missions without latent trust."""
    return tb.fit(missions, case.model, seed=seed, start=start, latent=False, progress=False)


class Moments(NamedTuple):
    """Means and standard deviations of all parameters by name, and the log evidence."""

    mean: dict
    sd: dict
    log_evidence: float


def moments(tree):
    """Return the moments of a posterior."""
    over = ("chain", "draw")
    values = tree["posterior"].to_dataset()
    mean = {name: values[name].mean(over) for name in values.data_vars}
    sd = {name: values[name].std(over) for name in values.data_vars}
    return Moments(mean, sd, tree.attrs.get("log_evidence", np.nan))


def joined(several):
    """Return the mean moments of several posteriors."""
    n = len(several)
    mean = {name: sum(one.mean[name] for one in several) / n for name in several[0].mean}
    sd = {name: sum(one.sd[name] for one in several) / n for name in several[0].sd}
    return Moments(mean, sd, max(one.log_evidence for one in several))


def difference(one, other):
    """Return the largest difference of means in standard deviations of `other`, and its name."""
    worst = 0.0, ""
    for name, sd in other.sd.items():
        off = abs(one.mean[name] - other.mean[name]) / sd.where(sd > 0.0)
        worst = max(worst, (float(off.max()), name))
    return worst


def outcome_of(case):
    """Fit the missions of a case with start and without."""
    both = case.first + case.new
    try:
        start = fitted(case.first, case, seed=100)
        plain = [moments(fitted(both, case, seed)) for seed in range(N_PLAIN)]
    except TrustboError:
        return Outcome([], [], [], [], N_STARTED, [], [])

    found = Outcome([], [difference(*plain)[0]], [], [], 0, [], [])
    for seed in range(N_PLAIN, N_PLAIN + N_STARTED):
        try:
            started = moments(fitted(both, case, seed, start))
        except TrustboError as error:
            found.refused.append(str(error))
            continue
        except Exception as error:
            found.foreign.append(f"{type(error).__name__}: {error}")
            continue

        off, name = difference(started, joined(plain))
        if off > LIMIT and len(plain) == N_PLAIN:
            for other in range(200, 200 + N_MORE):
                plain.append(moments(fitted(both, case, other)))
            off, name = difference(started, joined(plain))

        text = f"{name} off by {off:.2f}"
        apart = max(difference(one, joined(plain))[0] for one in plain)
        is_higher = started.log_evidence > joined(plain).log_evidence + HIGHER
        if off > LIMIT and (apart > LIMIT or is_higher):
            found.in_doubt.append(f"{text}, without start by {apart:.2f}")
            continue
        if off > LIMIT:
            found.wrong.append(text)
        found.with_start.append(off)
    return found


def row_of(name, outcomes, off):
    """Return the row of a table, given the differences."""
    quantiles = [f"{q:.2f}" for q in np.quantile(off, QUANTILES)] if off else ["", "", ""]
    lists = ("foreign", "refused", "in_doubt")
    foreign, refused, in_doubt = (sum(len(getattr(one, k)) for one in outcomes) for k in lists)
    refused_anyway = sum(one.refused_anyway for one in outcomes)
    n_fits = len(off) + foreign + refused + refused_anyway + in_doubt
    n_beyond = sum(value > LIMIT for value in off)
    counts = n_fits, foreign, refused, refused_anyway, in_doubt, n_beyond
    return (name, *counts, *quantiles, f"{max(off):.2f}" if off else "")


def main():
    words = arguments(__doc__, names=KINDS, n=500, quick="only 20 fits with start")
    for name in ("--first", "--seed"):
        words.add_argument(name, type=int, default=0)
    given = parsed(words)
    warnings.simplefilter("ignore")

    n_fits = 20 if given.quick else given.n
    by_kind = defaultdict(list)
    n_done = 0
    index = given.first
    while n_done < n_fits:
        case = case_of(given.seed, index)
        if case.kind in given.names and not is_slow(case):
            outcome = outcome_of(case)
            by_kind[case.kind].append(outcome)
            n_done += N_STARTED
            for what in ("foreign", "refused", "in_doubt", "wrong"):
                for text in getattr(outcome, what):
                    print(f"{what.upper()} {index}: {case.name}: {text}", flush=True)
        index += 1

    columns = ("fits", "foreign", "refused", "refused anyway", "in doubt", f"> {LIMIT}")
    table = Table("model", *columns, *(f"{100 * q:g} %" for q in QUANTILES), "largest", first=14)
    every = [one for outcomes in by_kind.values() for one in outcomes]
    for name, outcomes in [*((k, by_kind[k]) for k in KINDS if k in by_kind), ("all", every)]:
        table.row(*row_of(name, outcomes, [off for one in outcomes for off in one.with_start]))
    table.row(*row_of("without start", [], [off for one in every for off in one.without]))

    is_wrong = any(one.foreign or one.refused or one.wrong for one in every)
    return 1 if is_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
