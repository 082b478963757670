"""Logs of the UTIAS multi-robot cooperative localization and mapping data set (MRCLAM).

Leung, Halpern, Barfoot and Liu, The UTIAS multi-robot cooperative localization and mapping dataset,
International Journal of Robotics Research 30 (8), 2011. The files are the user's: their terms are
the producer's.
"""

from pathlib import Path

import numpy as np

from trustbo.errors import TrustboError
from trustbo.files import FilePath
from trustbo.logs.log import Log, read_log

_N_ROBOTS, _EVERY = 5, 0.5  # s between two of the poses that are kept, of 100 a second
_ROBOT, _TUBE = 0.17, 0.06  # radii, m


def read_mrclam(folder: FilePath) -> Log:
    """Read a run of the five robots.

    Args:
        folder: Folder of a run as published: `Robot1_Groundtruth.dat`,
            `Robot1_Measurement.dat`, ..., `Landmark_Groundtruth.dat`, `Barcodes.dat`; or of tables
            as of `read_log`.

    Raises:
        TrustboError: A file is missing, or is no such table.
    """
    run = Path(folder)
    if not (run / "Barcodes.dat").exists() and any(run.glob("poses.csv*")):
        log = read_log(run)
        landmarks = np.column_stack([log.landmarks[:, :2], np.full(len(log.landmarks), _TUBE)])
        log.landmarks, log.robot_radius = landmarks, _ROBOT
        return log
    subject = {int(code): int(number) for number, code in _table(run, "Barcodes.dat", 2)}
    poses: dict[str, list] = {name: [] for name in ("t", "robot", "x", "y", "heading")}
    seen: dict[str, list] = {name: [] for name in ("t", "watcher", "seen")}
    first = None
    for i in range(1, _N_ROBOTS + 1):
        track = _table(run, f"Robot{i}_Groundtruth.dat", 4)
        first = track[0, 0] if first is None else min(first, track[0, 0])
        times = np.arange(track[0, 0], track[-1, 0], _EVERY)
        kept = np.unique(np.searchsorted(track[:, 0], times))
        for name, column in zip(("t", "x", "y", "heading"), track[kept].T, strict=True):
            poses[name] += column.tolist()
        poses["robot"] += [str(i)] * len(kept)
        for t, code, *_ in _table(run, f"Robot{i}_Measurement.dat", 4):
            number = subject.get(int(code), 0)
            if 1 <= number <= _N_ROBOTS:
                for name, value in zip(seen, (t, str(i), str(number)), strict=True):
                    seen[name].append(value)
    for table in (poses, seen):
        table["t"] = (np.array(table["t"]) - (first or 0.0)).tolist()
    tubes = _table(run, "Landmark_Groundtruth.dat", 3)[:, 1:3]
    landmarks = np.column_stack([tubes, np.full(len(tubes), _TUBE)])
    return Log(poses, seen, landmarks=landmarks, robot_radius=_ROBOT)


def _table(run: Path, name: str, n_columns: int) -> np.ndarray:
    """Numbers of a file, (row, column), at least `n_columns` of them."""
    file = run / name
    if not file.is_file():
        raise TrustboError(
            f"there is no {name} in {str(run)!r}; give the folder of a run of MRCLAM, which has "
            "Robot1_Groundtruth.dat, ..., Barcodes.dat."
        )
    try:
        table = np.loadtxt(file, comments="#", ndmin=2)
    except ValueError as error:
        raise TrustboError(f"{str(file)!r} is no table of numbers: {error}.") from None
    if table.shape[1] < n_columns or not len(table):
        raise TrustboError(f"{str(file)!r} must have {n_columns} columns; got {table.shape}.")
    return table
