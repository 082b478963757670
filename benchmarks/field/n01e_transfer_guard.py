"""KIND: settings of JAX that find slow transfers stop a model of the user, as if the model were at fault
RIGHT: fitted
SOURCE: jax.transfer_guard in scripts that look for transfers; trustbo sets other flags of JAX itself"""
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
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))
    end(weight * awareness[..., 1], contact_rate)


with jax.transfer_guard("disallow"):
    end_, got, told = tried(lambda: list(fitted(model)["posterior"].data_vars))
done(got == ["weight"], f"{end_}: {got}")
