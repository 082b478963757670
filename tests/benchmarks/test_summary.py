"""Numbers of campaigns and differences of paired ones, by hand."""

import numpy as np
import pandas as pd
import pytest
from summary import differences, numbers_of, summary


def table_by_hand():
    """Two scenes, two seeds on each, of three cases, three missions each."""
    shift, level = {"ours": 0.0, "good": -2.0, "bad": 3.0}, {"a": 4.0, "b": 8.0}
    rows = []
    for case in shift:
        for scene in level:
            for seed in (0, 1):
                regret = level[scene] + seed + shift[case]
                for mission in range(4):
                    known = mission > 0
                    rows.append({
                        "case": case, "scene": scene, "seed": seed, "kind": scene.upper(),
                        "mission": mission, "regret": regret if known else 10.0,
                        "lost": 2.0, "best": 0.5, "status": "ok" if mission != 2 else "stuck",
                        "contact_rate": 0.5, "driven": regret / 4.0 + mission if known else np.nan,
                        "best_driven": float(mission) if known else np.nan,
                        "failed_driven": 7.0 if known else np.nan,
                        "seconds": 3.0 if case == "ours" else 1.5,
                    })  # fmt: skip
    return pd.DataFrame(rows)


def test_numbers_of_a_run_are_those_of_its_missions():
    numbers = numbers_of(table_by_hand())
    assert len(numbers) == 12
    run = numbers[(numbers["case"] == "ours") & (numbers["scene"] == "b") & (numbers["seed"] == 1)]
    (row,) = run.to_dict("records")
    assert row["kind"] == "B"
    assert row["regret after 0"] == 10.0
    assert row["regret after 3"] == 9.0
    assert row["regret now"] == pytest.approx((10.0 + 3 * 9.0) / 4)
    assert row["lost after 1"] == 1.5
    assert row["lost while learning"] == pytest.approx(9.0 / 4.0)
    assert row["lost with failures"] == 7.0
    assert row["missions to 1 %"] == 4.0
    assert row["arrive"] == row["arrive of the first 3"] == pytest.approx(2 / 3)
    assert np.isnan(row["arrive later"])


def test_runs_without_a_label_are_not_left_out():
    table = table_by_hand()
    table["case"] = table["case"].where(table["case"] != "bad")  # as pandas reads "None" in a file
    table.loc[table["scene"] == "a", "kind"] = np.nan

    numbers = numbers_of(table)
    assert len(numbers) == 12
    assert len(summary(numbers)) == 3
    assert len(summary(numbers, by="kind")) == 2
    assert len(differences(numbers, "ours", by=["kind"])) == 4  # two cases and two kinds


@pytest.mark.parametrize(("regret", "until"), [([9, 9, 0], 2), ([0, 9, 0], 2), ([0, 0, 0], 0)])
def test_a_campaign_is_near_when_it_stays_so(regret, until):
    table = table_by_hand().iloc[:3].assign(regret=regret)
    assert numbers_of(table)["missions to 1 %"].item() == until


def test_differences_are_of_the_same_scene_and_seed():
    shuffled = numbers_of(table_by_hand()).sample(frac=1.0, random_state=0)
    table = differences(shuffled, "ours")
    assert sorted(table.index) == ["bad", "good"]
    for column in ("value", "low", "high"):  # the same everywhere, though scenes differ by 4
        assert table.loc["good", ("regret after 3", column)] == pytest.approx(2.0)
        assert table.loc["bad", ("regret after 3", column)] == pytest.approx(-3.0)
        assert table.loc["bad", ("lost while learning", column)] == pytest.approx(-0.75)
    assert table.loc["good", ("seconds", "value")] == pytest.approx(1.5)
    assert table.loc["good", ("pairs", "value")] == 4
    by_kind = differences(shuffled, "ours", "kind")
    assert set(by_kind.index) == {(kind, case) for kind in "AB" for case in ("good", "bad")}
    assert np.isnan(by_kind["regret now", "low"]).all()  # one cluster


def test_intervals_are_those_of_a_bootstrap_over_clusters():
    rng, rows = np.random.default_rng(1), []
    for scene in range(12):
        regret = rng.normal(5.0, 1.0)
        rows += [table_by_hand().iloc[:4].assign(scene=str(scene), regret=regret, seed=s)
                 for s in range(3)]  # fmt: skip
    numbers = numbers_of(pd.concat(rows))
    low, high = summary(numbers)["regret now"][["low", "high"]].to_numpy().ravel()
    sd = numbers.groupby("scene")["regret now"].mean().std()
    assert (high - low) / (2 * 1.96) == pytest.approx(sd / np.sqrt(12), rel=0.25)


def test_scenes_without_truth_have_no_regret():
    table = table_by_hand()
    judged = ["regret", "lost", "best", "driven", "best_driven", "failed_driven"]
    table.loc[table["scene"] == "a", judged] = np.nan

    numbers = numbers_of(table).set_index("scene")
    of_truth = [name for name in numbers if "regret" in name or "lost" in name or "to 1" in name]
    assert numbers.loc["a", of_truth].isna().all(axis=None)
    np.testing.assert_allclose(numbers["arrive"], 2 / 3)
    assert numbers.loc["b", of_truth].equals(
        numbers_of(table_by_hand()).set_index("scene").loc["b", of_truth]
    )
