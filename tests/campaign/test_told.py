"""Missions that are told: none is lost, none is driven twice, and each says what became of it."""

import json
import re
import shutil
import warnings

import jax
import numpy as np
import pytest
from worlds import ModelSimulator, hillside, random_cells

import trustbo as tb
from trustbo.data import Mission
from trustbo.inference import fit, params_of

ENDS = ((3, 0), (0, 3))
DIAGONAL = ((3, 0), (2, 1), (1, 2), (0, 3))


@pytest.fixture
def workspace():
    return random_cells()


def begin(workspace, folder=None, **options):
    return tb.Campaign(
        workspace,
        *ENDS,
        **{"model": tb.models.PooledTrust(), "sampler": "exact", "objective": "mean"} | options,
        directory=folder,
    )


def rates(workspace, path, seed=0):
    return ModelSimulator(workspace, blind=True).run(path, seed=seed)


def refuse(*args, **kwargs):
    raise tb.PosteriorError("R-hat of beta0 is 1.5.", None, "Pass check=False.")


def test_a_mission_that_is_refused_stays_told_and_is_learned_with_the_next(
    workspace, tmp_path, monkeypatch
):
    campaign = begin(workspace, tmp_path)
    first = campaign.ask()
    tried = []

    def refuse_all(*args, **kwargs):
        tried.append((args[2], kwargs["seed"], kwargs["draws"]))
        refuse()

    with monkeypatch.context() as patch:
        patch.setattr("trustbo.campaign.learning.fit", refuse_all)
        with pytest.warns(UserWarning, match="mission 1 is kept") as said:
            assert campaign.tell(rates(workspace, first.path)) is None
        text = str(said[0].message)
        assert "mission 1 is kept, but cannot be learned from yet: R-hat of beta0 is 1.5" in text
        assert "goes on with the prior" in text
        assert "check=False" not in text  # which is no argument here
    # Another seed and more draws, then the other sampler.
    assert [(sampler, n) for sampler, _, n in tried] == [
        ("exact", 1000), ("exact", 2000), ("nuts", 2000)
    ]  # fmt: skip
    assert len({seed for _, seed, _ in tried}) == 3
    assert len(campaign.state.numbers("told")) == len(campaign.missions) == 1
    assert campaign.posterior is None
    assert campaign.history["state"].values.tolist() == ["told"]
    assert "R-hat" in str(campaign.history["reason"].values[0])
    with campaign:
        pass

    again = tb.Campaign.load(tmp_path)  # it opens, and fits nothing
    assert len(again.state.numbers("told")) == 1
    again.tell(rates(workspace, again.ask().path, seed=1))
    assert again.state.numbers("told") == []
    assert again.history["state"].values.tolist() == ["learned", "learned"]
    assert again.posteriors[0] is None
    assert again.posterior["constant_data"].sizes["mission"] == 2
    with again:
        pass
    kept = tb.load_result(tmp_path)
    assert kept.posteriors[0] is None
    np.testing.assert_array_equal(
        kept.posterior["latent"]["trust"], again.posterior["latent"]["trust"]
    )


def test_the_loop_goes_on_and_drives_no_mission_twice(workspace, tmp_path, monkeypatch):
    driven = []

    class Counts(ModelSimulator):
        def run(self, path, *, seed, mission=0):
            driven.append(seed)
            return super().run(path, seed=seed)

    def refuse_twice(missions, *args, **kwargs):
        return refuse() if len(missions) < 3 else fit(missions, *args, **kwargs)

    def options(n):
        return {"simulator": Counts(workspace, blind=True), "n_iterations": n, "progress": False}

    monkeypatch.setattr("trustbo.campaign.learning.fit", refuse_twice)
    with pytest.warns(UserWarning, match="cannot be learned from yet"):
        result = tb.iterate(workspace, *ENDS, sampler="exact", checkpoint=tmp_path, **options(2))
    assert result.history["state"].values.tolist() == ["told", "told"]
    with pytest.raises(tb.TrustboError, match=r"there is no posterior: none of 2 missions .*R-hat"):
        _ = result.posterior
    longer = tb.resume(tmp_path, **options(3))
    assert len(driven) == len(set(driven)) == 3
    assert longer.history["state"].values.tolist() == ["learned"] * 3
    assert longer.posterior["constant_data"].sizes["mission"] == 3


def test_a_defect_of_a_fit_costs_no_mission(workspace, monkeypatch):
    def break_down(*args, **kwargs):
        raise np.linalg.LinAlgError("Singular matrix")

    campaign = begin(workspace)
    monkeypatch.setattr("trustbo.campaign.learning.fit", break_down)
    with pytest.warns(UserWarning, match="LinAlgError: Singular matrix"):
        campaign.tell(rates(workspace, campaign.ask().path))
    assert len(campaign.state.numbers("told")) == 1


def test_a_mission_that_measured_nothing_is_set_aside_and_the_folder_opens(workspace, tmp_path):
    campaign = begin(workspace, tmp_path)
    path = campaign.ask().path
    n = len(path) - 1
    nothing = Mission.from_arrays(path, np.full((n, 3, 2), np.nan), np.full((n, 3), np.nan))
    with pytest.warns(UserWarning, match="mission 1 is set aside: no contact rate was measured"):
        assert campaign.tell(nothing) is None
    campaign.tell(rates(workspace, campaign.ask().path))
    with campaign:
        pass
    with tb.Campaign.load(tmp_path) as again:
        assert again.history["state"].values.tolist() == ["set aside", "learned"]
        assert again.posterior["constant_data"]["mission"].values.tolist() == [1]
        assert len(again.missions) == 2


def test_a_cell_without_awareness_sets_its_mission_aside(tmp_path):
    awareness = np.random.default_rng(0).uniform(size=(3, 4, 4, 2))
    awareness[:, 2, 1] = np.nan
    workspace = tb.Workspace.from_awareness(awareness)
    campaign = begin(workspace, tmp_path)
    blind = Mission.from_arrays(DIAGONAL, np.full((3, 3, 2), np.nan), np.full((3, 3), 0.7))
    with pytest.warns(
        UserWarning, match=r"awareness of bound 1, robot r1, .* cell \(2, 1\) has no"
    ):
        campaign.tell(blind)
    with campaign:
        pass
    with tb.Campaign.load(tmp_path):
        pass


def test_one_s_own_word_sets_aside_and_telling_again_takes_back(workspace):
    campaign, only = begin(workspace, seed=1), begin(workspace, seed=1)
    missions = [rates(workspace, DIAGONAL, seed=j) for j in range(3)]
    for mission in missions:
        campaign.tell(mission)
    campaign.set_aside("the lidar was covered", 2)
    assert campaign.history["state"].values.tolist() == ["learned", "set aside", "learned"]
    assert campaign.history["reason"].values[1] == "the lidar was covered"
    assert campaign.posterior["constant_data"]["mission"].values.tolist() == [0, 2]
    again = fit(
        [campaign.missions[j] for j in (0, 2)],
        tb.models.PooledTrust(),
        sampler="exact",
        seed=campaign.seed_of("fit"),
    )
    np.testing.assert_array_equal(
        again["posterior"]["beta"], campaign.posterior["posterior"]["beta"]
    )
    with pytest.raises(tb.TrustboError, match="mission 2 is set aside already: the lidar was"):
        campaign.set_aside("again", 2)
    with pytest.raises(tb.TrustboError, match="there is no mission 4 to set aside; 3 were told"):
        campaign.set_aside("again", 4)
    assert "3 told, 0 not learned from yet, 1 set aside" in repr(campaign)
    campaign.fail("rain")
    assert "1 set aside, 1 given up" in repr(campaign)
    campaign.tell(missions[1])
    assert campaign.posterior["constant_data"].sizes["mission"] == 3
    only.tell(missions[0])
    assert only.set_aside("wrong field") is None
    assert only.posterior is None


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ([(0, 3), (1, 2), (2, 1), (3, 0)], r"starts at \(0, 3\), not at \(3, 0\)"),
        ([(3, 0), (1, 2), (0, 3)], r"no bound leads from"),
        ([(3, 0), (2, 1), (9, 9)], r"\(9, 9\) is outside the grid of 4 rows and 4 columns"),
    ],
)
def test_a_path_from_another_start_with_a_jump_or_off_the_grid_is_refused(
    workspace, tmp_path, path, said
):
    campaign = begin(workspace, tmp_path)
    campaign.suggest(DIAGONAL)
    n = len(path) - 1
    mission = Mission.from_arrays(path, np.full((n, 3, 2), 0.5), np.full((n, 3), 0.7))
    with pytest.raises(tb.TrustboError, match=said):
        campaign.tell(mission)
    assert campaign.missions == []
    assert not (tmp_path / "measured.nc").exists()


def test_another_path_than_the_one_asked_for_is_learned_from_too(workspace):
    campaign = begin(workspace)
    campaign.suggest(DIAGONAL)
    other = [(3, 0), (2, 0), (1, 1), (0, 2), (0, 3)]
    assert campaign.tell(rates(workspace, other)) is not None
    assert list(campaign.missions[0].path) == other


def test_a_mission_that_failed_on_its_way_is_of_the_path_asked_for(workspace):
    campaign = begin(workspace)
    campaign.suggest(DIAGONAL)
    part = Mission.from_arrays(DIAGONAL[:3], np.full((2, 3, 2), 0.5), np.eye(3)[:2], status="stuck")
    assert campaign.tell(part) is not None


def test_robots_and_features_are_put_in_order_by_their_names(workspace):
    campaign, shuffled = begin(workspace), begin(workspace)
    z, y = np.random.default_rng(0).uniform(size=(3, 3, 2)), np.eye(3) * 0.3 + 0.5
    order = [2, 0, 1]
    names = ["traversability", "visibility"]
    other = Mission.from_arrays(
        DIAGONAL, z[:, order][..., ::-1], y[:, order],
        duration=(10.0 + np.arange(9).reshape(3, 3))[:, order],
        features=names[::-1], robots=["r3", "r1", "r2"],
    )  # fmt: skip
    one = Mission.from_arrays(DIAGONAL, z, y, duration=10.0 + np.arange(9).reshape(3, 3))
    campaign.tell(one)
    shuffled.tell(other)
    for name in ("awareness", "contact_rate", "duration"):
        np.testing.assert_array_equal(
            getattr(shuffled.missions[0], name), getattr(campaign.missions[0], name)
        )
    stranger = Mission.from_arrays(DIAGONAL, z, y, robots=["r1", "r2", "r9"])
    with pytest.raises(
        tb.ShapeError, match=r"has robots \('r1', 'r2', 'r9'\), not \('r1', 'r2', 'r3'\)"
    ):
        campaign.tell(stranger)


def test_poses_and_states_follow_their_robots():
    terrain = hillside()
    workspace = tb.Workspace.from_terrain(terrain, (3, 3))
    mission = tb.simulation.KinematicSimulator(workspace).run([(2, 0), (1, 1)], seed=0)
    turned = mission.in_order(["r2", "r3", "r1"], mission.features)
    a, b = mission.bounds[0], turned.bounds[0]
    np.testing.assert_array_equal(b.poses[:, 0], a.poses[:, 0])  # the lead
    np.testing.assert_array_equal(b.poses[:, 1], a.poses[:, 2])
    np.testing.assert_array_equal(b.contact[:, 2], a.contact[:, 0])
    back = turned.in_order(mission.robots, mission.features).bounds[0]
    np.testing.assert_array_equal(back.poses, a.poses)
    with pytest.raises(tb.ShapeError, match="the mission has"):
        mission.in_order(["r1", "r2"], mission.features)


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ({"regret": "low"}, "regret must be a number, .* got 'low'"),
        ({"regret": None}, "regret must be a number, .* got None"),
        ({"regret": np.inf}, "regret must be a number, NaN where it is not known; got inf"),
        ({"regret": 10**400}, "regret must be a number, NaN where it is not known; got 1000"),
        ({"status": 1.0}, "'status' is a column of the history"),
        ({"row": 1.0}, "'row' is a column of the history"),
        ({"kish": 1.0}, "'kish' is a column of the history"),
        ({"a/b": 1.0}, "'a/b' cannot name a column; use letters, digits and _"),
        ({"=a": 1.0}, "'=a' cannot name a column"),
    ],
)
def test_what_is_told_beside_the_mission_is_checked_before(workspace, tmp_path, extra, said):
    campaign = begin(workspace, tmp_path)
    with pytest.raises(tb.TrustboError, match=said):
        campaign.tell(rates(workspace, campaign.ask().path), **extra)
    assert not (tmp_path / "measured.nc").exists()


def test_the_error_of_a_model_of_one_s_own_is_none_of_the_file(workspace, tmp_path):
    class Broken(tb.models.PooledTrust):
        """Fails from the second campaign on."""

        fails = False

        def options(self):
            if Broken.fails:
                raise ValueError("my own mistake")
            return super().options()

    with tb.Campaign(workspace, *ENDS, model=Broken(), sampler="nuts", directory=tmp_path):
        pass
    Broken.fails = True
    with pytest.raises(ValueError, match="my own mistake") as error:
        tb.Campaign.load(tmp_path, model=Broken())
    assert not isinstance(error.value, tb.TrustboError)


def test_a_number_that_is_not_known_is_missing_in_the_history_also_after_loading(
    workspace, tmp_path
):
    campaign = begin(workspace, tmp_path)
    for seed, regret in enumerate([np.nan, 2.5]):
        told = rates(workspace, campaign.ask().path, seed=seed)
        campaign.tell(told, regret=regret, fuel=np.nan)
    with campaign:
        pass
    history = tb.Campaign.load(tmp_path).result().history
    np.testing.assert_array_equal(history["regret"], [np.nan, 2.5])
    np.testing.assert_array_equal(history["fuel"], [np.nan, np.nan])


@pytest.mark.parametrize("policy", ["thompson", "random"])
def test_the_caller_s_jax_flags_do_not_change_a_campaign(workspace, policy):
    def paths(*flags):
        campaign = begin(workspace, policy=policy, seed=3)
        for j, x64 in enumerate(flags):
            with jax.enable_x64(x64), jax.threefry_partitionable(not x64):
                with jax.default_prng_impl("rbg" if x64 else "threefry2x32"):
                    campaign.tell(rates(workspace, campaign.ask().path, seed=j))
        return [entry.plan.path for entry in campaign.state.entries]

    assert paths(False, False, False, False) == paths(True, True, True, True)
    assert paths(False, False, False, False) == paths(False, True, False, True)


# --- damage ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    workspace = random_cells()
    path = tmp_path_factory.mktemp("campaign") / "kept"
    simulator = ModelSimulator(workspace, blind=True)
    tb.iterate(
        workspace, *ENDS, n_iterations=2, sampler="exact", simulator=simulator, checkpoint=path,
        progress=False,
    )  # fmt: skip
    return path


FILES = (
    "campaign.json", "measured.nc", "missions.nc", "history.nc", "workspace.nc", "result.json",
    "posteriors/0002.nc",
)  # fmt: skip


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("damage", ["missing", "empty", "half"])
def test_a_damaged_file_is_named(folder, tmp_path, name, damage):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    file = copy / name
    content = file.read_bytes()
    if damage == "missing":
        file.unlink()
    else:
        file.write_bytes(content[: len(content) // 2] if damage == "half" else b"")
    opens = {"result.json": [tb.load_result], "campaign.json": [tb.Campaign.load]}
    opens |= {"measured.nc": [tb.Campaign.load]}
    for load in opens.get(name, [tb.Campaign.load, tb.load_result]):
        with pytest.raises(tb.TrustboError) as error:
            params_of(load(copy).posterior)
        if damage == "missing" and name == "result.json":
            assert re.search("holds no result", str(error.value))
        else:
            assert isinstance(error.value, tb.DamagedFileError)
            assert name in str(error.value)
    if name != "measured.nc":  # which alone rebuilds the campaign, as the next test does
        kept, left = (tb.logs.read_missions(path / "measured.nc") for path in (folder, copy))
        for one, other in zip(kept, left, strict=True):
            np.testing.assert_array_equal(one.contact_rate, other.contact_rate)
            assert one.path == other.path


def test_awareness_along_a_path_fits_missions_and_filters(workspace):
    campaign, path = begin(workspace), DIAGONAL[1:]
    np.testing.assert_array_equal(campaign.known_along(path), workspace.along(path))
    live = tb.inference.TrustFilter(campaign.belief, 3)
    assert live.predict(campaign.known_along(path), path).mean.shape == (2, 3)
    for off, said in {(4, 0): r"\(4, 0\) is outside", (1, 3): "no bound leads from"}.items():
        with pytest.raises(tb.TrustboError, match=said):
            campaign.known_along([(3, 0), off])


def test_a_folder_that_may_not_be_written_to_is_named(workspace, folder, monkeypatch):
    def refuse_lock(self, *args, **kwargs):
        raise PermissionError(13, "Permission denied", self.lock_file)

    monkeypatch.setattr("trustbo.campaign.storage.FileLock.acquire", refuse_lock)
    with pytest.raises(tb.TrustboError, match=r"cannot write to .*: Permission denied; give a fol"):
        begin(workspace, folder.parent / "new")
    with pytest.raises(tb.TrustboError, match="cannot write to"):
        tb.Campaign.load(folder)


def test_a_campaign_is_rebuilt_from_the_missions_measured(folder):
    old = tb.load_result(folder)
    again = begin(old.workspace, objective="terminal", model=None)
    for mission in tb.logs.read_missions(folder / "measured.nc"):
        again.tell(mission)
    np.testing.assert_array_equal(
        again.posterior["posterior"]["b"], old.posterior["posterior"]["b"]
    )


def test_leftovers_of_dead_runs_are_removed(folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    dead = [
        copy / ".campaign.trustbo-4711.json",
        copy / "posteriors" / ".0002.trustbo-4711.nc",
    ]
    for file in dead:
        file.write_text("half")
    with tb.Campaign.load(copy):
        pass
    assert not any(file.exists() for file in dead)


# --- resuming means the same ---


def test_a_campaign_that_its_rule_has_ended_gives_back_its_result(workspace, tmp_path):
    rule = tb.RegretBound(eps=0.9, delta=0.9, min_missions=2, patience=1)
    simulator = ModelSimulator(workspace, blind=True)
    options = {"simulator": simulator, "progress": False}
    ended = tb.iterate(
        workspace, *ENDS, sampler="exact", objective="mean", n_iterations=5, stop=rule,
        checkpoint=tmp_path, **options,
    )  # fmt: skip
    n = len(ended.missions)
    assert (n < 5, ended.stop_reason[:12]) == (True, "regret_bound")
    again = tb.resume(tmp_path, **options)
    assert (len(again.missions), again.stop_reason) == (n, ended.stop_reason)
    assert tb.load_result(tmp_path).stop_reason == ended.stop_reason
    # Killed before its verdict was written: asked before anything is driven.
    state = json.loads((tmp_path / "campaign.json").read_text())
    (tmp_path / "campaign.json").write_text(json.dumps(state | {"stop_reason": "interrupted"}))
    again = tb.resume(tmp_path, stop=rule, **options)
    assert (len(again.missions), again.stop_reason) == (n, ended.stop_reason)
    # The rule, given again, or another that is satisfied, ends it before it drives.
    again = tb.resume(tmp_path, stop=rule, n_iterations=9, **options)
    assert (len(again.missions), again.stop_reason) == (n, ended.stop_reason)
    again = tb.resume(tmp_path, stop=lambda campaign: "seen enough", **options)
    assert (len(again.missions), again.stop_reason) == (n, "seen enough")
    assert tb.load_result(tmp_path).stop_reason == "seen enough"
    # Rules are not stored.
    assert len(tb.resume(tmp_path, n_iterations=n + 1, **options).missions) == n + 1


class Described(ModelSimulator):
    """A simulator whose settings are awkward to keep."""

    def __init__(self, workspace, **settings):
        super().__init__(workspace, blind=True)
        self.settings = settings

    def describe(self):
        return self.settings


def test_settings_of_a_simulator_survive_a_file(workspace, tmp_path):
    def settings(**changed):
        return {
            "tuple": (1, 2.5), "array": np.arange(3.0), "nan": float("nan"), "path": tmp_path,
            "team": tb.Team(2), "object": object(), "number": np.float32(0.1),
        } | changed  # fmt: skip

    tb.iterate(workspace, *ENDS, sampler="exact", n_iterations=1, checkpoint=tmp_path,
               simulator=Described(workspace, **settings()), progress=False)  # fmt: skip
    same, other = (Described(workspace, **settings(**c)) for c in ({}, {"tuple": (1, 2.6)}))
    with pytest.raises(tb.TrustboError, match=r"begun with tuple = \[1, 2.5\], not \[1, 2.6\]"):
        tb.resume(tmp_path, simulator=other, n_iterations=2, progress=False)
    assert len(tb.resume(tmp_path, simulator=same, n_iterations=2, progress=False).missions) == 2


@pytest.mark.parametrize(
    "changed",
    [
        {"team": tb.Team(robots=(tb.Robot(speed=1.0),) * 3)},
        {"terrain": tb.terrain.synthetic_terrain((120.0, 120.0), seed=9)},
        {"bound_timeout": 99.0},
        {"events": [tb.simulation.Degradation("r1", 0.4)]},
    ],
)
def test_the_description_of_the_simulator_is_complete(changed):
    terrain = hillside()
    workspace = tb.Workspace.from_terrain(terrain, (3, 3))
    before = {"events": [tb.simulation.Degradation("r1", 0.5)]}
    one = tb.simulation.KinematicSimulator(workspace, **before).describe()
    other = tb.simulation.KinematicSimulator(workspace, **before | changed).describe()
    told = [name.removeprefix("true_") for name in one if one[name] != other[name]]
    assert told == list(changed)


def test_a_simulator_of_version_0_1_is_known_by_its_name_then(workspace, tmp_path):
    class MujocoSimulator(ModelSimulator):
        pass

    simulator = MujocoSimulator(workspace, blind=True)
    tb.iterate(workspace, *ENDS, sampler="exact", n_iterations=1, checkpoint=tmp_path,
               simulator=simulator, progress=False)  # fmt: skip
    file = tmp_path / "campaign.json"
    text = file.read_text().replace('"MujocoSimulator"', '"MujocoBackend"')
    file.write_text(text)
    assert (
        len(tb.resume(tmp_path, simulator=simulator, n_iterations=2, progress=False).missions) == 2
    )


def test_a_long_campaign_keeps_the_parameters_alone(workspace, tmp_path):
    simulator = ModelSimulator(workspace, blind=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = tb.iterate(workspace, *ENDS, model=tb.models.PooledTrust(), n_iterations=4,
                            simulator=simulator, checkpoint=tmp_path, progress=False)  # fmt: skip
    sizes = [tree.nbytes for tree in result.posteriors]
    assert max(sizes) < 0.34e6  # 4000 draws of 6 numbers and 2 statistics, the prior, the hazard
    assert max(sizes) == min(sizes)  # they do not grow
    files = [file.stat().st_size for file in (tmp_path / "posteriors").glob("*.nc")]
    assert max(files) < 0.5e6
    assert result.posterior["latent"].sizes["mission"] == 4
    again = tb.inference.complete(result.posteriors[1], result.missions[:2])
    direct = fit(
        result.missions[:2],
        tb.models.PooledTrust(),
        sampler="exact",
        seed=int(result.posteriors[1].attrs["seed"]),
    )
    np.testing.assert_array_equal(again["latent"]["trust"], direct["latent"]["trust"])
