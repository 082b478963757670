"""Run the commands of week.sh, and print them with their output and the seconds that each took.

    python week.py [--out FOLDER] > output.txt

Afterwards, the logs and exports are compared by pandas, rasterio, pyproj and PyYAML.
"""

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import rasterio
import yaml
from pyproj import Transformer

from trustbo.terrain.examples import EXAMPLE_FILES

HERE = Path(__file__).parent
DRIVES = "robots"
WAITING = ("Loading ", "Computing ", "Measuring ")
"""Beginnings of messages about what takes a few seconds."""


def commands():
    """Yield the lines of week.sh; STUCK becomes the position at which the lead got stuck."""
    for line in (HERE / "week.sh").read_text(encoding="utf-8").splitlines()[3:]:
        yield line.replace("STUCK", end_of("legs-4.csv")) if "STUCK" in line else line


def end_of(log):
    """Last position in a log of legs, as an operator would write it at a shell."""
    last = pd.read_csv(log).iloc[-1]
    return f"x={last['utm_e']},y={last['utm_n']}"


def in_new_process(words):
    """Run a command in a new process, and return its exit code and output."""
    script = [sys.executable, HERE / "robots.py"] if words[0] == DRIVES else ["trustbo"]
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    ended = subprocess.run(
        [*map(str, script), *words[1:]],
        capture_output=True,
        text=True,
        env={**os.environ, "PATH": path},
    )
    warnings = [line for line in ended.stderr.splitlines() if not line.startswith(WAITING)]
    return ended.returncode, ended.stdout + "".join(f"{line}\n" for line in warnings)


def prepare(folder):
    """Put the maps and the names of columns into an empty folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, file in zip(("dem.tif", "dsm.tif"), EXAMPLE_FILES, strict=True):
        shutil.copy(file, folder / name)
    shutil.copy(HERE / "columns.toml", folder)


def run_week(call=in_new_process):
    """Yield each line of the week with its output and seconds; the current folder is prepared."""
    for line in commands():
        if not line or line.startswith("#"):
            yield line, "", 0.0
            continue
        began = time.monotonic()
        code, output = call(shlex.split(line))
        if code:
            raise SystemExit(f"{line}\n{output}exit code {code}")
        yield line, output, time.monotonic() - began


def apart():
    """Return how far pandas, rasterio, pyproj and PyYAML are from the exports of the week.

    Returns:
        Largest difference of the contact rates in the first log from those in the table, of the
        lead's waypoints from the stops in GeoJSON (m), for both courses, and of the origins of
        their frames from the lower left corner of the grid (m).
    """
    log = pd.read_csv("legs-1.csv").groupby(["leg", "vehicle"])["contact_pct"].first()
    told = pd.read_csv("maps/missions.csv").query("mission == 1 and bound > 0")
    rates = told.set_index(["bound", "robot"])["contact_rate"]
    found = {"contact rates": float(np.abs(rates.to_numpy() - 0.01 * log.to_numpy()).max())}

    with rasterio.open("maps/maps.tif") as maps:
        corner = np.array([maps.bounds.left, maps.bounds.bottom])
        to_metres = Transformer.from_crs("EPSG:4326", maps.crs, always_xy=True)
    for k in (1, 2):
        origin = yaml.safe_load(Path(f"nav2-{k}/frame.yaml").read_text())["origin"]
        found[f"origin of frame {k}, m"] = float(np.abs(origin - corner).max())

        poses = yaml.safe_load(Path(f"nav2-{k}/waypoints_lead.yaml").read_text())["poses"]
        places = [[pose["pose"]["position"][axis] for axis in "xy"] for pose in poses]
        layers = json.loads(Path(f"path-{k}.geojson").read_text())["features"]
        line = next(one["geometry"] for one in layers if one["properties"]["layer"] == "path")
        stops = np.transpose(to_metres.transform(*np.transpose(line["coordinates"])))
        found[f"waypoints {k}, m"] = float(np.abs(places + np.array(origin) - stops).max())
    return found


def main():
    """Run the week in a folder, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/week"))
    folder = parser.parse_args().out
    shutil.rmtree(folder, ignore_errors=True)
    prepare(folder)
    os.chdir(folder)

    took = []
    for line, output, seconds in run_week():
        if not line or line.startswith("#"):
            print(line)
            continue
        print(f"$ {line}\n{output}", end="", flush=True)
        if not line.startswith(DRIVES):
            took.append(seconds)
            print(f"[{seconds:.1f} s]", flush=True)

    print(f"\n{len(took)} commands, no line of Python; {np.median(took):.1f} s (median)")
    for what, difference in apart().items():
        print(f"largest difference of {what}: {difference:.2g}")


if __name__ == "__main__":
    main()
