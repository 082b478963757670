"""Random campaigns on bad days: killed, disk full, files damaged, logs with errors, flags changed.

Run: python benchmarks/chaos.py [-n 300] [--quick] [--out FILE]

Each campaign is drawn from its seed: terrain or awareness alone, shape, robots, model, sampler,
policy, objective, options, threats, odd data. It is run once undisturbed and once with mishaps, and
must come to the same paths, states and posterior. Counted are exceptions that are no TrustboError,
missions that were told and are not in the folder, folders that do not open, and campaigns that
differ. Every folder holds files of other programs, some in links: none may be missing or changed.
Each is then read, saved, and read again, twice round, and must be equal. Outcomes are appended to
FILE (out/chaos.jsonl), a line each; run again, it goes on.
"""

import errno
import hashlib
import os
import shutil
import tempfile
import traceback
import warnings
from collections import Counter
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from common import Table, add_record, arguments, parsed, read_records

import trustbo as tb
import trustbo.files
from trustbo.campaign.replacing import current, own_files
from trustbo.models import CoupledTrust, PooledTrust, TrustParams
from trustbo.simulation import Degradation, KinematicSimulator, ModelSimulator, Threat

MISHAPS = ("kill", "full disk", "flags", "damage", "errors in logs", "interrupt")
FOREIGN = (
    "notes.txt", "old.csv", ".bashrc.1", ".notes.2024.csv", "posteriors/mine.nc", "ticks/raw.12",
    "posteriors/.draft.12.nc", "posteriors/copy of 0001.nc", "sub/.survey.2023.tif",
    "sub/.git/.x.12",
)  # fmt: skip
LINKS = {"linked": "", ".linked.12": ".a.12", "posteriors/linked.nc": ".a.12", "ticks/all": ""}
DATA = ("usual", "usual", "usual", "perfect", "none", "constant", "gaps", "nothing", "mixed")


class Killed(BaseException):
    """The process ends here."""


class Odd:
    """A simulator whose rates are odd, the same for the same seed."""

    def __init__(self, simulator, kind):
        self.simulator, self.kind = simulator, kind

    def describe(self):
        """Settings, the kind of data among them."""
        return self.simulator.describe() | {"odd": self.kind}

    def run(self, path, *, seed):
        """Run the mission, and change its rates."""
        mission = self.simulator.run(path, seed=seed)
        rng = np.random.default_rng(seed)
        bounds = []
        for bound in mission.bounds:
            rate = bound.contact_rate.copy()
            kind = rng.choice(["perfect", "gaps", "usual"]) if self.kind == "mixed" else self.kind
            if kind == "perfect":
                rate[:] = 1.0
            elif kind == "none":
                rate[:] = 0.0
            elif kind == "constant":
                rate[:] = 0.5
            elif kind == "gaps":
                rate[rng.uniform(size=rate.shape) < 0.4] = np.nan
            elif kind == "nothing" and seed % 2:
                rate[:] = np.nan
            known = np.full(rate.shape, np.nan)
            bounds.append(
                replace(
                    bound, contact_rate=rate, n_ticks=known, poses=None, contact=None, states=None
                )
            )
        return replace(mission, bounds=tuple(bounds))


def draw(seed):
    """Options, simulator and ends of a campaign, and the kind of its mishap."""
    rng = np.random.default_rng(seed)
    pick = lambda *values: values[rng.integers(len(values))]  # noqa: E731
    rows, cols = int(rng.integers(2, 6)), int(rng.integers(2, 6))
    n_robots = int(rng.integers(1, 5))
    team = tb.Team(n_robots)
    threats, kind = [], pick(*DATA)
    if rng.uniform() < 0.3:
        size = (30.0 * cols, 30.0 * rows)
        terrain = tb.terrain.synthetic_terrain(size, resolution=2.0, seed=seed, relief=5.0)
        workspace = tb.Workspace.from_terrain(terrain, (rows, cols), team)
        if rng.uniform() < 0.5:
            x, y = (float(rng.choice(terrain[axis].values)) for axis in "xy")
            threats = [Threat(pick("jam", "forbid"), (x, y), 12.0, first_mission=1)]
        degradations = [Degradation("r1", 0.5, 1)] if rng.uniform() < 0.5 else []
        simulator = KinematicSimulator(workspace, threats=threats, degradations=degradations)
    else:
        awareness = rng.uniform(size=(n_robots, rows, cols, int(rng.integers(1, 4))))
        workspace = tb.Workspace.from_awareness(awareness)
        m = awareness.shape[-1]
        truth = TrustParams(0.6, rng.uniform(0.0, 0.4, m), 0.1, 0.05, 0.05)
        simulator = ModelSimulator(workspace, truth)
        kind = pick("usual", kind)
    if kind != "usual":
        simulator = Odd(simulator, kind)
    model = pick(PooledTrust(), PooledTrust(), PooledTrust(response="change"),
                 CoupledTrust(inter_robot="none"))  # fmt: skip
    plain = isinstance(model, PooledTrust) and model.response == "level"
    sampler = "nuts" if rng.uniform() < 0.1 and plain else "exact"
    options = {
        "model": model, "sampler": sampler, "seed": int(rng.integers(100)),
        "policy": pick(*tb.planning.POLICIES), "objective": pick(*tb.planning.OBJECTIVES),
        "team": pick("mean", "mean", "min"), "connectivity": pick(8, 8, 4),
        "initial": pick("prior_draw", "prior_mean"), "forgetting": pick(1.0, 1.0, 0.8),
        "awareness": pick("map", "map", "belief"), "length_weight": pick(0.0, 0.0, 1e-4),
    }  # fmt: skip
    if isinstance(simulator, KinematicSimulator) and rng.uniform() < 0.3:
        options["replan"] = "bound"
    return workspace, ((rows - 1, 0), (0, cols - 1)), simulator, options, pick(*MISHAPS), kind


@contextmanager
def dies_at(write, error):
    """Raise at the n-th file that would appear."""
    count, replace_file = [0], os.replace

    def counted(*names):
        count[0] += 1
        if count[0] == write:
            raise error
        replace_file(*names)

    trustbo.files.os.replace = counted
    try:
        yield
    finally:
        trustbo.files.os.replace = replace_file


def plant(folder, elsewhere):
    """Put files of other programs into a folder, and links to some elsewhere; their contents."""
    for file in (".a.12", "0001.nc", ".0002.4711.nc", "campaign.json"):
        elsewhere.mkdir(exist_ok=True)
        (elsewhere / file).write_text(f"elsewhere: {file}")
    for name in FOREIGN:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(f"mine: {name}")
    for name, target in LINKS.items():
        (folder / name).symlink_to(elsewhere / target)
    files = [*(folder / name for name in (*FOREIGN, *LINKS)), *elsewhere.iterdir()]
    return {file: content(file) for file in files}


def content(file):
    """Target of a link, hash of a file, None where there is none."""
    if file.is_symlink():
        return os.readlink(file)
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.exists() else None


def round_trip(folder, parent):
    """Read, save and read a folder, twice round, as a result and as a campaign; what differs."""
    first = before = tb.load_result(folder)
    with tb.Campaign.load(folder) as campaign:
        campaign.save(parent / "saved")
        told = [np.nan_to_num(m.contact_rate, nan=-1.0) for m in campaign.state.measured]
    for n in range(2):
        before.save(parent / f"round{n}")
        before = tb.load_result(parent / f"round{n}")
        if not (same(first, before) and alike(first.workspace, before.workspace)):
            return f"the result differs after {n + 1} rounds"
        if not first.history.drop_vars("trust_map").equals(before.history.drop_vars("trust_map")):
            return f"the history differs after {n + 1} rounds"
    for n in range(2):
        with tb.Campaign.load(parent / "saved") as campaign:
            again = [np.nan_to_num(m.contact_rate, nan=-1.0) for m in campaign.state.measured]
            if not all(map(np.array_equal, told, again)):
                return "the missions as they were told differ"
            campaign.save(parent / "saved")  # over itself
        if not same(first, tb.load_result(parent / "saved")):
            return f"the campaign differs after {n + 1} rounds"
    for name in ("round0", "round1", "saved"):
        shutil.rmtree(parent / name)
    return ""


def alike(one, other):
    """Whether two workspaces are the same, terrain and pixels included."""
    if (one.terrain is None) != (other.terrain is None):
        return False
    pairs = [(one.awareness, other.awareness), (one.passable, other.passable)]
    if one.terrain is not None:
        pairs += [(one.terrain, other.terrain), (one.pixels, other.pixels)]
    return one.grid == other.grid and all(a.identical(b) for a, b in pairs)


def same(one, other):
    """Whether two results have the same missions, states, posteriors and path."""
    if len(one.missions) != len(other.missions) or one.path != other.path:
        return False
    if (one.history["state"].values != other.history["state"].values).any():
        return False
    for a, b in zip(one.missions, other.missions, strict=True):
        if a.path != b.path or not np.array_equal(a.contact_rate, b.contact_rate, equal_nan=True):
            return False
    for a, b in zip(one.posteriors, other.posteriors, strict=True):
        if (a is None) != (b is None):
            return False
        if a is not None and not a["posterior"].to_dataset().equals(b["posterior"].to_dataset()):
            return False
    return True


def run(campaign, simulator, folder):
    return tb.iterate(*campaign[0], n_iterations=3, simulator=simulator, checkpoint=folder,
                      progress=False, **campaign[1])  # fmt: skip


def go_on(campaign, simulator, folder):
    """Resume, or begin anew where nothing had been begun."""
    if not (current(folder) / "campaign.json").exists():
        return run(campaign, simulator, folder)
    return tb.resume(folder, simulator=simulator, n_iterations=3, progress=False)


def suffer(mishap, seed, campaign, simulator, folder):
    """Run the campaign with mishaps; its result, and what went wrong that must not."""
    rng = np.random.default_rng([seed, 1])
    if mishap in ("kill", "full disk", "interrupt"):
        error = {"kill": Killed(), "full disk": OSError(errno.ENOSPC, "No space left on device"),
                 "interrupt": KeyboardInterrupt()}[mishap]  # fmt: skip
        for _ in range(3):
            try:
                with dies_at(int(rng.integers(1, 60)), error):
                    go_on(campaign, simulator, folder)
            except (Killed, KeyboardInterrupt):
                pass
            except tb.TrustboError as said:
                if mishap != "full disk" or "the disk is full" not in str(said):
                    raise
        return go_on(campaign, simulator, folder)
    if mishap == "flags":
        with ExitStack() as stack:
            stack.enter_context(jax.enable_x64(bool(rng.integers(2))))
            stack.enter_context(jax.default_prng_impl("rbg"))
            stack.enter_context(jax.threefry_partitionable(bool(rng.integers(2))))
            return run(campaign, simulator, folder)
    if mishap == "errors in logs":
        return tell_with_errors(rng, campaign, simulator, folder)
    result = run(campaign, simulator, folder)
    damage(rng, folder)
    return result


def tell_with_errors(rng, campaign, simulator, folder):
    """Ask and tell by hand; bad logs in between must be refused and leave no trace."""
    (workspace, start, goal), options = campaign
    options = dict(options)
    replan = options.pop("replan", None)
    if replan:  # the loop alone replans within a mission
        return run(campaign, simulator, folder)
    with tb.Campaign(workspace, start, goal, directory=folder, **options) as by_hand:
        notes = by_hand.log.notes
        while len(by_hand.missions) < 3:
            plan, number = by_hand.ask(), len(by_hand.missions)
            numbered = {"mission": number} if isinstance(simulator, KinematicSimulator) else {}
            mission = simulator.run(plan.path, seed=by_hand.seed_of("mission"), **numbered)
            for bad in bad_logs(rng, mission, by_hand.missions):
                try:
                    by_hand.tell(bad)
                except tb.TrustboError:
                    continue
                raise AssertionError("a bad log was taken")
            order = rng.permutation(len(mission.robots))
            shuffled = mission.in_order([mission.robots[i] for i in order], mission.features[::-1])
            by_hand.tell(shuffled, again=True)
            by_hand.log.notes = notes
        return by_hand.stop("n_iterations")


def bad_logs(rng, mission, earlier):
    """Missions that are not what was asked for."""
    swapped = tuple((col, row) for row, col in mission.path)
    if swapped != mission.path:
        bounds = tuple(replace(b, cell=(b.cell[1], b.cell[0])) for b in mission.bounds)
        yield replace(mission, path=swapped, bounds=bounds)
    yield replace(mission, robots=tuple(f"robot{i}" for i in range(len(mission.robots))))
    yield "a log"
    far = (99, 99)
    yield replace(mission, path=(*mission.path, far), status="aborted", bounds=mission.bounds)


def damage(rng, folder):
    """Change a file of a copy of the folder: it opens as it was, or names the file."""
    copy = folder.with_name(f"{folder.name}-copy")
    shutil.copytree(folder, copy, symlinks=True)
    files = [f for f in own_files(copy) if f.suffix in (".nc", ".json")]
    file = files[rng.integers(len(files))]
    content = bytearray(file.read_bytes())
    how = rng.integers(3)
    if how == 0:
        file.unlink()
    elif how == 1:
        file.write_bytes(content[: len(content) // 2])
    else:
        content[rng.integers(len(content))] ^= 0xFF
        file.write_bytes(content)
    for opens in (tb.load_result, tb.Campaign.load):
        try:
            opened = opens(copy)
            if isinstance(opened, tb.Campaign):
                with opened:
                    pass
        except tb.TrustboError as error:
            if file.name not in str(error) and how:
                raise AssertionError(f"the error does not name {file.name}: {error}") from None
    if file.name != "measured.nc" and len(tb.logs.read_missions(copy / "measured.nc")) != 3:
        raise AssertionError("measured.nc lost a mission")


def outcome(seed):
    """Record of one campaign."""
    workspace, ends, simulator, options, mishap, kind = draw(seed)
    record = {"seed": seed, "mishap": mishap, "data": kind, "policy": options["policy"],
              "objective": options["objective"], "sampler": options["sampler"],
              "model": type(options["model"]).__name__}  # fmt: skip
    with tempfile.TemporaryDirectory() as parent:
        folders = [Path(parent) / name for name in ("undisturbed", "disturbed")]
        try:
            tb.Campaign(workspace, *ends, **options)
        except tb.TrustboError as refused:  # options that do not go together, before any work
            return record | {"outcome": "refused", "said": str(refused)}
        campaign = ((workspace, *ends), options)
        planted = {}
        for folder in folders:
            planted |= plant(folder, Path(parent) / "elsewhere")
        try:
            plain = run(campaign, simulator, folders[0])
            disturbed = suffer(mishap, seed, campaign, simulator, folders[1])
            record["states"] = Counter(plain.history["state"].values.tolist())
            if not same(plain, disturbed):
                return record | {"outcome": "differs"}
            for folder in folders:
                with tb.Campaign.load(folder) as opened:
                    if len(opened.missions) != 3:
                        return record | {"outcome": "lost a mission"}
            record["foreign"] = len(planted)
            record["gone"] = [f.name for f, was in planted.items() if content(f) != was]
            record["round trips"] = 2
            if said := [said for folder in folders if (said := round_trip(folder, Path(parent)))]:
                return record | {"outcome": "not read as written", "said": said[0]}
            if record["gone"]:
                return record | {"outcome": "foreign files gone", "said": str(record["gone"])}
        except tb.TrustboError as refused:
            return record | {"outcome": "error", "said": str(refused),
                             "where": traceback.format_exc()[-1500:]}  # fmt: skip
        except Exception as error:
            return record | {"outcome": "uncaught", "said": repr(error),
                             "where": traceback.format_exc()[-1500:]}  # fmt: skip
    return record | {"outcome": "same"}


def main():
    warnings.simplefilter("ignore")
    given = parsed(arguments(__doc__, n=300, out="out/chaos.jsonl", quick="5 campaigns"))
    n = 5 if given.quick else given.n
    done = {record["seed"]: record for record in read_records(given.out)}
    for seed in range(n):
        if seed not in done:
            done[seed] = outcome(seed)
            add_record(given.out, done[seed])
    records = [done[seed] for seed in range(n)]
    table = Table("mishap", "campaigns", "same", "refused at once", "other")
    for mishap in MISHAPS:
        mine = [r["outcome"] for r in records if r["mishap"] == mishap]
        same_, refused = mine.count("same"), mine.count("refused")
        table.row(mishap, len(mine), same_, refused, len(mine) - same_ - refused)
    print(f"\n{n} campaigns: {dict(Counter(r['outcome'] for r in records))}")
    for name in ("data", "model", "sampler", "policy", "objective"):
        print(f"by {name}: {dict(Counter(r[name] for r in records))}")
    planted, gone = (sum(n) for n in zip(*(
        (r.get("foreign", 0), len(r.get("gone", ()))) for r in records), strict=True))  # fmt: skip
    trips = sum(r.get("round trips", 0) for r in records)
    print(f"foreign files: {planted}, of which missing or changed: {gone}")
    print(f"folders read, saved and read again, twice: {trips}")
    states = sum((Counter(r.get("states", {})) for r in records), Counter())
    print(f"states of missions: {dict(states)}")
    for record in records:
        if record["outcome"] not in ("same", "refused"):
            print(record["seed"], record["outcome"], record.get("said", ""))


if __name__ == "__main__":
    main()
