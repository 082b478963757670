"""KIND: a plan with a posterior of fit(missions) is answered by: give the awareness of the same grid, of params.place, which the user never made
RIGHT: a plan, or a message that names workspace= of fit
SOURCE: the first script of a new user: fit, then Planner.plan"""
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

rng = np.random.default_rng(0)
MAP = tb.Workspace.from_awareness(rng.uniform(size=(2, 5, 4, 2)))
PATH = [(3, 0), (2, 1), (1, 2), (0, 3)]
MISSIONS = [
    tb.Mission.from_arrays(PATH, MAP.along(PATH), rng.uniform(size=(3, 2))) for _ in range(3)
]
posterior = tb.fit(MISSIONS, draws=200, check=False, progress=False)
end, got, told = tried(lambda: tb.Planner(MAP, (3, 0), (0, 3)).plan(posterior).path)
done(end == "value" or (end == "refused" and "workspace=" in got), f"{end}: {got}")
