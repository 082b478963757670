"""Hashes of functions, cases and scenes: what changes them, and what does not."""

import json
import os
import subprocess
import sys
import threading
from functools import cached_property, lru_cache, partial
from pathlib import Path

import cloudpickle
import identities
import jax
import jax.numpy as jnp
import numba
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.handlers import reparam

import trustbo as tb
from trustbo.identity import fingerprint, record_of
from trustbo.inference.functions.known import as_model, model_of_record
from trustbo.models import ContactRate, PooledTrust, TrustParams

CODE = """
import functools

LIMIT = 1.0

def helper(x):  # {comment}
    return x + {added}

def case(scene, names=frozenset({{"a", "b", "c"}})):
    inner = lambda: helper(LIMIT) in {{"d", "e", "f"}}
    return {{"policy": inner, "names": names}}
"""


def defined(comment="", added=1, **others):
    """Function of another module of the user; `others` are values of its globals."""
    module = {"__name__": "mine"}
    exec(CODE.format(comment=comment, added=added), module)
    module.update(others)
    return module["case"]


class Policy:
    """Class of a user, with an attribute that is computed once."""

    limit = 1.0

    def __init__(self, weight=0.5):
        self.weight = weight

    @property
    def doubled(self):
        return 2.0 * self.weight

    @cached_property
    def squared(self):
        return self.weight**2

    def __call__(self, rng, draws, planner):
        return self.squared


@lru_cache
def cached(x):
    return x


def linear(awareness, contact_rate=None):
    a = numpyro.sample("a", dist.Normal())
    numpyro.sample("contact_rate", ContactRate(a * awareness, 0.5, 0.1, 0.1), obs=contact_rate)


def shaped(awareness, contact_rate=None, n=2):
    return awareness[..., :n, 0]


def test_comments_do_not_count_but_code_and_values_do():
    expected = fingerprint(defined())
    assert fingerprint(defined(comment="another\n    # one")) == expected
    others = [
        defined(added=2), defined(LIMIT=2.0), partial(defined(), names=()), lambda scene: {},
    ]  # fmt: skip
    assert len({expected, *map(fingerprint, others)}) == 5


def test_functions_of_other_modules_of_the_user_count():
    def closed(helper):
        return lambda awareness, contact_rate=None: helper(awareness)

    expected = fingerprint(closed(defined()))
    assert fingerprint(closed(defined(comment="another"))) == expected
    assert fingerprint(closed(defined(added=2))) != expected
    assert fingerprint(closed(defined(LIMIT=2.0))) != expected


def test_functions_that_call_themselves_and_each_other_have_a_fingerprint():
    def one(n):
        return other(n - 1) if n else one(0)

    def other(n):
        return one(n)

    assert fingerprint(one) != fingerprint(other)


@pytest.mark.parametrize(
    "value",
    [
        Policy(), tb.models.PooledTrust(), {"b": 1, "a": {2.0, 3.0}}, jax.jit(defined()), jnp.tanh,
        jax.random.key(0), np.arange(3), cached, tb.terrain, partial(Policy, weight=1.0),
        jax.nn.relu, jax.vmap(jnp.tanh), jnp.vectorize(jnp.tanh), dist.LogNormal(0.0, 1.0),
        numba.njit(defined()),
    ],
)  # fmt: skip
def test_options_of_all_kinds_have_a_fingerprint(value):
    assert fingerprint(value) == fingerprint(value)


def test_objects_differ_by_their_values_and_by_their_class(monkeypatch):
    expected = fingerprint(Policy())
    assert fingerprint(Policy(0.6)) != expected
    members = {
        "limit": 2.0,
        "doubled": property(lambda self: self.weight),
        "squared": cached_property(lambda self: self.weight),
        "__call__": lambda self, rng, draws, planner: 0.0,
    }
    for name, member in members.items():
        with monkeypatch.context() as patch:
            patch.setattr(Policy, name, member)
            assert fingerprint(Policy()) != expected
    assert fingerprint(Policy()) == expected


@pytest.mark.parametrize("wrapped", [jax.vmap, jax.jit, jax.custom_jvp, numba.njit, lru_cache])
def test_functions_of_packages_differ_by_the_values_that_they_enclose(wrapped):
    expected = fingerprint(wrapped(defined()))
    assert fingerprint(wrapped(defined(comment="another"))) == expected
    assert fingerprint(wrapped(defined(added=2))) != expected


def test_rules_of_derivatives_count():
    def of(slope):
        function = jax.custom_jvp(lambda x: x)
        function.defjvp(lambda primals, tangents: (primals[0], slope * tangents[0]))
        return function

    assert fingerprint(of(1.0)) == fingerprint(of(1.0)) != fingerprint(of(2.0))


def test_objects_stay_the_same_when_they_are_used():
    """Workspaces and distributions cache properties, numba compiles, and xarray has accessors."""
    prior = dist.TruncatedNormal(0.0, 1.0, low=0.0)
    compiled = numba.njit(lambda x: x + 1.0)
    policy, workspace = Policy(), tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))

    def used(awareness, contact_rate=None):
        return prior, compiled, policy, workspace

    before = fingerprint(used)
    prior.log_prob(1.0)
    assert compiled(1.0) == 2.0
    assert policy.squared == 0.25
    planner = tb.Planner(workspace, (2, 0), (0, 2))
    planner.plan(TrustParams(0.4, np.array([0.2, 0.2]), 0.0, 0.1, 0.1))
    assert fingerprint(used) == before

    other = tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.6))
    assert fingerprint(other) != fingerprint(workspace)


def test_parts_of_objects_are_told_by_class():
    class Counted:
        def __init__(self, missions, n_used=0):
            self.missions, self.n_used = missions, n_used

    def of(*arguments):
        parts = {Counted: lambda one: one.missions}
        return fingerprint({"one": [Counted(*arguments)], "other": {Counted(*arguments)}}, parts)

    assert of([1, 2]) == of([1, 2], 3) != of([1])


def test_what_pickle_refuses_is_told_by_its_class():
    expected = fingerprint({"policy": threading.Lock()})
    assert fingerprint({"policy": threading.Lock()}) == expected
    assert fingerprint({"policy": threading.RLock()}) != expected


def scaled(scale):
    def model(awareness, contact_rate=None):
        a = numpyro.sample("a", dist.Normal(0.0, scale))
        rates = ContactRate(a + awareness[..., 0], 0.5, 0.1, 0.1)
        numpyro.sample("contact_rate", rates, obs=contact_rate)

    return model


def test_constants_are_those_of_all_functions_that_are_called():
    def helper(x, scale=2.0):
        return scale * x + GLOBAL

    def outer(awareness, contact_rate=None):
        return helper(awareness)

    before = record_of(outer)["constants"]
    assert set(before) == {"contact_rate", "scale", "GLOBAL"}
    helper.__defaults__ = (3.0,)
    after = record_of(outer)["constants"]
    assert [name for name in before if before[name] != after[name]] == ["scale"]


GLOBAL = 1.0


def test_a_fingerprint_tells_functions_apart_but_not_their_comments():
    assert fingerprint(scaled(1.0)) == fingerprint(scaled(1.0))
    assert fingerprint(scaled(1.0)) != fingerprint(scaled(2.0))
    assert fingerprint(linear) != fingerprint(shaped)
    assert fingerprint(PooledTrust().program) != fingerprint(
        PooledTrust(memory="deviation").program
    )
    assert fingerprint(partial(shaped, n=3)) != fingerprint(partial(shaped, n=2))
    assert as_model(linear) is as_model(linear)


def closed(*values):
    return lambda awareness, contact_rate=None: values


def inner(awareness, contact_rate=None):
    return jax.vmap(lambda z: SCALES["slope"] * z)(awareness)


def jitted(factor):
    return jax.jit(lambda awareness, contact_rate=None: factor * awareness)


class Callable:
    def __init__(self, n):
        self.n = n

    def __call__(self, awareness, contact_rate=None):
        return self.n


def first_wrapped(awareness, contact_rate=None):
    return awareness + 1.0


def second_wrapped(awareness, contact_rate=None):
    return awareness + 2.0


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (closed(1, 2, 1), closed(1, 2, 2)),
        (closed(dist.Normal(0.0, 1.0)), closed(dist.Normal(0.0, 2.0))),
        (closed(lambda x: x), closed(lambda x: 2.0 * x)),
        (partial(shaped, n=max), partial(shaped, n=min)),
        (partial(shaped, a=lambda x: x), partial(shaped, b=lambda x: x)),
        (jitted(1.0), jitted(2.0)),
        (Callable(1), Callable(2)),
        (reparam(config={})(first_wrapped), reparam(config={})(second_wrapped)),
        (reparam(first_wrapped, config={}), reparam(second_wrapped, config={})),
    ],
)
def test_a_fingerprint_contains_what_a_function_refers_to(one, other):
    assert fingerprint(one) != fingerprint(other)


SCALES = {"slope": 1.0}
PRIOR = dist.Normal(0.0, 1e-3)


def with_global_prior(awareness, contact_rate=None):
    a = numpyro.sample("a", PRIOR)
    rates = ContactRate(a + 0.0 * awareness[..., 0], 0.4, 0.05, 0.05)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


class Saturating:
    """A function with a setting beside attributes that cannot be pickled."""

    def __init__(self, steepness):
        self.steepness = steepness
        self.link = jnp.tanh
        self.lock = threading.Lock()
        self.own = self

    def __call__(self, awareness, contact_rate=None):
        return self.link(self.steepness * awareness)

    def method(self, awareness, contact_rate=None):
        return self(awareness)


class Slotted:
    __slots__ = ("link", "steepness")

    def __init__(self, steepness):
        self.steepness = steepness
        self.link = jnp.tanh

    def __call__(self, awareness, contact_rate=None):
        return self.link(self.steepness * awareness)


@pytest.mark.parametrize(
    "of",
    [Saturating, Slotted, lambda steepness: Saturating(steepness).method],
    ids=["call", "slots", "method"],
)
def test_attributes_that_cannot_be_pickled_do_not_hide_the_others(of):
    assert fingerprint(of(1.0)) == fingerprint(of(1.0)) != fingerprint(of(20.0))


def with_link(power):
    class Link:
        def __call__(self, x):
            return x**power

    return lambda awareness, contact_rate=None: Link()(awareness)


def test_a_class_of_the_same_module_that_changes_changes_the_fingerprint():
    assert fingerprint(with_link(1)) == fingerprint(with_link(1)) != fingerprint(with_link(2))


def halved(x, n):
    return halved(0.5 * x, n - 1) if n else x


def test_a_function_that_calls_itself_has_a_fingerprint(monkeypatch):
    before = fingerprint(halved)
    assert fingerprint(halved) == before
    monkeypatch.setattr(halved, "__defaults__", (3,))
    assert fingerprint(halved) != before


def test_an_object_that_changes_changes_its_fingerprint():
    model = Saturating(1.0)
    before = fingerprint(model)
    model.steepness = 20.0
    assert fingerprint(model) != before
    model.steepness = 1.0
    model.link = jnp.sin
    assert fingerprint(model) != before


def test_globals_that_change_change_the_fingerprint(monkeypatch):
    before = fingerprint(inner), fingerprint(with_global_prior)
    monkeypatch.setitem(SCALES, "slope", 2.0)
    assert fingerprint(inner) != before[0]

    model = as_model(with_global_prior)
    monkeypatch.setitem(globals(), "PRIOR", dist.Normal(0.0, 1.0))
    assert fingerprint(with_global_prior) != before[1]
    assert as_model(with_global_prior) is not model  # not what was compiled with the old prior


def test_many_kinds_of_functions_are_told_apart_in_all_processes():
    """Before and after use, and made anew; and variants with another value are others."""
    command = [sys.executable, "-W", "ignore", str(Path(identities.__file__))]
    runs = []
    for seed in ("1", "2"):
        space = os.environ | {"PYTHONHASHSEED": seed}
        run = subprocess.run(command, capture_output=True, text=True, check=True, env=space)
        runs.append(json.loads(run.stdout.splitlines()[-1]))

    (first, cells), (second, _) = runs
    assert len(set(cells)) == 1  # whatever else is in a cell
    assert len(first) >= 80
    for name, (before, after, sent, anew, variant) in first.items():
        assert before == after == anew != variant, name
        assert sent == before, name
        assert second[name] == first[name], name
    assert len({before for before, *_ in first.values()}) >= len(first) - 2  # norm and its partials


SOURCE = """
def own(x, scale=2.0):
    def inner(y):
        return y + scale
    total = inner(x) * (x + scale) - (x if x > 1.0 else scale)
    try:
        return total / x
    except ZeroDivisionError:
        return helper(total, scale)
def helper(x, y):
    return x * y + 0.5
"""


def compiled(source, name="own", file="<made>"):
    space = {"__name__": "mine"}
    exec(compile(source, file, "exec"), space)
    return space[name]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("def own(x, scale=2.0):", "def own(x: float, scale: float = 2.0) -> float:"),
        ("def own(x, scale=2.0):", 'def own(x, scale=2.0):\n    """Text."""'),
        ("        return y + scale", '        "Text."\n        return y + scale'),
        ("def inner(y):", "def inner(y: 'float' = None or 1.0) -> dict[str, float]:"),
        ("def inner(y):", "def inner(y: float) -> list[int]:"),
        ("total = inner(x)", "total: float = inner(x)"),
        ("inner(x) * (x + scale)", "inner(\n        x  # comment\n    ) * (x +\n  scale)"),
        ("return helper(total, scale)", "return helper(\n            total,\n  scale,\n  )"),
        ("def helper(x, y):", 'def helper(x: int, y: "int"):\n    "Text."\n\n'),
        ("\ndef own", "\n\n\n# Comment\n\ndef own"),
        ("0.5", "0.50"),
        ("    try:", "    pass\n    try:"),
    ],
)
def test_annotations_docstrings_and_layout_do_not_count(old, new):
    assert old in SOURCE
    changed = SOURCE.replace(old, new)
    if "None or" in new:  # a default, which counts
        assert fingerprint(compiled(changed)) != fingerprint(compiled(SOURCE))
    else:
        assert fingerprint(compiled(changed, file="<other>")) == fingerprint(compiled(SOURCE))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("x > 1.0", "x >= 1.0"), ("y + scale", "y - scale"), ("ZeroDivisionError", "ValueError"),
        ("(total, scale)", "(scale, total)"), ("(total, scale)", "(total, y=scale)"),
        ("x * y + 0.5", "x * y + 0.25"), ("(x, scale=2.0)", "(x, *, scale=2.0)"),
        ("(x, scale=2.0)", "(x, scale=2)"), ("def helper(x, y)", "def helper(y, x)"),
        ("total / x", "total // x"), ("        return total / x", "        return -total / x"),
        ("def own(x, scale", "def own(x, *others, scale"),
    ],
)  # fmt: skip
def test_code_counts(old, new):
    assert old in SOURCE
    assert fingerprint(compiled(SOURCE.replace(old, new))) != fingerprint(compiled(SOURCE))


def test_a_debugger_and_specialised_code_do_not_count():
    function = compiled(SOURCE)
    before = fingerprint(function)
    for _ in range(100):
        function(2.0)
    traced = sys.gettrace()
    sys.settrace(lambda *_: None)
    function(2.0)
    sys.settrace(traced)
    assert fingerprint(compiled(SOURCE)) == before == fingerprint(function)


def test_sharing_order_and_memory_do_not_count():
    array = np.arange(12.0).reshape(3, 4)
    shared = [array, array]
    assert fingerprint(shared) == fingerprint([array.copy(), np.asfortranarray(array)])
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    one, other = closed(1.0), closed(1.0)
    assert fingerprint([one, one]) == fingerprint([one, other])
    assert fingerprint([one, one]) == fingerprint(
        cloudpickle.loads(cloudpickle.dumps([one, other]))
    )
    assert fingerprint([array, array]) != fingerprint([array, array[::-1]])
    assert fingerprint(np.arange(3)) != fingerprint(np.arange(3.0))
    assert fingerprint([1, 2]) != fingerprint((1, 2)) != fingerprint([[1], 2])


def test_the_versions_of_libraries_count_and_are_recorded(monkeypatch):
    def function(x):
        return jnp.tanh(x)

    before = record_of(function)
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert before["versions"] == {"python": python, "jax": jax.__version__}
    monkeypatch.setattr("trustbo.identity._installed", lambda library: "0.0")
    after = record_of(function)
    assert after["sha256"] != before["sha256"]
    assert after["versions"]["jax"] == "0.0"


def test_a_refusal_names_the_versions_that_differ():
    record = as_model(linear).record()
    other = record | {"sha256": "0" * 16, "versions": record["versions"] | {"python": "3.99"}}
    with pytest.raises(tb.TrustboError, match="python"):
        model_of_record(other, linear)
    assert model_of_record(record, linear) is as_model(linear)


def test_a_fingerprint_tells_random_keys_apart():
    keys = [jax.random.key(0), jax.random.key(1)]
    assert fingerprint(closed(keys[0])) != fingerprint(closed(keys[1]))
    seeded = [numpyro.handlers.seed(first_wrapped, key) for key in keys]
    assert fingerprint(seeded[0]) != fingerprint(seeded[1])
