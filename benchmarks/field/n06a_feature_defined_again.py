"""KIND: a notebook cell that registers a feature cannot be run again: the name is taken until the kernel restarts
RIGHT: the cell runs again, and the last definition counts
SOURCE: DeepPavlov#262 (registries in Jupyter); m31 of the last round"""
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

CELL = """
@tb.terrain.feature("stones", sign=-1)
def stones(terrain):
    return 0.0 * terrain["dem"].values
"""
space = {"tb": tb, "__name__": "__main__"}
exec(CELL, space)
end, got, told = tried(lambda: exec(CELL, space))
done(end == "value" and tb.terrain.FEATURES["stones"].compute is space["stones"], f"{end}: {got}")
