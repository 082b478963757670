"""Functions of many kinds, in which one constant, default or closure can be chosen.

As a program, it prints the hashes of all of them, before and after use, and those of variants.
"""

import functools
import importlib
import json
import random
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property, lru_cache, partial, singledispatch, wraps
from pathlib import Path
from typing import NamedTuple

import cloudpickle
import jax
import jax.numpy as jnp
import numba
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import xarray as xr
from IPython.core.interactiveshell import InteractiveShell
from numpyro import handlers
from scipy import interpolate, sparse, special, stats
from scipy.stats import norm
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from trustbo.identity import fingerprint

CODE = """
import asyncio
import functools
import random

import numpy as np
import scipy.stats
import helpers_of_mine
import helpers_of_mine as aliased
from helpers_of_mine import scaled

LEVEL = {k}
TABLE = {{"a": [1.0, {k}], "b": {{"slope", "tri", "sight"}}}}
SET = frozenset({{"slope", "tri", "level {k}"}})


def constant(x):
    return {k} * x

by_lambda = lambda x: {k} * x

def default(x, scale={k}):
    return scale * x

def keyword(x, *, scale={k}):
    return scale * x

def of_global(x):
    return LEVEL * x

def of_table(x):
    return TABLE["a"][1] * x

def of_set(x):
    return len(SET) * x

def nested(x):
    def inner(y):
        return {k} * y
    return inner(x)

def comprehended(x):
    return [{k} * x for x in range(3)]

def generated(x):
    yield {k} * x

async def awaited(x):
    return {k} * x

def recursive(n):
    return recursive(n - 1) + {k} if n > 0 else 0.0

def one(n):
    return other(n - 1) if n > 0 else 0.0

def other(n):
    return one(n - 1) + {k} if n > 0 else 0.0

def tried(x):
    try:
        return x / LEVEL
    except ZeroDivisionError:
        return {k}

def looped(x):
    total = 0.0
    while x > 0.0:
        total += {k}
        x -= 1.0
    return total

def told(x):
    return f"{{x}} of {k}"

def matched(x):
    match x:
        case [a, b]:
            return a
        case _:
            return {k}

def of_class(x):
    class Own:
        "Documented."
        level: float = {k}
    return Own.level * x

def of_scipy(x):
    return scipy.stats.norm.ppf(0.9) * {k} * x

def of_numpy_random(x):
    return np.random.normal() * {k} * x

def of_random(x):
    return random.random() * {k} * x

def of_attribute(x):
    return helpers_of_mine.scaled(x)

def of_alias(x):
    return aliased.deeper.LEVEL * x if hasattr(aliased, "deeper") else aliased.LEVEL * x

def of_import(x):
    return scaled(x)

def imported_inside(x):
    from helpers_of_mine import scaled
    return scaled(x)

def package_imported_inside(x):
    from xml import dom
    from package_of_mine import lower
    return lower.scaled(x)

def module_imported_inside(x):
    import helpers_of_mine as h
    return h.scaled(x)
"""
HELPERS = '''
"""Module of a user."""

LEVEL = {k}


def scaled(x):
    return LEVEL * x
'''
CELL = """
import numpy as np

def of_cell(x: float) -> float:
    "Documented."
    return {k} * np.tanh(x)

def of_cells(x):
    return of_cell(x) + level_of_cell

level_of_cell = 1.0
"""


class Method:
    def __init__(self, k):
        self.k = k

    def __call__(self, x):
        return self.squared * x

    def method(self, x):
        return self.k * x

    @cached_property
    def squared(self):
        """Square of k."""
        return self.k**2

    @property
    def doubled(self):
        return 2.0 * self.k


class Slotted:
    __slots__ = ("k", "link")

    def __init__(self, k):
        self.k = k
        self.link = jnp.tanh

    def __call__(self, x):
        return self.link(self.k * x)


@dataclass
class Data:
    k: float
    names: set = field(default_factory=lambda: {"tri", "slope"})

    def __call__(self, x):
        return self.k * x


class Named(NamedTuple):
    k: float
    name: str = "slope"


class Decorator:
    def __init__(self, function, k):
        functools.update_wrapper(self, function)
        self.function, self.k = function, k

    def __call__(self, x):
        return self.k * self.function(x)


def decorated(k):
    def decorator(function):
        @wraps(function)
        def wrapped(x):
            return k * function(x)

        return wrapped

    return decorator(lambda x: x)


def of_class(k):
    """Return a class with all kinds of members, which depend on k."""

    class Own:
        level = k

        @classmethod
        def of(cls, x):
            return cls.level * x

        @staticmethod
        def alone(x, scale=k):
            return scale * x

    return Own


def kinds_of(k):
    @dataclass(frozen=True)
    class Frozen:
        level: float = k

    class Kind(Enum):
        LOW = 0.0
        HIGH = k

    return Frozen, Kind


def dispatched(k):
    @singledispatch
    def function(x):
        return k * x

    @function.register
    def _(x: str):
        return x

    return function


def managed(k):
    @contextmanager
    def function(x):
        yield k * x

    return function


def derived(k):
    function = jax.custom_jvp(lambda x: x)
    function.defjvp(lambda primals, tangents: (primals[0], k * tangents[0]))
    return function


def model(k):
    def function(awareness, contact_rate=None):
        with numpyro.plate("mission", 2):
            return numpyro.sample("weight", dist.Normal(0.0, k))

    return function


def closed(value):
    return lambda x: value


def fitted(estimator, k):
    return estimator.fit(np.arange(6.0)[:, None], k * np.arange(6.0) ** 2)


def by_source(k):
    """Return functions of a module that was written, or written anew and reloaded, with k."""
    package = Path(_FOLDER, "package_of_mine")
    package.mkdir(exist_ok=True)
    (package / "__init__.py").touch()
    for name, text in (
        ("helpers_of_mine", HELPERS),
        ("package_of_mine.lower", HELPERS),
        ("mine", CODE),
    ):
        Path(_FOLDER, f"{name.replace('.', '/')}.py").write_text(text.format(k=k))
        importlib.invalidate_caches()
        module = importlib.import_module(name)
        importlib.reload(module)
    kept = [one for one in vars(module).values() if getattr(one, "__module__", "") == "mine"]
    return {f"source {one.__name__}": one for one in kept}


def by_cell(k):
    """Return functions of the cells of a notebook."""
    shell = InteractiveShell.instance()
    shell.run_cell(CELL.format(k=k))
    return {name: shell.user_ns[name] for name in ("of_cell", "of_cells")}


def by_closure(k):
    frozen, kind = kinds_of(k)
    own = of_class(k)
    strided = np.arange(12.0).reshape(3, 4).T[::2] * k
    return {
        "closure": closed(k),
        "closure of closures": closed(closed(k)),
        "closure of a set": closed({"a", "b", k}),
        "closure of a dict": closed({"a": k, "b": {"c": {1, 2}}}),
        "closure of arrays": closed([np.full(3, k), strided]),
        "closure of a table": closed(pd.DataFrame({"a": [1.0, k], "b": ["x", "y"]})),
        "closure of xarray": closed(xr.DataArray([1.0, k], {"x": ["a", "b"]}, "x")),
        "closure of a sparse matrix": closed(sparse.csr_array(np.diag([1.0, k]))),
        "partial": partial(closed, k),
        "partial by keyword": partial(closed, value=k),
        "partial of partial": partial(partial(max, 0.5), k),
        "method": Method(k).method,
        "callable object": Method(k),
        "slots": Slotted(k),
        "dataclass": Data(k),
        "frozen dataclass": frozen(),
        "named tuple": closed(Named(k)),
        "enum": closed(kind.HIGH),
        "class": own,
        "class method": own.of,
        "static method": own.alone,
        "decorated": decorated(k),
        "decorator object": Decorator(abs, k),
        "lru_cache": lru_cache(maxsize=8)(closed(k)),
        "singledispatch": dispatched(k),
        "contextmanager": managed(k),
        "frozen norm": norm(0.0, k),
        "method of a frozen norm": norm(0.0, k).ppf,
        "partial of norm": partial(norm.ppf, loc=k),
        "ufunc of scipy": partial(special.expit, k),
        "interpolator": interpolate.PchipInterpolator([0.0, 1.0, 2.0], [0.0, k, 4.0]),
        "kernel density": stats.gaussian_kde([0.0, 1.0, 3.0 * k]),
        "partial of numpy.random": partial(np.random.normal, scale=k),
        "partial of random": partial(random.uniform, b=k),
        "generator": closed(np.random.default_rng(int(k))),
        "method of a generator": np.random.default_rng(int(k)).normal,
        "vectorize": np.vectorize(closed(k)),
        "polynomial": np.polynomial.Polynomial([0.0, k]),
        "estimator": closed(Ridge(alpha=k)),
        "fitted estimator": fitted(LinearRegression(), k).predict,
        "pipeline": fitted(make_pipeline(StandardScaler(), Ridge(alpha=k)), 1.0).predict,
        "Gaussian process": fitted(GaussianProcessRegressor(RBF(), alpha=k), 1.0).predict,
        "jit": jax.jit(closed(k)),
        "vmap": jax.vmap(closed(k)),
        "grad": jax.grad(lambda x: k * x),
        "custom_jvp": derived(k),
        "key": closed(jax.random.key(int(k))),
        "array of JAX": closed(jnp.full(2, k)),
        "distribution": closed(dist.TruncatedNormal(0.0, k, low=0.0)),
        "numpyro function": handlers.seed(model(k), 0),
        "handler": handlers.condition(model(1.0), {"weight": k}),
        "njit": numba.njit(lambda x: k * x),
        "numba.vectorize": numba.vectorize(lambda x: k * x),
    }


def functions(k):
    return by_source(k) | by_cell(k) | by_closure(k)


def use(function):
    """Call a function, and what it encloses, which may fill caches."""
    for part in (
        function,
        *(cell.cell_contents for cell in getattr(function, "__closure__", 0) or ()),
    ):
        for argument in (2.0, np.full((2, 1), 0.5), "text"):
            try:
                part(argument)
            except Exception:  # it takes something else
                continue
        for name in ("describe", "sum", "mean", "log_prob", "tocoo", "squared", "normal", "cdf"):
            try:
                getattr(part, name)()
            except Exception:
                continue
        if isinstance(part, dist.Distribution):
            part.log_prob(1.0)
        str(part)


def sent(function):
    """Return a function as another process gets it; some cannot be sent."""
    try:
        return cloudpickle.loads(cloudpickle.dumps(function))
    except (AttributeError, TypeError):
        return function


def hashes():
    """Return the hashes of each function, by name.

    These are before and after use, as a worker gets it, made anew, and with another k.
    """
    made = functions(2.0)
    found = {name: [fingerprint(one)] for name, one in made.items()}
    for name, one in made.items():
        use(one)
        found[name].append(fingerprint(one))
        found[name].append(fingerprint(sent(one)))
    for k in (2.0, 3.0):
        for name, one in functions(k).items():
            found[name].append(fingerprint(one))
    return found


def hashes_of_edited_cells():
    """Return the hashes of a function whose cell is run as it is, and with changes around it."""
    cell = CELL.format(k=2.0)
    plain = cell.replace("(x: float) -> float", "(x)").replace('"Documented."', "pass")
    edited = (
        f"%%time\n{cell}", f"%%capture\n{cell}", f"\n# Comment\n{cell}\nof_cell(1.0)",
        cell.replace("import numpy as np\n", ""), plain,
    )  # fmt: skip
    found = []
    for text in (cell, *edited):
        InteractiveShell.instance().run_cell(text)
        found.append(fingerprint(InteractiveShell.instance().user_ns["of_cell"]))
    return found


with tempfile.TemporaryDirectory() as _FOLDER:
    if __name__ == "__main__":
        sys.path.insert(0, _FOLDER)
        sys.dont_write_bytecode = True
        sys.stdout.write("\n" + json.dumps([hashes(), hashes_of_edited_cells()]))
