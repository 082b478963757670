"""KIND: rates and awareness that rounding has moved out of [0, 1] (1.0000000000000002, 1.0000001 in single precision, -1e-17) are refused as 'percent?'
RIGHT: read as 1 and 0
SOURCE: entrofy#55 (total probability 1.000000000000001), ppsim#23, qrack#157"""
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
z = np.full((2, 2, 2), 0.5)
z[0, 0] = [-1e-17, np.float32(1.0) + np.float32(1e-7)]
y = np.full((2, 2), 0.4)
y[0, 0] = 0.1 + 0.7 + 0.2 + 1e-15
end, got, told = tried(lambda: tb.Mission.from_arrays(PATH, z, y).contact_rate.max())
done(got == 1.0, f"{end}: {got}")
