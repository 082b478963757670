"""Logs of real robots: models and baselines, fitted to one half, scored by bound on the other.

Run: python benchmarks/logs.py [replicate] [memory] [--data FOLDER] [--window 20 10 5] [--quick]

FOLDER, by default TRUSTBO_DATA, has `mrclam/`, a run of the UTIAS data set as `tb.logs.read_mrclam`
reads it; `--to` names the folder of another run of the same robots, which then takes the place of
the second half. --quick takes a log that is made up.
"""

import time
from pathlib import Path

import pandas as pd
from common import Table, arguments, parsed

import trustbo as tb
from trustbo.models import HierarchicalTrust, PooledTrust, RobotEffect

COUNTS = {"observation": "beta_binomial"}
MODELS = {
    "Pooled, Gaussian": PooledTrust(),
    "Pooled, censored": PooledTrust(observation="censored"),
    "Hierarchical, censored": HierarchicalTrust(observation="censored"),
    "Pooled, counts": PooledTrust(**COUNTS),
    "Hierarchical, counts": HierarchicalTrust(**COUNTS),
    "robots, counts": PooledTrust(effects=RobotEffect(), **COUNTS),
    "robots, counts, deviation": PooledTrust(effects=RobotEffect(), memory="deviation", **COUNTS),
}
SIMPLE = ("Pooled, censored", "Hierarchical, censored", "robots, counts, deviation")
"""Models that are tried without a sensor too."""


class Logs:
    """Two logs, their geometry and sensors, and missions of both."""

    def __init__(self, logs: dict[str, tb.logs.Log]) -> None:
        self.logs = logs
        self.geometry = {name: tb.logs.geometry(log) for name, log in logs.items()}
        self.sensors = {name: tb.logs.fit_sensor(g) for name, g in self.geometry.items()}

    def missions(self, window: float, *, sensor: bool) -> dict:
        """Missions of each log, of features learned from the log fitted to."""

        def of(name: str):
            def missions(learned: str) -> list[tb.Mission]:
                return tb.logs.missions_of(
                    self.logs[name], window, geometry=self.geometry[name],
                    sensor=self.sensors[learned] if sensor else None,
                )  # fmt: skip

            return missions

        return {name: of(name) for name in self.logs}


def replicate(logs: Logs, windows: list[float]) -> None:
    """Scores of all models and baselines, both ways."""
    first = next(iter(logs.logs))
    for window in windows:
        began = time.process_time()
        expected = tb.study.replicate(logs.missions(window, sensor=True), MODELS)
        models = {name: MODELS[name] for name in SIMPLE}
        simple = tb.study.replicate(logs.missions(window, sensor=False), models)
        simple = simple.rename(index=lambda name: f"{name}, no sensor", level="model")
        both = pd.concat([expected, simple]).reset_index()
        for learned, rows in both.groupby("fitted to", sort=False):
            rows = rows.sort_values("mean_log_score", ascending=False)
            other = rows["scored on"].iloc[0]
            print(f"\nwindows of {window:g} s, {learned} -> {other}")
            table = Table("model", "R2", "log score", "95 %", "behind", "95 %", "50 %", "90 %", "n")
            for row in rows.itertuples():
                apart = row.model.endswith("no sensor")  # behind the best of these
                behind = f"{row.behind_low:.2f} to {row.behind_high:.2f}"
                table.row(row.model, f"{row.r2:.3f}", f"{row.mean_log_score:.3f}",
                          f"{row.low:.2f} to {row.high:.2f}", "" if apart else f"{row.behind:.3f}",
                          "" if apart else behind, f"{row.coverage_50:.2f}",
                          f"{row.coverage_90:.2f}", row.n)  # fmt: skip
        print(f"{time.process_time() - began:.0f} s of one core, {first} first")


def memory(logs: Logs, windows: list[float]) -> None:
    """Does trust, or its deviation from expectation, last; do robots differ: log Bayes factors."""
    table = Table("window", "log", "memory", "beta0", "for beta0 > 0", "for robots", "fit, s")
    for window in windows:
        for name in logs.logs:
            missions = logs.missions(window, sensor=True)[name](name)
            for kept in ("level", "deviation"):
                model = PooledTrust(effects=RobotEffect(), memory=kept, **COUNTS)
                began = time.process_time()
                posterior = tb.fit(missions, model, progress=False)
                seconds = time.process_time() - began
                found = tb.inference.memory(posterior)
                alone = PooledTrust(memory=kept, **COUNTS)
                without = tb.fit(missions, alone, progress=False, whole=False, check=False)
                gain = posterior.attrs["log_evidence"] - without.attrs["log_evidence"]
                beta0 = posterior["posterior"]["beta0"]
                table.row(f"{window:g}", name, kept, f"{float(beta0.mean()):.2f}",
                          f"{found.log_bf:.1f}", f"{gain:.1f}", f"{seconds:.1f}")  # fmt: skip


def main() -> None:
    parser = arguments(__doc__, names=("replicate", "memory"), data=True, quick="a made-up log")
    parser.add_argument("--to", type=Path, help="folder of another run")
    parser.add_argument("--window", type=float, nargs="+", default=[20.0, 10.0, 5.0])
    given = parsed(parser)
    if given.quick:
        whole = tb.logs.synthetic_log(minutes=10.0)
        given.window = [20.0]
    else:
        whole = tb.logs.read_mrclam(given.data / "mrclam")
    if given.to:
        logs = {"this run": whole, "other run": tb.logs.read_mrclam(given.to)}
    else:
        middle = whole.span[1] // 40.0 * 20.0
        parts = (0.0, middle), (middle, whole.span[1])
        logs = {n: whole.between(*p) for n, p in zip(("first", "second"), parts, strict=True)}
    both = Logs(logs)
    for name, part in (("replicate", replicate), ("memory", memory)):
        if name in given.names:
            part(both, given.window)


if __name__ == "__main__":
    main()
