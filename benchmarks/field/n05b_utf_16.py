"""KIND: a table that Excel saved as Unicode text (UTF-16) is answered by: close its quotes, or encoding cp1252
RIGHT: read, or a message that says UTF-16
SOURCE: Excel's format Unicode Text; pandas.read_csv(encoding='utf-16')"""
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

with open("missions.csv", "w", encoding="utf-16") as file:
    file.write("mission\tbound\trobot\tcontact_rate\n1\t1\ta\t0.5\n")
end, got, told = tried(lambda: tb.logs.read_table("missions.csv"))
done(end == "value" or (end == "refused" and "UTF-16" in got), f"{end}: {got}")
