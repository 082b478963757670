"""KIND: a robot without any tick in a bound (n_ticks 0 and a blank rate, as groupby and count give) is refused
RIGHT: read as not measured
SOURCE: pandas' groupby: count gives 0 where mean gives NaN"""
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

PATH = [(3, 0), (2, 1), (1, 2)]
y = np.array([[0.4, np.nan], [0.2, 0.6]])
n = np.array([[5, 0], [5, 5]])
end, got, told = tried(lambda: tb.Mission.from_arrays(PATH, np.full((2, 2, 2), 0.5), y, n_ticks=n))
done(end == "value" and np.isnan(got.n_ticks[0, 1]), f"{end}: {got}")
