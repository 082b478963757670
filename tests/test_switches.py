"""Every boolean argument of the public API is True or False, or refused before anything happens."""

import inspect
import types

import jax.numpy as jnp
import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import TrustboError, require_switch

PARTS = [tb, *(part for name in dir(tb) if inspect.ismodule(part := getattr(tb, name)))]


def is_ours(thing):
    return str(getattr(thing, "__module__", "")).startswith("trustbo")


def switches_of(function):
    """Names of the boolean parameters of a function."""
    parameters = inspect.signature(function).parameters.values()
    return [one.name for one in parameters if one.annotation in (bool, "bool")]


def public_callables():
    """Names, functions and classes of the public parts; functions of classes with their class."""
    for part in PARTS:
        names = getattr(part, "__all__", [name for name in dir(part) if not name.startswith("_")])
        for name in names:
            thing = getattr(part, name)
            if inspect.isclass(thing) and issubclass(thing, Exception):
                continue
            if inspect.isclass(thing) and is_ours(thing):
                yield thing.__qualname__, thing, None
                for inner in (one for one in dir(thing) if not one.startswith("_")):
                    method = inspect.getattr_static(thing, inner)
                    function = getattr(method, "__func__", method)
                    if isinstance(function, types.FunctionType) and is_ours(function):
                        yield function.__qualname__, method, thing
            elif isinstance(thing, types.FunctionType) and is_ours(thing):
                yield thing.__qualname__, thing, None


def cases():
    found = {}
    for name, thing, owner in public_callables():
        function = getattr(thing, "__func__", thing)
        for switch in switches_of(function):
            found.setdefault((name, switch), (thing, owner))
    return found


CASES = cases()


def call(thing, owner, switch, value):
    """Call with a switch; other required arguments are placeholders, which nobody may use."""
    if isinstance(thing, classmethod):
        function = thing.__get__(None, owner)
    elif owner is not None:
        function = thing.__get__(object.__new__(owner))
    else:
        function = thing

    required = {
        one.name: True if one.annotation in (bool, "bool") else object()
        for one in inspect.signature(function).parameters.values()
        if one.default is one.empty and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    }
    returned = function(**required | {switch: value})
    if isinstance(returned, types.GeneratorType):
        next(returned)


@pytest.mark.parametrize(("name", "switch"), CASES, ids=map(".".join, CASES))
@pytest.mark.parametrize("value", ["False", "no", 0, 1.0, None, np.array([True])], ids=repr)
def test_a_switch_that_is_not_a_boolean_is_refused_first(name, switch, value):
    with pytest.raises(TrustboError, match=switch):
        call(*CASES[name, switch], switch, value)


def test_the_walk_finds_the_switches_that_delete_and_record():
    assert {("Campaign", "overwrite"), ("Campaign.tell", "again"), ("fit", "check")} <= {*CASES}
    assert len(CASES) > 40


@pytest.mark.parametrize("value", [np.True_, np.array(True), jnp.array(True), np.bool_(1)])
def test_booleans_of_numpy_and_jax_are_switches(value):
    assert require_switch("overwrite", value) is True


def test_a_text_as_a_switch_of_fits_is_refused_before_the_first_mission(tmp_path):
    workspace = tb.Workspace.from_awareness(np.full((2, 3, 3, 2), 0.5))
    with pytest.raises(TrustboError, match="check"):
        tb.Campaign(workspace, fit={"check": "no"}, directory=tmp_path / "campaign")
    assert not (tmp_path / "campaign").exists()
