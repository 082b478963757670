"""KIND: a name with an accent that one table writes as one character and the other as two (NFC and NFD, as file names on macOS) is another robot, whose contact is 0
RIGHT: one robot, or a message that says what differs (both look alike on the screen)
SOURCE: renpy#2327, shelf-back#50 (file names of macOS are NFD), fuse-t#16"""
import os
import sys
import tempfile
import warnings

os.chdir(tempfile.mkdtemp())
import numpy as np

import trustbo as tb


def tried(f):
    """Kind of end (value, refused, crash), its value or message, and text of warnings."""
    with warnings.catch_warnings(record=True) as got:
        warnings.simplefilter("always")
        try:
            end = "value", f()
        except tb.errors.TrustboError as error:
            end = "refused", str(error)
        except Exception as error:
            end = "crash", f"{type(error).__name__}: {error}"
    told = [str(w.message) for w in got if w.category is UserWarning]
    return *end, " ".join(t for t in told if "no surface (DSM)" not in t)


def done(right, line):
    print(("right: " if right else "WRONG: ") + " ".join(str(line).split())[:300])
    sys.exit(0 if right else 1)

import pandas as pd

PATH = [(3, 0), (2, 1), (1, 2), (0, 3)]
TEAM = tb.Team(2, names=("\u00e9clair", "b"))
MAP = tb.Workspace.from_awareness(np.full((2, 4, 4, 2), 0.5), cell_size=20.0, team=TEAM)
at = np.array([MAP.grid.center(cell) for cell in PATH])
poses, seen = [], []
for t in range(61):
    x, y = (np.interp(t, [0, 20, 40, 60], at[:, axis]) for axis in (0, 1))
    poses += [(t, name, x + d, y) for name, d in (("L", 0), ("\u00e9clair", 3), ("b", 6))]
    seen += [(t, "e\u0301clair", "L"), (t, "b", "L")]
poses = pd.DataFrame(poses, columns=["t", "robot", "x", "y"])
seen = pd.DataFrame(seen, columns=["t", "watcher", "seen"])

end, got, told = tried(lambda: tb.logs.read_tracks(poses, seen, MAP, lead="L", path=PATH)[0])
done(end == "value" and got.contact_rate.min() == 1.0, f"{end}: {got}; warned: {told!r}")
