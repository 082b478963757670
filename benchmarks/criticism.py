"""Size and power of criticise: is a planted fault named after 15 missions?

Run: python benchmarks/criticism.py [-n 100] [--quick] [--out FILE]

-n data sets of each fault; it goes on where the file, out/criticism.jsonl by default, ends.

Each data set is a synthetic workspace of 10 x 10 cells, 3 robots with awareness of their own, 15
missions of 11 bounds between two corners, and rates drawn from a pooled truth with one fault, or
none. PooledTrust() is fitted by the exact sampler and criticised. Columns: share of data sets in
which anything is found at level .05; in which the planted fault is the one that is named; median
seconds of criticise; and all names. Rates are clipped to [0, 1], which is rare.
"""

from collections import Counter

import numpy as np
from common import Table, add_record, arguments, parsed, read_records, timed
from scipy import ndimage

from trustbo import Mission
from trustbo.criticism import criticise
from trustbo.inference import fit
from trustbo.models import PooledTrust
from trustbo.models.place import matern

SHAPE, N_MISSIONS, N_ROBOTS = (10, 10), 15, 3
FEATURES = ("traversability", "visibility", "line_of_sight")
FAULTS = {
    "none": "none",
    "place": "place",
    "robot": "robot",
    "weights of a robot": "robot",
    "change": "change",
    "saturation": "curvature",
    "wrong sign": "prior",
    "correlated robots": "correlation",
    "correlated bounds": "correlation",
}
"""Name that criticise should find for each fault."""


def awareness_maps(rng):
    """Smooth fields in [0, 1] that robots share in part, (robot, row, col, feature)."""
    own, shared = (rng.standard_normal((n, *SHAPE, len(FEATURES))) for n in (N_ROBOTS, 1))
    field = ndimage.gaussian_filter(shared + 0.7 * own, (0, 1.0, 1.0, 0))
    ranks = field.reshape(N_ROBOTS, -1, len(FEATURES)).argsort(1).argsort(1)
    return (ranks / (SHAPE[0] * SHAPE[1] - 1)).reshape(field.shape)


def draw_path(rng):
    moves = np.array([(-1, 1)] * 7 + [(-1, 0)] * 2 + [(0, 1)] * 2)
    return [(9, 0), *map(tuple, np.array([9, 0]) + np.cumsum(rng.permutation(moves), axis=0))]


def draw_missions(fault, rng):
    """Missions of a truth with a fault."""
    maps, beta0 = awareness_maps(rng), rng.uniform(0.3, 0.6)
    slopes = np.array([*rng.uniform(-0.02, 0.12, 2), rng.uniform(0.5, 0.8)])
    if fault == "wrong sign":
        slopes[2] *= -1.0
    level = 0.5 - 0.5 * slopes.sum()
    dw, dv = rng.uniform(0.03, 0.07, 2)
    rows, cols = (each.ravel() for each in np.indices(SHAPE))
    K = matern(np.hypot(np.subtract.outer(rows, rows), np.subtract.outer(cols, cols)), 2.0)
    cells = 0.06 * np.linalg.cholesky(K + 1e-9 * np.eye(len(K))) @ rng.standard_normal(len(K))
    bounds = 0.06 * rng.standard_normal((3, 3, *SHAPE))
    odd, side = rng.integers(N_ROBOTS), rng.choice([-1.0, 1.0])
    missions = []
    for j in range(N_MISSIONS):
        path = draw_path(rng)
        z = np.array([maps[:, r, c] for r, c in path[1:]])
        response = z @ slopes + level
        if fault == "saturation":
            bent = np.minimum(z[..., 2], 0.5) * 1.5
            response = response + slopes[2] * (bent - z[..., 2])
        if fault == "weights of a robot":  # as of a poor detector
            response[:, odd] *= 0.7
        drift = (1.0 - beta0) * response
        if fault == "robot":
            drift[:, odd] += side * 0.06
        if fault == "change" and j >= 10:
            drift += side * 0.06
        x, rates = 0.5 + 0.15 * rng.standard_normal(N_ROBOTS), []
        v = rng.standard_normal(N_ROBOTS)
        for k in range(len(z)):
            (r0, c0), (r1, c1) = path[k], path[k + 1]
            w, shock = rng.standard_normal(N_ROBOTS), rng.standard_normal(2)
            new = rng.standard_normal(N_ROBOTS)
            v = 0.8 * v + 0.6 * new if fault == "correlated bounds" else new
            noise = v
            if fault == "correlated robots":
                w, noise = (np.sqrt(0.5) * (a + s) for a, s in zip((w, v), shock, strict=True))
            x = beta0 * x + drift[k] + dw * w
            if fault == "place":
                x = x + cells[r1 * SHAPE[1] + c1] + bounds[r1 - r0, c1 - c0, r1, c1]
            rates.append(x + dv * noise)
        rates = np.clip(rates, 0.0, 1.0)
        missions.append(Mission.from_arrays(path, z, rates, features=FEATURES))
    return missions


def main():
    """Run what is not in the file yet, data set by data set of all faults, and print shares."""
    given = parsed(arguments(__doc__, n=100, out="out/criticism.jsonl", quick="5 data sets each"))
    n = 5 if given.quick else given.n
    done = {(fault, seed): rest for fault, seed, *rest in read_records(given.out)}
    for seed in range(n):
        for fault in FAULTS:
            if (fault, seed) in done:
                continue
            rng = np.random.default_rng([sorted(FAULTS).index(fault), seed])
            posterior = fit(draw_missions(fault, rng), PooledTrust(), "exact", whole=False)
            seconds, criticism = timed(lambda dt=posterior: criticise(dt, compare=False))
            done[fault, seed] = criticism.fault, seconds
            add_record(given.out, (fault, seed, criticism.fault, seconds))
    print(f"{n} data sets of each fault, level .05; kept in {given.out}\n")
    table = Table("fault", "found", "named", "seconds", "names", first=18)
    for fault, right in FAULTS.items():
        names = Counter(done[fault, seed][0] for seed in range(n))
        seconds = np.median([done[fault, seed][1] for seed in range(n)])
        shares = (f"{share:.2f}" for share in (1.0 - names["none"] / n, names[right] / n))
        table.row(fault, *shares, f"{seconds:.2f}", dict(names.most_common()))


if __name__ == "__main__":
    main()
