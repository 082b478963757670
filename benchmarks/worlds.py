"""The open benchmark: the tables of docs/worlds.md, in Markdown.

    python benchmarks/worlds.py --data DIR --out out/worlds

All worlds x 4 courses x methods, 15 missions each; called again, it goes on where it stopped.
BoTorch is left out where it is not installed.
`--targets` runs the objective and path class of the targets instead, mean contact on shortest+2.
"""

from importlib.util import find_spec

import numpy as np
from baselines.botorch import PathBandit
from common import arguments, parsed

from trustbo.study import run_worlds, worlds_table
from trustbo.study.table import as_text

RIGHT, WRONG = ("right", "bare", "slopes"), ("aged", "canopy")


def main():
    parser = arguments(
        __doc__, data=True, seeds=1, out="out/worlds", quick="three small worlds, 3 missions"
    )
    parser.add_argument("--objective", default="lost_contact")
    parser.add_argument("--max-bounds", default="shortest+4")
    parser.add_argument("--policy", nargs="*", default=["optimistic"])
    parser.add_argument("--model", nargs="*", default=["places"])
    parser.add_argument("--targets", action="store_true")
    given = parsed(parser)
    objective, max_bounds = given.objective, given.max_bounds
    if given.targets:
        objective, max_bounds = "mean", "shortest+2"
    methods = {"BoTorch": PathBandit} if find_spec("botorch") else {}
    results = run_worlds(
        given.out, data=given.data, methods=methods, policies=given.policy, models=given.model,
        seeds=given.seeds,
        objective=objective, max_bounds=max_bounds, quick=given.quick, executor="loky",
    )  # fmt: skip
    kinds = results["kind"].values
    for title, chosen in (
        ("all worlds", np.ones(len(kinds), bool)),
        ("the assumed sight mode is right", np.isin(kinds, RIGHT)),
        ("an old DSM, or a wrong canopy", np.isin(kinds, WRONG)),
        ("wall", kinds == "wall"),
    ):
        if chosen.any():
            n = len(np.unique(results["world"].values[chosen]))
            print(f"\n{title} ({n} worlds), {objective}, {max_bounds}\n")
            print(as_text(worlds_table(results.isel(run=chosen))))
    print("\nby kind and method\n")
    print(as_text(worlds_table(results, ["kind", "method"])))


if __name__ == "__main__":
    main()
