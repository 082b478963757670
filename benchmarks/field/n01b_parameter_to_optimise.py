"""KIND: a parameter to optimise (numpyro.param, flax_module) stays at its initial value in NUTS, in silence
RIGHT: refused with the name of the parameter
SOURCE: numpyro#743 and #1414 (flax_module, random_flax_module); models that were written for SVI"""
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

import jax
import numpyro
import numpyro.distributions as dist

rng = np.random.default_rng(0)
PATH = [(3, 0), (2, 1), (1, 2), (0, 3)]
MISSIONS = [
    tb.Mission.from_arrays(PATH, rng.uniform(size=(3, 2, 2)), rng.uniform(size=(3, 2)))
    for _ in range(3)
]


def end(drift, contact_rate):
    """The last site of each model."""
    rates = tb.models.ContactRate(drift, 0.5, 0.1, 0.1)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


def fitted(model):
    return tb.fit(MISSIONS, model, draws=50, warmup=50, check=False, latent=False, progress=False)


def model(awareness, contact_rate=None):
    weight = numpyro.param("weight", 0.3)
    level = numpyro.sample("level", dist.Normal(0.0, 0.1))
    end(level + weight * awareness[..., 1], contact_rate)


end_, got, told = tried(lambda: list(fitted(model)["posterior"].data_vars))
done(end_ == "refused" and "'weight'" in got, f"{end_}: {got}")
