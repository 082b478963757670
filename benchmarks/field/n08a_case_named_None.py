"""KIND: a case named None (or NA, null) in a study is read back from its file as missing, and its runs are left out of all summaries in silence; a case named 01 is 1
RIGHT: names are texts
SOURCE: pandas#10647 and #24681 (NA and None as values), pandas#41119 (groupby leaves out missing keys)"""
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

class Steady:
    """Simulator in which the contact of a bound is its mean awareness."""

    def __init__(self, workspace):
        self.workspace = workspace

    def run(self, path, *, seed, mission=0):
        z = self.workspace.along(path)
        return tb.Mission.from_arrays(path, z, z.mean(-1))


def scene():
    workspace = tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(2, 3, 3, 2)))
    judge = tb.simulation.Truth.from_simulator(Steady(workspace), n_replicates=1)
    return tb.study.Scene(workspace, Steady(workspace), (2, 0), (0, 2), judge)


def study():
    pooled = {"model": tb.models.PooledTrust(), "policy": "random"}
    cases = {"None": pooled, "01": pooled}
    table = tb.study.run_grid(cases, {"NA": scene}, "runs", n_missions=1, n_jobs=1)
    return sorted(tb.study.summary(tb.study.numbers_of(table)).index)


end, got, told = tried(study)
done(got == ["01", "None"], f"{end}: cases {got}")
