"""Hashes of cases and scenes: what changes them, and what does not."""

import os
import subprocess
import sys
import threading
from functools import cached_property, lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.study.identity import identity_of

CODE = """
import functools

LIMIT = 1.0

def helper(x):  # {comment}
    return x + {added}

def case(scene, names=frozenset({{"a", "b", "c"}})):
    inner = lambda: helper(LIMIT) in {{"d", "e", "f"}}
    return {{"policy": inner, "names": names}}
"""


def identity(value):
    return identity_of("one", value)


def defined(comment="", added=1, **others):
    """Function of a module that is written as told; `others` are values of its globals."""
    module = {"__name__": "mine"}
    exec(CODE.format(comment=comment, added=added), module)
    module.update(others)
    return module["case"]


class Policy:
    """Class of a user, with an attribute that is computed once."""

    limit = 1.0

    def __init__(self, weight=0.5):
        self.weight = weight

    @cached_property
    def squared(self):
        return self.weight**2

    def __call__(self, rng, draws, planner):
        return self.squared


@lru_cache
def cached(x):
    return x


def test_comments_do_not_count_but_code_and_values_do():
    expected = identity(defined())
    assert identity(defined(comment="another\n    # one")) == expected
    others = [
        defined(added=2), defined(LIMIT=2.0), partial(defined(), names=()), lambda scene: {},
    ]  # fmt: skip
    assert len({expected, *map(identity, others)}) == 5
    assert identity_of("two", defined()) != expected


def test_functions_that_call_themselves_and_each_other_have_an_identity():
    def one(n):
        return other(n - 1) if n else one(0)

    def other(n):
        return one(n)

    assert identity(one) != identity(other)


@pytest.mark.parametrize(
    "value",
    [
        Policy(), tb.models.PooledTrust(), {"b": 1, "a": {2.0, 3.0}}, jax.jit(defined()), jnp.tanh,
        jax.random.key(0), np.arange(3), cached, tb.terrain, partial(Policy, weight=1.0),
        jax.nn.relu, jax.vmap(jnp.tanh), jnp.vectorize(jnp.tanh), dist.LogNormal(0.0, 1.0),
    ],
)  # fmt: skip
def test_options_of_all_kinds_have_an_identity(value):
    assert identity(value) == identity(value)


def test_objects_differ_by_their_values_and_by_their_class(monkeypatch):
    expected = identity(Policy())
    assert identity(Policy(0.6)) != expected
    with monkeypatch.context() as patch:
        patch.setattr(Policy, "limit", 2.0)
        assert identity(Policy()) != expected
    monkeypatch.setattr(Policy, "__call__", lambda self, rng, draws, planner: 0.0)
    assert identity(Policy()) != expected


def test_functions_of_packages_differ_by_the_values_that_they_enclose():
    assert identity(jax.vmap(defined())) != identity(jax.vmap(defined(added=2)))


def test_objects_stay_the_same_when_they_are_used():
    policy, workspace = Policy(), tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))
    before = identity([policy, workspace])
    assert policy.squared == 0.25
    tb.planning.Planner(workspace, (2, 0), (0, 2))
    assert identity([policy, workspace]) == before


def test_values_that_cannot_be_compared_are_refused():
    with pytest.raises(TrustboError, match="'one'"):
        identity({"policy": threading.Lock()})


@pytest.mark.slow  # processes that import JAX
def test_an_identity_is_the_same_in_other_processes():
    code = f"{CODE.format(comment='', added=1)}\nfrom trustbo.study.identity import identity_of\n"
    code += "print(identity_of('one', case))"
    found = {
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2", "3")
    }  # fmt: skip
    assert len(found) == 1
