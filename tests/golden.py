"""Seeded campaigns whose history, paths and posteriors a change of form must leave as they are.

Run by hand, on one machine, before and after such a change:

    python tests/golden.py write out/before.json [campaign ...]
    python tests/golden.py compare out/before.json [campaign ...]

`compare` prints for each campaign whether all numbers are bit-identical, else the largest relative
difference. `tests/test_golden.py` compares a few of the exact sampler, which take seconds, with
`golden.json`, which `python tests/golden.py write tests/golden.json` renews: paths, objectives and
posterior means with their Monte Carlo standard errors.
"""

import hashlib
import json
import sys
import warnings
from pathlib import Path

import numpy as np

import trustbo as tb

STORED = Path(__file__).parent / "golden.json"
EXACT = {
    "pooled": {},
    **{f"policy {name}": {"policy": name} for name in tb.planning.POLICIES},
    **{f"objective {name}": {"objective": name} for name in tb.planning.OBJECTIVES},
    "objective lost_contact": {"objective": "lost_contact", "planner": {"failure_cost": 0.0}},
    "places": {
        "objective": "lost_contact",
        "policy": "optimistic",
        "model": ("PooledTrust", {"effects": (tb.models.PlaceEffect(),)}),
        "bounds": True,
        "planner": {"failure_cost": 0.0},
    },
    "prior mean": {"initial": "prior_mean"},
    "bounds": {"initial": "prior_mean", "bounds": True},
}
NUTS = {
    "pooled nuts": {"sampler": "nuts"},
    "pooled censored": {"model": ("PooledTrust", {"family": "censored"})},
    "pooled beta_binomial": {"model": ("PooledTrust", {"family": "beta_binomial"})},
    "hierarchical": {"model": ("HierarchicalTrust", {})},
    "hierarchical beta_binomial": {"model": ("HierarchicalTrust", {"family": "beta_binomial"})},
    "coupled full": {"model": ("CoupledTrust", {})},
}

FEW = (
    "pooled", "policy ucb", "objective terminal", "objective lost_contact", "bounds", "places"
)  # fmt: skip


def campaign(options: dict, *, sampler: str, n_iterations: int) -> dict:
    """Numbers of one seeded campaign."""
    terrain = tb.terrain.synthetic_terrain(size=(150.0, 150.0), resolution=2.0, seed=3)
    options, team = dict(options), tb.Team(n_robots=2)
    bounds = options.pop("bounds", False)
    workspace = tb.Workspace.from_terrain(terrain, (5, 5), team, bounds=bounds)
    name, fields = options.pop("model", ("PooledTrust", {}))
    paper = {"policy": "greedy", "objective": "mean", "initial": "prior_draw"}
    options = {"sampler": sampler} | paper | options
    result = tb.iterate(
        workspace,
        (4, 0),
        (0, 4),
        model=getattr(tb.models, name)(**fields),
        n_iterations=n_iterations,
        seed=5,
        progress=False,
        **options,
    )
    history = result.history
    found = {
        "path": history["path"].values.tolist(),
        "recommended": [list(cell) for cell in result.path],
        "trust_map": np.nan_to_num(history["trust_map"].values, nan=-9.0).tolist(),
        "final": np.nan_to_num(result.trust_map.values, nan=-9.0).tolist(),
        "value": float(result.plan().value),
    }
    found |= {name: history[name].values.tolist() for name in ("objective", "contact_rate")}
    for group in ("posterior", "latent", "log_likelihood", "posterior_predictive"):
        if group not in result.posterior.children:  # of weighted missions: another name
            continue
        for name, array in sorted(result.posterior[group].to_dataset().data_vars.items()):
            values = np.ascontiguousarray(np.nan_to_num(array.values, nan=-9.0))
            found[f"{group} {name}"] = float(values.mean())
            if group == "posterior":  # draws of the importance sampler are nearly independent
                of_draws = values.reshape(values.shape[0] * values.shape[1], -1).mean(1)
                found[f"{group} {name} se"] = float(of_draws.std() / np.sqrt(len(of_draws)))
            found[f"{group} {name} bits"] = hashlib.sha256(values.tobytes()).hexdigest()
    return found


def record(name: str) -> dict:
    """Numbers of the campaign of that name."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if name in EXACT:
            return campaign(EXACT[name], sampler="importance", n_iterations=3)
        try:
            return campaign(NUTS[name], sampler="nuts", n_iterations=2)
        except tb.PosteriorError as error:
            return {"refused": str(error)}


def kept(found: dict) -> dict:
    """Numbers of a campaign that another processor has too, up to rounding and resampled draws."""
    names = ("path", "recommended", "objective", "value", "contact_rate")
    return {
        key: value
        for key, value in found.items()
        if key in names or (key.startswith("posterior ") and not key.endswith("bits"))
    }


def record_few() -> dict[str, dict]:
    """Campaigns of the test."""
    return {name: kept(record(name)) for name in FEW}


def largest_difference(one: dict, other: dict) -> float:
    """Largest relative difference of all numbers; infinite where the shapes or paths differ."""
    worst = 0.0
    if one.keys() != other.keys():
        return np.inf
    for name, value in one.items():
        if name.endswith("bits") or isinstance(value, str):
            continue
        a, b = np.asarray(value, dtype=float), np.asarray(other[name], dtype=float)
        if a.shape != b.shape or (name in ("path", "recommended") and (a != b).any()):
            return np.inf
        worst = max(worst, float((np.abs(a - b) / np.maximum(np.abs(a), 1.0)).max(initial=0.0)))
    return worst


def main() -> None:
    """Write or compare a file of golden campaigns."""
    command, file = sys.argv[1], Path(sys.argv[2])
    if command == "write" and file.resolve() == STORED:
        lines = ",\n".join(f"{json.dumps(n)}: {json.dumps(e)}" for n, e in record_few().items())
        file.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
        return
    if command == "write":
        file.parent.mkdir(parents=True, exist_ok=True)
        found = {}
        for name in sys.argv[3:] or [*EXACT, *NUTS]:
            found[name] = record(name)
            file.write_text(json.dumps(found, indent=0) + "\n", encoding="utf-8")
            print(name, flush=True)
        return
    for name, expected in json.loads(file.read_text(encoding="utf-8")).items():
        if sys.argv[3:] and name not in sys.argv[3:]:
            continue
        found = record(name)
        same = found == expected
        off = 0.0 if same else largest_difference(expected, found)
        print(f"{name:30s} {'bit-identical' if same else f'differs by {off:.1e}'}", flush=True)


if __name__ == "__main__":
    main()
