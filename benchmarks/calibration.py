"""Simulation-based calibration of every model, family and sampler; prints the table of the docs.

Run: python benchmarks/calibration.py [exact] [nuts] [--share 1] [--out out/calibration]

Ranks are kept in the folder after each data set: a run that was stopped goes on where it was.
"""

import sys

from common import Table, arguments, parsed, timed
from sbc_places import Walks

from trustbo.inference import sbc
from trustbo.inference.samplers.choice import why_not_scores
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    HumanTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
)

SMALL = (3, 6, 2, 2)  # missions, bounds, robots, features
LOG = (2, 40, 3, 1)  # missions of a log, trust carried over all of it
PEOPLE = (12, 5, 1, 2)  # persons, steps, tasks, success and failure


def cases():
    """Model, sampler, data sets, shape."""
    yield PooledTrust(), "exact", 1000, (4, 8, 3, 2)
    yield CoupledTrust(inter_robot="none"), "exact", 200, SMALL
    for observation in ("censored", "beta_binomial"):
        yield PooledTrust(observation=observation), "exact", 300, SMALL
        yield CoupledTrust(observation=observation, inter_robot="none"), "exact", 200, SMALL
        yield PooledTrust(observation=observation, place=PlaceEffect()), "exact", 200, SMALL
        yield HierarchicalTrust(observation=observation), "exact", 200, SMALL
    for observation in ("gaussian", "censored", "beta_binomial"):
        for places in ([], [PlaceEffect()]):
            effects = [*places, RobotEffect()]
            yield PooledTrust(effects=effects, observation=observation), "exact", 200, SMALL
        robots = {"effects": [RobotEffect()], "observation": observation}
        yield PooledTrust(memory="deviation", **robots), "exact", 200, LOG
    yield HierarchicalTrust(observation="beta_binomial"), "exact", 200, LOG
    yield HierarchicalTrust(), "exact", 300, SMALL
    yield CoupledTrust(), "exact", 200, SMALL
    yield PooledTrust(place=PlaceEffect()), "exact", 300, SMALL
    for scale in ("unit", "likert7", "ordinal7"):
        people = HumanTrust(scale=scale).for_features(("success", "failure"))
        yield people, "exact", 200, PEOPLE
    for model in (PooledTrust, HierarchicalTrust, CoupledTrust):
        yield model(), "nuts", 200, SMALL
    yield PooledTrust(place=PlaceEffect()), "nuts", 200, SMALL
    yield PooledTrust(effects=[RobotEffect()]), "nuts", 200, SMALL
    yield PooledTrust(effects=[PlaceEffect(), RobotEffect()]), "nuts", 200, SMALL


def main():
    parser = arguments(
        __doc__, names=("exact", "nuts"), out="out/calibration", quick="2 data sets each"
    )
    parser.add_argument("--only", default="", help="rows whose label has this text")
    parser.add_argument("--share", type=float, default=1.0, help="share of the data sets")
    given = parsed(parser)
    table = Table(
        "model", "observation", "sampler", "data sets", "refused", "parameters", "smallest p",
        "limit", "50 % interval", "90 % interval", "uniform",
    )  # fmt: skip
    for model, sampler, n, shape in cases():
        if sampler not in given.names:
            continue
        n = 2 if given.quick else max(2, round(n * given.share))
        name = type(model).__name__
        detail = getattr(model, "inter_robot", "full")
        effects = ["places"] * (model.place is not None) + ["robots"] * bool(model.effects)
        detail = " and ".join(effects) or detail
        detail = getattr(model, "scale", detail)
        label = name if detail == "full" else f"{name}, {detail}"
        if shape is LOG:
            detail, label = f"{detail}-log", f"{label}, of a log"
        if model.memory != "level" and not isinstance(model, HumanTrust):
            detail, label = f"{detail}-{model.memory}", f"{label}, memory of the {model.memory}"
        if given.only not in label:
            continue
        file = given.out / f"{name}-{detail}-{model.observation}-{sampler}.json"
        design = None if model.place is None else Walks.random(shape[:2], seed=0)
        options = {
            "design": design,
            "n_datasets": n,
            "shape": shape,
            "checkpoint": file,
            "max_refused": 0.05,
            "n_draws": 400 if why_not_scores(model) is None else 1000,
            "progress": False,
        }
        seconds, result = timed(
            lambda model=model, sampler=sampler, given=options: sbc(model, sampler, **given)
        )
        p, limit = float(result["p_value"].min()), 0.01 / result.sizes["parameter"]
        half, most = result["coverage"].mean("parameter").values
        levels = getattr(model, "scale", "unit") != "unit"
        family = "intervals" if levels else model.observation
        table.row(
            label, family, f"`{sampler}`", n, result.attrs["n_refused"],
            result.sizes["parameter"], f"{p:.4f}", f"{limit:.5f}", f"{half:.1%}", f"{most:.1%}",
            "not rejected" if p > limit else "REJECTED",
        )  # fmt: skip
        print(f"{label}: {seconds:.0f} s", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
