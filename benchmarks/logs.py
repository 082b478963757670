"""Predictions for a log of real robots: models are fitted to one half and scored on the other.

    python benchmarks/logs.py [score] [memory] [--data FOLDER] [--window 20 10] [--quick]

FOLDER (by default, the environment variable TRUSTBO_DATA) must contain `mrclam/`, a run of the
UTIAS data set as published (Leung, Halpern, Barfoot and Liu, International Journal of Robotics
Research 30 (8), 2011). The files are not included; the terms of their producers apply.
"""

from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import pandas as pd
from common import Table, arguments, parsed

import trustbo as tb
from trustbo.models import PooledTrust, RobotEffect

MODELS = {
    "Gaussian": PooledTrust(),
    "censored": PooledTrust(family="censored"),
    "counts": PooledTrust(family="beta_binomial"),
    "counts, robots": PooledTrust(effects=RobotEffect(), family="beta_binomial"),
}


def read_mrclam(run):
    """Read tables of poses and detections from the folder `run` of five robots.

    The folder contains Robot1_Groundtruth.dat, Robot1_Measurement.dat, ... and Barcodes.dat, or
    poses.csv and detections.csv.
    """
    if not (run / "Barcodes.dat").exists():
        poses, seen = (
            pd.read_csv(next(run.glob(f"{name}.csv*"))) for name in ("poses", "detections")
        )
        return poses, seen[["t", "watcher", "seen"]]
    subject = {int(code): int(n) for n, code in np.loadtxt(run / "Barcodes.dat")[:, :2]}
    poses, detections = [], []
    for i in range(1, 6):
        track = np.loadtxt(run / f"Robot{i}_Groundtruth.dat")
        times = np.arange(track[0, 0], track[-1, 0], 0.5)  # the log has 100 poses per second
        kept = track[np.unique(np.searchsorted(track[:, 0], times))]
        poses.append(pd.DataFrame(kept, columns=["t", "x", "y", "heading"]).assign(robot=i))
        for t, code, *_ in np.loadtxt(run / f"Robot{i}_Measurement.dat"):
            if 1 <= subject.get(int(code), 0) <= 5:
                detections.append((t, i, subject[int(code)]))
    table, start = pd.concat(poses), min(one["t"].iloc[0] for one in poses)
    seen = pd.DataFrame(detections, columns=["t", "watcher", "seen"])
    return table.assign(t=table["t"] - start), seen.assign(t=seen["t"] - start)


def halves(poses, detections):
    """Split the tables of a log into two halves."""
    middle = poses["t"].max() // 40.0 * 20.0
    return {
        name: [table[(table["t"] >= a) & (table["t"] <= b)] for table in (poses, detections)]
        for name, a, b in (("first", 0.0, middle), ("second", middle, np.inf))
    }


def simulated():
    """Simulate robots on circles; detections become rarer with distance."""
    rng, t, rows, seen = np.random.default_rng(0), np.arange(0.0, 600.0, 0.5), [], []
    for i in range(4):
        a = t / (20.0 + 5.0 * i) + i
        place = {"x": (3.0 + i) * np.cos(a), "y": (3.0 + i) * np.sin(a)}
        rows.append(pd.DataFrame({"t": t, "robot": i, **place, "heading": a + np.pi / 2}))
    for k in range(0, len(t), 2):
        xy = np.array([one[["x", "y"]].iloc[k] for one in rows])
        away = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
        chance = rng.random((4, 4)) < 0.8 - 0.05 * away
        seen += [(t[k], i, j) for i, j in np.argwhere(chance) if i != j]
    return pd.concat(rows), pd.DataFrame(seen, columns=["t", "watcher", "seen"])


def score(logs, window):
    """Print the log score of each model, one bound ahead, on the other half of the log."""
    table = Table("window", "fitted to", "model", "log score", "n", name="logs")
    for learned, other in (("first", "second"), ("second", "first")):
        train, test = (tb.logs.read_tracks(*logs[name], window=window) for name in (learned, other))
        for name, model in MODELS.items():
            posterior = tb.fit(train, model, progress=False)
            found = tb.inference.score(posterior, test)
            table.row(f"{window:g} s", learned, name, f"{float(found['mean_log_score']):.3f}",
                      int(found["n"]))  # fmt: skip


def memory(logs, window):
    """Print the log Bayes factor for trust that depends on trust in the previous bound."""
    table = Table("window", "half", "for beta0 > 0", "beta0", name="logs_memory")
    for name, tables in logs.items():
        missions, model = tb.logs.read_tracks(*tables, window=window), MODELS["counts"]
        model = model.for_features(missions[0].features)
        none = replace(model, priors=replace(model.priors, beta0=dist.Beta(1.0, 1e6)))
        carried, other = (tb.fit(missions, m, progress=False, latent=False) for m in (model, none))
        factor = carried.attrs["log_evidence"] - other.attrs["log_evidence"]
        beta0 = float(carried["posterior"]["beta0"].mean())
        table.row(f"{window:g} s", name, f"{factor:.1f}", f"{beta0:.2f}")


def main():
    parser = arguments(__doc__, names=("score", "memory"), data=True, quick="use a simulated log")
    parser.add_argument("--window", type=float, nargs="+", default=[20.0, 10.0])
    given = parsed(parser)
    if given.data is None and not given.quick:
        print("The log of robots is not read: give --data or set TRUSTBO_DATA (see --help).")
        return

    logs = halves(*(simulated() if given.quick else read_mrclam(given.data / "mrclam")))
    for name, part in (("score", score), ("memory", memory)):
        if name in given.names:
            for window in given.window:
                part(logs, window)


if __name__ == "__main__":
    main()
