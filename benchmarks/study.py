"""How much sooner is a study done on two cores, and does it survive a worker's death?

Run: python benchmarks/study.py [--quick] [--nuts]

4 policies x 20 seeds x 8 missions on 10 x 10 cells, contact rates from the trust model itself, the
posterior by the exact sampler: fitting is quick then, so that what the workers do beside it counts.
First serially, then by a local Dask cluster of 2 workers, each pinned to a core; then again by such
a cluster, of which a worker is killed (SIGKILL) once a quarter of the runs have ended; then once
more, with nothing left to do. `--nuts` adds a smaller study by NUTS, whose workers have to compile.
"""

import os
import signal
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import xarray as xr
from common import arguments, parsed, timed
from distributed import Client, LocalCluster

from trustbo import study

TARGET = 1.6
TRUTH = {"beta0": 0.6, "beta": [0.3, 0.2], "b": 0.05, "delta_w": 0.05, "delta_v": 0.05}


def settings(n_seeds, sampler):
    return study.Study(
        terrains={"cells": {"kind": "random_workspace", "shape": (10, 10), "seed": "run"}},
        simulators={
            "truth": {"kind": "ModelSimulator", "params": {"kind": "TrustParams", **TRUTH}}
        },
        policies=["greedy", "thompson", "optimistic", "random"],
        samplers=[sampler],
        seeds=n_seeds,
        n_iterations=8,
    )


def run(config, folder, executor):
    return timed(lambda: study.run_study(config, folder, executor, progress=False))


def same(a, b):
    """Whether all but the clock is equal, to the last bit."""
    names = [name for name in a if not str(name).startswith("seconds")]
    try:
        xr.testing.assert_identical(a[names], b[names])
    except AssertionError as error:
        print(error)
        return False
    return True


def compare(config, folder):
    """Serial against two workers; the serial results."""
    t_serial, alone = run(config, folder / "serial", "serial")
    load = os.getloadavg()[0]
    t_dask, shared = run(config, folder / "dask", "dask")
    cpu = [float(dataset["seconds_cpu"].sum()) for dataset in (alone, shared)]
    n = int(np.isfinite(alone["value"]).sum())
    ratio = t_serial / t_dask
    print(f"{alone.sizes['run']} runs, {n} missions, sampler {alone['sampler'].values[0]}")
    print(
        f"serial          {t_serial:7.1f} s  {n / t_serial:6.2f} missions/s  (load then {load:.1f})"
    )
    print(
        f"dask, 2 workers {t_dask:7.1f} s  {n / t_dask:6.2f} missions/s  (start of both included)"
    )
    print(f"       CPU seconds of the runs: {cpu[0]:.1f} and {cpu[1]:.1f}; were both cores free,")
    print(f"       and the start of the workers left out: ratio {2 * cpu[0] / cpu[1]:.2f}")
    print(f"{'met   ' if ratio >= TARGET else 'MISSED'} ratio {ratio:.2f}, target {TARGET}")
    print(f"{'met   ' if same(alone, shared) else 'MISSED'} the same numbers, bit for bit")
    return alone


def kill_one(client, folder, n_before):
    """SIGKILL a worker as soon as so many runs have ended."""
    process = next(iter(client.run(os.getpid).values()))
    while len(list((folder / "runs").glob("*.json"))) < n_before:
        time.sleep(0.05)
    os.kill(process, signal.SIGKILL)
    print(f"       killed worker {process} after {n_before} runs")


def survive(config, folder, expected):
    n_before = expected.sizes["run"] // 4
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        killer = threading.Thread(target=kill_one, args=(client, folder, n_before))
        killer.start()
        seconds, dataset = run(config, folder, client)
        killer.join()
    met = same(expected, dataset) and dataset.attrs["n_failed"] == 0
    print(
        f"{'met   ' if met else 'MISSED'} a worker killed midway: the same numbers, {seconds:.1f} s"
    )
    seconds, _ = run(config, folder, "dask")
    print(f"{'met   ' if seconds < 5 else 'MISSED'} called again, nothing to do: {seconds:.2f} s")


def main():
    parser = arguments(__doc__, quick="3 seeds")
    parser.add_argument("--nuts", action="store_true", help="a study of 4 x 3 runs by NUTS too")
    options = parsed(parser)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        config = settings(3 if options.quick else 20, "exact")
        expected = compare(config, folder)
        survive(config, folder / "killed", expected)
        print(study.summary(expected).unstack("mission")["median"].round(4).to_string())
        if options.nuts:
            compare(settings(3, "nuts"), folder / "nuts")


if __name__ == "__main__":
    main()
