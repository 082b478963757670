"""The three forms of `TrustParams`."""

import pickle

import numpy as np
import pytest

from trustbo import TrustboError, models
from trustbo.models import TrustParams

EYE = np.eye(2)
POOLED = {"beta0": 0.4, "beta": [0.1, 0.2, 0.3], "b": 0.1, "delta_w": 0.05, "delta_v": 0.05}
OF_ROBOTS = {name: np.stack([value, value]) for name, value in POOLED.items()}
COUPLED = {
    "B0": 0.3 * EYE,
    "B": np.zeros((3, 2, 2)),
    "b": [0.1, 0.2],
    "Delta_w": EYE,
    "Delta_v": EYE,
}
FORMS = {
    "pooled": TrustParams(**POOLED),
    "per robot": TrustParams(**OF_ROBOTS, per_robot=True),
    "coupled": TrustParams(**COUPLED),
    "draws of robots": TrustParams(**OF_ROBOTS, x0_mean=[0.4, 0.5], per_robot=True),
}


@pytest.mark.parametrize("form", FORMS)
def test_axes_of_arrays_are_those_of_the_form(form):
    params = FORMS[form]
    sizes = {"draw": params.n_draws, "robot": 2, "robot_": 2, "feature": 3}
    for name, array in params.arrays.items():
        assert array.shape == tuple(sizes[axis] for axis in ("draw", *params.dims.get(name, ())))

    assert params.per_robot == ("robot" in form)
    assert params.n_robots == (None if form == "pooled" else 2)
    assert params.n_features == 3


@pytest.mark.parametrize("form", FORMS)
def test_arguments_and_pickles_make_the_same_parameters(form):
    params = FORMS[form].replace(robots=["r1", "r2"], features=["a", "b", "c"])
    copies = [params.replace(), pickle.loads(pickle.dumps(params))]
    for copy in copies:
        assert repr(copy) == repr(params)
        assert copy.arguments.keys() == params.arguments.keys()
        np.testing.assert_equal(copy.arguments, params.arguments)


def test_robots_are_put_in_order():
    b = np.array([0.1, 0.2])
    for form in ("per robot", "coupled"):
        params = FORMS[form].replace(b=b, robots=["r1", "r2"], features=["a", "b", "c"])
        ordered = params.in_order(["r2", "r1"], ["c", "a", "b"])
        np.testing.assert_array_equal(ordered.b, [b[::-1]])


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({}, "missing: beta0, beta, b, delta_w, delta_v"),
        ({**POOLED, "beta": None}, "missing: beta"),
        ({**COUPLED, "b": None}, "missing: b"),
        ({**POOLED, "B0": EYE}, "not of this form: B0"),
        ({**COUPLED, "beta0": 0.4, "delta_s": 0.1}, "not of this form: beta0, delta_s"),
        ({**COUPLED, "Delta_v": None, "delta_v": 0.1}, "missing: Delta_v; not of this form: delta"),
        ({**COUPLED, "per_robot": True}, "not of this form: per_robot"),
        ({**COUPLED, "memory": "deviation"}, "not of this form: memory"),
        ({**POOLED, "per_robot": "no"}, "per_robot"),
        ({**COUPLED, "Delta_w": -EYE}, "Delta_w"),
    ],
)
def test_arguments_that_fit_no_form_are_named(arguments, named):
    with pytest.raises(TrustboError, match=named):
        TrustParams(**arguments)


def test_former_names_still_work_and_warn():
    with pytest.warns(UserWarning, match="RobotParams is deprecated"):
        of_robots = models.RobotParams(*OF_ROBOTS.values(), x0_mean=0.4)
    with pytest.warns(UserWarning, match="CoupledParams is deprecated"):
        coupled = models.CoupledParams(*COUPLED.values(), 0.4, family="censored")

    expected = TrustParams(**OF_ROBOTS, x0_mean=0.4, per_robot=True)
    np.testing.assert_equal(of_robots.arguments, expected.arguments)
    expected = TrustParams(**COUPLED, x0_mean=0.4, family="censored")
    np.testing.assert_equal(coupled.arguments, expected.arguments)
