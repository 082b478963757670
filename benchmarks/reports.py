"""Trust that operators report in campaigns: calibration, gains found, and reports ahead.

Run: python benchmarks/reports.py [calibration] [ahead] [--sets 200] [--quick]

Contact is that of three robots, one of which is worse from the middle of the campaign on; reports
are drawn from the prior of their model (calibration: ranks of all parameters, after missions
alone, three scales), or from operators of known gains (ahead), who report after each mission, or
after each bound.
"""

import numpy as np
from common import Table, arguments, parsed, timed
from scipy import stats

import trustbo as tb
from trustbo.errors import PosteriorError
from trustbo.inference import expect_reports, fit_reports
from trustbo.inference.people import draw_people
from trustbo.inference.prior_predictive import draw_sites
from trustbo.models import HumanTrust
from trustbo.models.effects.effect import Slots
from trustbo.stacking import stack_missions

N_MISSIONS, N_BOUNDS, N_ROBOTS = 10, 8, 3
N_RANKED = 396
GAINS = (0.08, -0.16)  # of a bound of full contact, and of one without


def main():
    parser = arguments(__doc__, names=("calibration", "ahead"), quick="4 sets")
    parser.add_argument("--sets", type=int, default=200, help="number of campaigns")
    given = parsed(parser)
    n = 4 if given.quick else given.sets
    for name in given.names:
        {"calibration": calibration, "ahead": ahead}[name](n)


def contacts(n_missions, rng):
    """Contact rates (mission, bound, robot)."""
    level = rng.uniform(0.5, 0.95, N_ROBOTS) * np.ones((n_missions, 1, N_ROBOTS))
    level[n_missions // 2 :, :, -1] *= 0.4
    return np.clip(level + 0.2 * rng.standard_normal((n_missions, N_BOUNDS, N_ROBOTS)), 0.0, 1.0)


def told(rates, reports=None, scale="unit", *, every=False):
    """Missions of contact rates, with reports in [0, 1] (mission, 1 + bound, robot), some kept."""
    path, z = [(0, k) for k in range(N_BOUNDS + 1)], np.full((N_BOUNDS, N_ROBOTS, 1), 0.5)
    missions = [tb.Mission.from_arrays(path, z, rate) for rate in rates]
    if reports is None:
        return [
            mission.with_reports(np.full(N_ROBOTS, np.nan), scale=scale) for mission in missions
        ]
    levels = int(scale[-1]) if scale != "unit" else 0
    answers = np.round(1 + (levels - 1) * reports) if levels else reports
    if not every:
        answers = answers[:, -1]
    return [m.with_reports(a, scale=scale) for m, a in zip(missions, answers, strict=True)]


def from_prior(scale, rates, seed):
    """Parameters drawn from the prior, and missions with reports drawn under them."""
    model = HumanTrust.of_operators(scale).for_features(("success", "failure"))
    sites = draw_sites(model, (1, 2), 1, seed)
    units = [*tb.logs.reports_of(told(rates, scale=scale)).values()]
    slots = Slots.every(stack_missions(units, pad=False), len(units), model.names, None)
    drawn = draw_people(model, slots, sites, np.random.default_rng([seed, 4]))
    steps = drawn["contact_rate"][0, :, :, 0].T  # (step, robot)
    truth = {name: value[0] for name, value in sites.items()} | {"person": drawn["person"][0]}
    return truth, told(rates, steps.reshape(len(rates), -1, N_ROBOTS), scale)


def calibration(n):
    """Ranks of the truth among draws: uniform where prior, likelihood and sampler fit."""
    table = Table("scale", "sets", "refused", "parameters", "smallest p", "limit", "50 %", "90 %",
                  "uniform", "seconds a fit")  # fmt: skip
    for scale in ("unit", "likert7", "ordinal7"):
        ranks, refused, spent = [], 0, 0.0
        for j in range(n):
            seed = int(np.random.SeedSequence([7, j]).generate_state(1)[0])
            rates = contacts(N_MISSIONS, np.random.default_rng([7, j]))
            truth, missions = from_prior(scale, rates, seed)
            try:
                seconds, tree = timed(lambda m=missions, j=j: fit_reports(m, seed=j))
            except PosteriorError:
                refused += 1
                continue
            spent += seconds
            ranks.append(ranked(tree, truth))
        pit = (np.array(ranks) + 0.5) / (N_RANKED + 1)
        n_bins = min(20, max(2, len(pit) // 5))
        p = [
            stats.chisquare(np.histogram(column, n_bins, (0.0, 1.0))[0]).pvalue for column in pit.T
        ]
        inside = [(np.abs(pit - 0.5) < 0.5 * width).mean() for width in (0.5, 0.9)]
        limit = 0.01 / len(p)
        verdict = "not rejected" if min(p) > limit else "REJECTED"
        table.row(scale, n, refused, len(p), f"{min(p):.4f}", f"{limit:.5f}", f"{inside[0]:.1%}",
                  f"{inside[1]:.1%}", verdict, f"{spent / max(len(pit), 1):.2f}")  # fmt: skip


def ranked(tree, truth):
    """Ranks of the true parameters, and of the parts of the first and the last robot."""
    drawn = {n: a.values for n, a in tree["posterior"].to_dataset().items()}
    ends = {"person": tree["persons"]["person"].values[:, :, [0, -1]]}
    truth = truth | {"person": truth["person"][[0, -1]]}
    ranks = []
    for name, values in (drawn | ends).items():
        flat = values.reshape(values.shape[0] * values.shape[1], -1)
        some = flat[np.linspace(0, len(flat) - 1, N_RANKED).astype(int)]
        ranks += (some < np.ravel(truth[name])).sum(0).tolist()
    return ranks


def operator(rates, rng):
    """Reports (mission, 1 + bound, robot) of one operator of known gains."""
    base = 0.65 + 0.05 * rng.standard_normal(N_ROBOTS)
    gains = np.array(GAINS)[:, None] + 0.02 * rng.standard_normal((2, 1))
    d, reports = 0.1 * rng.standard_normal(N_ROBOTS), []
    for mission in rates:
        for c in (None, *mission):
            moved = 0.0 if c is None else gains[0] * c + gains[1] * (1.0 - c)
            d = 0.85 * d + moved + 0.02 * rng.standard_normal(N_ROBOTS)
            reports.append(np.clip(base + d + 0.04 * rng.standard_normal(N_ROBOTS), 0.0, 1.0))
    return np.array(reports).reshape(len(rates), 1 + N_BOUNDS, N_ROBOTS), gains[0] - gains[1]


def ahead(n):
    """Gains of operators found, and reports after the next mission against what was said last."""
    table = Table("reports", "scale", "gain: bias", "sd", "90 %", "next report: MAE", "last report",
                  "90 %", "seconds a fit", "operators")  # fmt: skip
    for every in (False, True):
        for scale in ("unit", "likert7"):
            found = []
            for j in range(max(n // 5, 4)):
                rng = np.random.default_rng([11, j])
                rates = contacts(N_MISSIONS + 1, rng)
                reports, gain = operator(rates, rng)
                missions = told(rates[:-1], reports[:-1], scale, every=every)
                seconds, tree = timed(lambda m=missions, j=j: fit_reports(m, seed=j))
                beta = tree["posterior"]["beta"].values.reshape(-1, 2)
                drawn = beta[:, 0] - beta[:, 1]
                low, high = np.quantile(drawn, (0.05, 0.95))
                next_one = expect_reports(tree, missions, rates[-1]).isel(person=0, bound=-1)
                levels = 6.0 if scale != "unit" else np.inf
                y = (
                    reports[-1, -1]
                    if np.isinf(levels)
                    else np.round(levels * reports[-1, -1]) / levels
                )
                shares = [next_one["quantile"].values, next_one["last"].values]  # in [0, 1]
                q, last = ((v - 1.0) / levels if np.isfinite(levels) else v for v in shares)
                off = np.abs(q[2] - y).mean(), np.abs(last - y).mean()
                inside = ((q[0] <= y + 1e-9) & (y <= q[4] + 1e-9)).mean()
                found.append((drawn.mean() - gain.item(), drawn.std(), low <= gain.item() <= high,
                              *off, inside, seconds))  # fmt: skip
            bias, sd, covered, mae, last, inside, seconds = np.mean(found, axis=0)
            table.row("each bound" if every else "each mission", scale, f"{bias:+.3f}", f"{sd:.3f}",
                      f"{covered:.0%}", f"{mae:.3f}", f"{last:.3f}", f"{inside:.0%}",
                      f"{seconds:.2f}", len(found))  # fmt: skip


if __name__ == "__main__":
    main()
