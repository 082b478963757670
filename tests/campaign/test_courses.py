"""Campaigns of many courses, with robots that stay at home: any order of operations is safe."""

import contextlib
import json
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo.campaign import learning
from trustbo.campaign.state import State
from trustbo.files import to_json
from trustbo.hazard.trials import CAUSES
from trustbo.models import PooledTrust
from trustbo.planning.plan import plan_to_record

TEAM = "r1", "r2", "r3"
SOME = "r1", "r3"
ENDS = (3, 0), (0, 3)
BACK = ENDS[::-1]
ACROSS = (0, 0), (3, 3)
COURSES = (ENDS, BACK, ACROSS, ((2, 1), (2, 3)), ((3, 0), (3, 1)))
QUICK = {"model": PooledTrust(), "sampler": "importance", "fit": {"draws": 60}, "progress": False}


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


def begin(workspace, *ends, **options):
    return tb.Campaign(workspace, *ends, **QUICK | options)


def way(start, goal, via=None):
    """Cells of the shortest way from start to goal, through another cell if one is given."""
    path = [start]
    for target in (goal,) if via is None else (via, goal):
        while path[-1] != target:
            steps = np.sign(np.subtract(target, path[-1]))
            path.append(tuple(np.add(path[-1], steps).tolist()))
    return tuple(path)


def drive(workspace, path, seed=0, *, fail_at=None, robots=TEAM):
    """Run a path with some robots."""
    seed = int(seed.integers(2**31)) if isinstance(seed, np.random.Generator) else seed
    simulator = ModelSimulator(workspace, blind=True, fail_at=fail_at)
    return simulator.run(path, seed=seed).of_robots(robots)


# --- any order of operations ---


class Told(NamedTuple):
    """What was told of a mission, and whether a user has excluded it."""

    mission: tb.Mission
    excluded: bool = False


class Field:
    """A campaign in a folder, and beside it a simple list of all that was reported to it."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.workspace = random_cells()
        self.told: list[Told] = []
        self.failures: list[tuple[str, bool]] = []
        self.campaign = begin(self.workspace, directory=folder)
        self.n_done = self.n_refused = 0
        self.before = self.seen()

    def close(self):
        self.campaign.close()

    def run(self, name, seed):
        """Run an operation; if it is refused, everything is as before."""
        self.before = self.seen()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                getattr(self, name)(np.random.default_rng(seed))
            self.n_done += 1
        except tb.TrustboError:
            self.n_refused += 1
            assert self.seen() == self.before
        self.check()

    def seen(self):
        """All that was recorded and asked for, as text."""
        asked = self.campaign.state.asked
        plan = None if asked is None else plan_to_record(asked)
        return self.campaign.table().to_csv(), to_json(plan)

    def check(self):
        """Compare what is recorded with what was reported."""
        campaign = self.campaign
        assert len(campaign.missions) == len(self.told)
        for entry, told in zip(campaign.state.entries, self.told, strict=True):
            rates = entry.mission.of_robots(told.mission.robots).contact_rate
            np.testing.assert_array_equal(rates, told.mission.contact_rate)
            stayed = [name not in told.mission.robots for name in TEAM]
            assert np.isnan(entry.mission.contact_rate[:, stayed]).all()
            assert entry.mission.path == told.mission.path
            assert (entry.exclusion is not None) == told.excluded
            assert entry.course.start == told.mission.path[0]
            if told.mission.status == "ok":
                assert entry.course.goal == told.mission.path[-1]
            assert entry.course.robots == told.mission.robots
        found = [(one.reason, bool(one.withdrawn)) for one in campaign.state.failures]
        assert found == self.failures

        used = [j for j, told in enumerate(self.told) if not told.excluded]
        assert list(campaign.state.used) == used
        record = json.loads((self.folder / "campaign.json").read_text())
        files = [name for name in record["files"] if name.startswith("missions/")]
        assert len(files) == len(self.told)

    def any_course(self, rng):
        """Arguments of `ask` and `plan`, of which some are wrong."""
        course: list = [*COURSES[rng.integers(len(COURSES))]]
        kind = rng.integers(12)
        if kind == 0:
            course[1] = course[0]
        elif kind == 1:
            course[0] = (9, 9)
        elif kind == 2:
            course[rng.integers(2)] = None
        robots = [None, None, TEAM, SOME, SOME[::-1], ("r2",), ("r1", "r9"), ()][rng.integers(8)]
        return course, {"robots": robots}

    def any_path(self, rng):
        start, goal = COURSES[rng.integers(len(COURSES))]
        via = tuple(rng.integers(4, size=2).tolist()) if rng.random() < 0.5 else None
        return way(start, goal, via)

    def ask(self, rng):
        course, options = self.any_course(rng)
        plan = self.campaign.ask(*course, **options)
        assert self.campaign.ask() is plan
        assert self.campaign.ask(*course, **options) is plan

    def ask_again(self, rng):
        self.campaign.ask()

    def plan(self, rng):
        before = self.seen(), (self.folder / "campaign.json").read_bytes()
        course, options = self.any_course(rng)
        with contextlib.suppress(tb.TrustboError):
            self.campaign.plan(*course, **options)
        assert before == (self.seen(), (self.folder / "campaign.json").read_bytes())

    def suggest(self, rng):
        robots = self.any_course(rng)[1]["robots"]
        path = self.any_path(rng)
        assert self.campaign.suggest(path, robots=robots).path == path

    def told_now(self, mission, **options):
        n = len(self.campaign.missions)
        self.campaign.tell(mission, **options)
        assert len(self.campaign.missions) == n + 1
        assert self.campaign.state.asked is None
        self.told.append(Told(mission))

    def asked(self, rng):
        """Path and robots of the next mission; sometimes, no path has been asked for."""
        plan = self.campaign.state.asked
        if plan is None and rng.random() < 0.7:
            plan = self.campaign.ask(*COURSES[rng.integers(len(COURSES))])
            self.before = self.seen()
        if plan is None:
            return self.any_path(rng), TEAM
        return plan.path, plan.robots

    def some_bounds(self, rng, path):
        return int(rng.integers(1, len(path)))

    def tell(self, rng):
        path, robots = self.asked(rng)
        self.told_now(drive(self.workspace, path, rng, robots=robots))

    def tell_stuck(self, rng):
        path, robots = self.asked(rng)
        n = self.some_bounds(rng, path)
        mission = drive(self.workspace, path, rng, fail_at=n, robots=robots)
        if rng.random() < 0.5:  # the log ends there
            mission = replace(mission, path=mission.path[: n + 1])
        self.told_now(replace(mission, status=CAUSES[rng.integers(len(CAUSES))]))

    def tell_aborted(self, rng):
        path, robots = self.asked(rng)
        n = self.some_bounds(rng, path)
        mission = drive(self.workspace, path, rng, fail_at=n, robots=robots)
        self.told_now(replace(mission, status="aborted"))

    def tell_elsewhere(self, rng):
        _, robots = self.asked(rng)
        self.told_now(drive(self.workspace, self.any_path(rng), rng, robots=robots))

    def tell_of_others(self, rng):
        path, robots = self.asked(rng)
        others = [("r2",), ("r2", "r3"), SOME, TEAM][rng.integers(4)]
        mission = drive(self.workspace, path, rng, robots=others)
        if others != robots:
            with pytest.raises(tb.TrustboError):
                self.campaign.tell(mission)
            raise tb.TrustboError("refused")
        self.told_now(mission)

    def tell_twice(self, rng):
        if not self.told:
            return
        k = int(rng.integers(len(self.told)))
        mission = self.told[k].mission
        if rng.random() < 0.5:
            self.told_now(mission, again=True)
        else:
            self.told_now(mission)
            assert all(told.excluded for told in self.told[:-1] if told.mission is mission)

    def fail(self, rng):
        reason = ("rain", "stuck", "timeout", "got stuck")[rng.integers(4)]
        plan = self.campaign.state.asked
        where = None
        if plan is not None and rng.random() < 0.5:
            where = plan.path[rng.integers(len(plan.path))][:2]
        self.campaign.fail(reason, where=where)
        self.failures.append((reason, False))

    def withdraw(self, rng):
        n = int(rng.integers(1, len(self.failures) + 2))
        self.campaign.withdraw(n, "a mistake")
        reason, withdrawn = self.failures[n - 1]
        assert not withdrawn
        self.failures[n - 1] = reason, True

    def exclude(self, rng):
        n = int(rng.integers(1, len(self.told) + 2))
        self.campaign.exclude(n, "a bad day")
        assert not self.told[n - 1].excluded
        self.told[n - 1] = self.told[n - 1]._replace(excluded=True)

    def replan(self, rng):
        plan = self.campaign.ask()
        k = self.some_bounds(rng, plan.path)
        if rng.random() < 0.4:
            blocked = [plan.path[k : k + 2]] if k + 1 < len(plan.path) else []
            new = self.campaign.replan(plan.path[k][:2], blocked=blocked)
        else:
            status = ("stuck", "aborted")[rng.integers(2)]
            so_far = drive(self.workspace, plan.path, rng, fail_at=k, robots=plan.robots)
            so_far = replace(so_far, path=so_far.path[: k + 1], status=status)
            new = self.campaign.replan(plan.path[k - (status == "stuck")][:2], so_far)
        assert new.robots == plan.robots
        assert (new.start, new.goal) == (plan.start, plan.goal)

    def reopen(self, rng):
        before = self.seen(), posterior_bytes(self.campaign)
        self.campaign.close()
        with pytest.raises(tb.TrustboError):
            self.campaign.tell(drive(self.workspace, way(*ENDS), rng))
        self.campaign = tb.Campaign.load(self.folder, progress=False)
        assert before == (self.seen(), posterior_bytes(self.campaign))
        assert self.campaign.state.asked is self.campaign.state.asked


OPERATIONS = (
    "ask", "ask_again", "plan", "suggest", "tell", "tell_stuck", "tell_aborted", "tell_elsewhere",
    "tell_of_others", "tell_twice", "fail", "withdraw", "exclude", "replan", "reopen",
)  # fmt: skip


def posterior_bytes(campaign):
    """Bytes of all draws of the last posterior."""
    tree = campaign.state.posterior
    if tree is None:
        return {}
    return {
        (group, name): values.values.tobytes()
        for group in tree.children
        for name, values in tree[group].data_vars.items()
    }


def run_operations(operations):
    with tempfile.TemporaryDirectory() as folder:
        field = Field(Path(folder) / "campaign")
        try:
            for name, seed in operations:
                field.run(name, seed)
        finally:
            field.close()
        return field.n_done, field.n_refused


@settings(max_examples=5, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.sampled_from(OPERATIONS), st.integers(0, 2**32 - 1)), max_size=12))
def test_any_order_of_operations_loses_and_doubles_nothing(operations):
    run_operations(operations)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(50))
def test_two_thousand_operations_lose_and_double_nothing(seed):
    rng = np.random.default_rng(seed)
    names = rng.choice(OPERATIONS, 40).tolist()
    n_done, _ = run_operations([(name, [seed, k]) for k, name in enumerate(names)])
    assert n_done > 10


# --- which course, and which robots ---


def test_a_campaign_without_a_course_asks_for_its_start(workspace):
    campaign = begin(workspace)
    for call in (campaign.ask, campaign.plan, lambda: campaign.ask(ENDS[0])):
        with pytest.raises(tb.TrustboError, match=r"start|goal"):
            call()
    with pytest.raises(tb.TrustboError, match="course"):
        campaign.run(ModelSimulator(workspace))
    assert campaign.state.asked is None
    for ends in ((ENDS[0], None), (None, ENDS[1])):
        with pytest.raises(tb.TrustboError, match=r"start|goal"):
            begin(workspace, *ends)


def test_the_same_course_has_the_same_plan_and_another_course_replaces_it(workspace):
    campaign = begin(workspace, *ENDS)
    plan = campaign.ask()
    for same in ({}, {"robots": TEAM[::-1]}, {"start": ENDS[0]}, {"goal": ENDS[1]}):
        assert campaign.ask(**same) is plan
    for other in ({"robots": SOME}, {"start": ENDS[1], "goal": ENDS[0]}, {"goal": (2, 2)}):
        new = campaign.ask(**other)
        assert campaign.ask() is new is campaign.state.asked
        expected = {"start": ENDS[0], "goal": ENDS[1], "robots": TEAM} | other
        assert {name: getattr(new, name) for name in expected} == expected
    assert campaign.table().empty


def test_explore_counts_the_missions_of_the_same_course_alone(workspace):
    """Missions on another course neither count as repeats nor interrupt them."""
    seen = []

    def policy(rng, draws, planner, driven):
        seen.append(list(driven))
        return planner.plan(draws.mean())

    campaign = begin(workspace, policy=policy)
    told = {ENDS: [], BACK: []}
    for k, ends in enumerate((ENDS, BACK, ENDS, ENDS, BACK)):
        plan = campaign.ask(*ends)
        assert seen[-1] == told[ends]
        campaign.tell(drive(workspace, plan.path, k))
        told[ends].append(plan.path)


def test_regret_bound_waits_until_each_course_is_sure_and_completed(workspace):
    rule = tb.RegretBound(eps=0.9, delta=0.5)
    campaign = begin(workspace)

    def run(course, n, **options):
        for _ in range(n):
            plan = campaign.suggest(campaign.recommend(*course, **options).path, **options)
            seed = len(campaign.missions)
            campaign.tell(drive(workspace, plan.path, seed, robots=plan.robots))

    run(ENDS, 3)
    assert rule(campaign).startswith("regret_bound")
    around = way(*ACROSS, (3, 0))
    campaign.suggest(around)
    campaign.tell(drive(workspace, around, 7))
    assert rule(campaign) is None
    assert all(rule.probability(campaign, n) == 1.0 for n in (3, 4))
    run(ACROSS, 1)
    assert rule(campaign).startswith("regret_bound")


def test_lost_share_compares_courses_of_different_lengths(workspace):
    campaign = begin(workspace)
    unknown = np.full((3, 3, 2), np.nan)
    rates = np.full((3, 3), 0.8)
    for ends, n_run, status in ((ENDS, 3, "ok"), (COURSES[-1], 1, "ok"), (ENDS, 2, "stuck")):
        path = way(*ends)
        campaign.suggest(path)
        campaign.tell(
            tb.Mission.from_arrays(path, unknown[:n_run], rates[:n_run], status=status), again=True
        )
    table = campaign.table()
    assert table["contact_lost"].tolist() == pytest.approx([0.6, 0.2, 1.4])
    assert table["lost_share"].tolist() == pytest.approx([0.2, 0.2, 1.4 / 3])


def test_lost_contact_of_some_robots_is_the_mean_over_those_that_went(workspace):
    campaign = begin(workspace)
    path = way(*ENDS)
    campaign.suggest(path, robots=SOME)
    rates = np.tile([0.9, 0.5], (3, 1))
    unknown = np.full((3, 2, 2), np.nan)
    campaign.tell(tb.Mission.from_arrays(path, unknown, rates, robots=SOME))
    row = campaign.table().iloc[0]
    assert (row["robots"], row["n_unmeasured"]) == ("r1, r3", 0)
    assert row[["contact_lost", "lost_share"]].tolist() == pytest.approx([0.9, 0.3])


def test_a_robot_that_was_planned_is_not_missing_and_one_at_home_has_no_rates(workspace):
    campaign = begin(workspace, *ENDS)
    path = campaign.ask().path
    with pytest.raises(tb.TrustboError, match="r2"):
        campaign.tell(drive(workspace, path, robots=SOME))

    campaign.ask(robots=SOME)
    with pytest.raises(tb.TrustboError, match="r3"):
        campaign.tell(drive(workspace, path, robots=("r1",)))
    whole = drive(workspace, path)
    with pytest.raises(tb.TrustboError, match="r2"):
        campaign.tell(whole)
    assert campaign.missions == []

    rates = whole.contact_rate.copy()
    rates[:, 1] = np.nan
    campaign.tell(replace(whole, contact_rate=rates))
    assert campaign.state.entries[0].measured.robots == SOME
    campaign.ask(robots=SOME)
    with pytest.raises(tb.TrustboError, match="again"):
        campaign.tell(whole.of_robots(SOME))


def test_a_table_without_the_absent_robot_is_read_by_tell(workspace):
    campaign = begin(workspace)
    plan = campaign.ask(*ENDS, robots=SOME)
    told = drive(workspace, plan.path, robots=SOME)
    [mission] = tb.logs.read_table(tb.logs.to_frame([told]))
    campaign.tell(mission)
    found = campaign.state.entries[0]
    assert found.measured.robots == SOME
    np.testing.assert_allclose(found.measured.contact_rate, told.contact_rate, rtol=1e-12)


def test_a_mission_of_some_robots_is_followed_and_replanned(workspace):
    campaign = begin(workspace)
    plan = campaign.ask(*ENDS, robots=SOME)
    follower = tb.Follower(campaign)
    follower.begin(0.0)
    follower.tick(1.0, {"r3": 1, "r1": 0})
    follower.end(2.0, "stuck")
    assert follower.trust.mean.shape == (2,)

    new = follower.replan()
    assert new.robots == SOME
    assert new.path[:3] == (*plan.path[:2], plan.path[0])
    assert new.trust.shape[1] == 2
    t = 3.0
    for _ in range(len(new.path) - 2):
        follower.begin(t)
        follower.tick(t + 1.0, [1, 1])
        follower.end(t + 2.0)
        t += 3.0
    campaign.tell(follower.to_mission())
    [entry] = campaign.state.entries
    assert (entry.course[:3], entry.plan.is_replanned) == ((*ENDS, SOME), True)
    assert campaign.table()["failed_bounds"].tolist() == [
        f"1 into {plan.path[1][0]},{plan.path[1][1]} (stuck)"
    ]


# --- what is learned ---


class KilledAfter(ModelSimulator):
    """Dies before mission n."""

    def __init__(self, workspace, n):
        super().__init__(workspace, blind=True)
        self.n = n

    def run(self, path, *, seed, mission=0):
        if mission == self.n:
            raise RuntimeError("killed")
        return super().run(path, seed=seed, mission=mission)

    def describe(self):
        return {"simulator": "ModelSimulator"}


def test_a_campaign_of_courses_that_is_killed_and_resumed_equals_the_uninterrupted_one(
    workspace, tmp_path
):
    options = {"courses": [ENDS, BACK, ACROSS], "n_iterations": 5, "policy": "thompson", **QUICK}
    whole = tb.iterate(workspace, simulator=KilledAfter(workspace, None), **options)
    for n in (1, 3):
        folder = tmp_path / str(n)
        with pytest.raises(RuntimeError, match="killed"):
            tb.iterate(workspace, simulator=KilledAfter(workspace, n), directory=folder, **options)
        resumed = tb.resume(folder, simulator=KilledAfter(workspace, None), progress=False)
        assert resumed.table().equals(whole.table())
        assert posterior_bytes(resumed) == posterior_bytes(whole)
        assert resumed.plan(*BACK).path == whole.plan(*BACK).path
    starts = [entry.course.ends for entry in whole.state.entries]
    assert starts == [ENDS, BACK, ACROSS, ENDS, BACK]


def test_failures_of_other_courses_count_like_those_of_earlier_campaigns(workspace):
    """Missions whose log ends at the failure, some of them at the goal or with posts planned."""
    told = []
    for k, (ends, n_run, cut) in enumerate(
        [(ENDS, 1, True), (BACK, 2, True), (ENDS, 3, True), (BACK, 3, True), (ENDS, 2, False)]
    ):
        mission = drive(workspace, way(*ends), k, fail_at=n_run)
        told.append(replace(mission, path=mission.path[: n_run + 1] if cut else mission.path))

    def tell(campaign, missions):
        for mission in missions:
            ends = ENDS if mission.path[0] == ENDS[0] else BACK
            campaign.suggest(way(*ends))
            campaign.tell(mission)
        return campaign

    together = tell(begin(workspace), told)
    there = tell(begin(workspace, *BACK), [one for one in told if one.path[0] == BACK[0]])
    here = tell(
        begin(workspace, *ENDS, earlier=there), [one for one in told if one.path[0] == ENDS[0]]
    )
    for name in ("trials", "failures"):
        np.testing.assert_array_equal(together.hazard[name], here.hazard[name])
    assert together.hazard["failures"].sum() == len(told)


HAPPENED = st.tuples(
    st.integers(1, 3),  # bound that fails, unless the mission arrives
    st.sampled_from(["arrives", "fails", "fails and the log ends", "is replanned"]),
)


def run_and_tell(campaign, k, ends, n_run, outcome):
    """Run a mission on a course, and tell it; return the mission."""
    path = campaign.suggest(way(*ends)).path
    if outcome == "is replanned":
        left, entered = path[n_run - 1 : n_run + 1]
        so_far = drive(campaign.workspace, path, k, fail_at=n_run)
        rest = campaign.replan(left, so_far).path[n_run + 1 :]
        back = drive(campaign.workspace, (entered, *rest), k)
        names = ("awareness", "contact_rate", "duration", "n_ticks")
        both = [np.concatenate([getattr(m, name) for m in (so_far, back)]) for name in names]
        status = [*so_far.bound_status, *back.bound_status]
        path = (*path[: n_run + 1], *rest)
        mission = tb.Mission.from_arrays(path, *both[:2], status=status)
        campaign.tell(mission)
        return mission

    fails = outcome != "arrives"
    mission = drive(campaign.workspace, path, k, fail_at=n_run if fails else None)
    if outcome.endswith("ends"):
        mission = replace(mission, path=mission.path[: n_run + 1])
    campaign.tell(mission)
    return mission


@settings(max_examples=6, deadline=None, derandomize=True)
@given(
    first=st.lists(HAPPENED, min_size=1, max_size=3),
    later=st.lists(HAPPENED, min_size=1, max_size=3),
)
def test_missions_of_another_course_teach_like_those_of_an_earlier_campaign(first, later):
    """The fits begin anew and have the same seed, so results are equal up to rounding.

    If the missions are told in another order, so are the parameters, but not the draws of effects,
    which are drawn in the order of missions.
    """
    workspace = random_cells()
    happened = [(BACK, *rest) for rest in first] + [(ENDS, *rest) for rest in later]
    told = list(enumerate(happened))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning, "_previous", lambda state: None)
        patch.setattr(State, "seed_of", lambda *_: 0)
        together, there, reordered = (begin(workspace) for _ in range(3))
        missions = [run_and_tell(together, k, *one) for k, one in told]
        for k, one in told[: len(first)]:
            run_and_tell(there, k, *one)

        here = begin(workspace, earlier=there)
        for k, one in told[len(first) :]:
            run_and_tell(here, k, *one)

        for mission, (ends, *_) in reversed(list(zip(missions, happened, strict=True))):
            reordered.suggest(way(*ends))
            reordered.tell(mission)

        close = {"rtol": 1e-6, "atol": 1e-9}
        for group in ("posterior", "hazard"):
            for name, values in together.posterior[group].data_vars.items():
                other = here.posterior[group][name]
                np.testing.assert_allclose(values, other, **close, err_msg=name)
        for name, values in together.posterior["posterior"].data_vars.items():
            other = reordered.posterior["posterior"][name]
            np.testing.assert_allclose(values, other, **close, err_msg=name)

        for ends in (ENDS, BACK):
            plans = [campaign.plan(*ends) for campaign in (together, here)]
            pd.testing.assert_frame_equal(*[plan.to_frame() for plan in plans], **close)
        xr.testing.assert_allclose(together.maps(), here.maps(), **close)


def test_the_order_of_missions_of_many_courses_does_not_matter(workspace):
    missions = [drive(workspace, way(*ends), k) for k, ends in enumerate(COURSES)]
    options = {"sampler": "importance", "seed": 1, "draws": 60, "workspace": workspace}
    means = []
    for order in ([0, 1, 2, 3, 4], [3, 1, 4, 0, 2]):
        posterior = tb.fit([missions[j] for j in order], PooledTrust(), **options)
        means.append(posterior["posterior"])
    for name, values in means[0].data_vars.items():
        np.testing.assert_allclose(values, means[1][name], rtol=1e-8, atol=1e-12, err_msg=name)


def test_a_robot_at_home_has_the_awareness_of_the_map_and_no_rates(workspace):
    campaign = begin(workspace, *ENDS)
    path = campaign.ask(robots=SOME).path
    campaign.tell(drive(workspace, path, robots=SOME))
    learned = campaign.missions[0]
    assert learned.robots == workspace.team.names
    np.testing.assert_array_equal(learned.awareness, workspace.along(path))
    at_home = [name not in SOME for name in learned.robots]
    np.testing.assert_array_equal(
        np.isnan(learned.contact_rate), np.tile(at_home, (len(path) - 1, 1))
    )
