"""A mission's film: frames are the mission's ticks."""

import sys

import imageio_ffmpeg
import numpy as np
import pytest
from matplotlib.animation import writers
from matplotlib.colors import to_hex
from PIL import Image

import trustbo as tb
from trustbo.plots.animation import SEEN, UNSEEN


@pytest.fixture(scope="module")
def mission(result):
    return result.missions[0]


def test_a_frame_shows_where_robots_are_and_who_sees_the_lead(result, mission):
    animation = tb.plots.animate_mission(mission, result.workspace, speedup=10.0)
    near, overview, bars = animation._fig.axes
    bound, grid = mission.bounds[0], result.workspace.grid
    corner = np.array([grid.left, grid.top - 90.0])
    seen_by, ticks = np.unique(bound.contact, axis=0, return_index=True)
    assert len(ticks) >= 4  # who sees the lead changes, so that robots cannot be mixed up
    np.testing.assert_array_equal([seen_by.any(0), seen_by.all(0)], [[True] * 3, [False] * 3])
    for tick, contact in zip(ticks, seen_by, strict=True):
        animation._func(int(tick))
        lead, *robots = bound.poses[tick, :, :2] - corner
        shown = {line.get_label(): np.ravel(line.get_data()) for line in near.lines}
        for name, place in zip(("lead", "r1", "r2", "r3"), (lead, *robots), strict=True):
            np.testing.assert_allclose(shown[name], place)
        assert [text.get_text() for text in bars.get_yticklabels()] == ["r1", "r2", "r3"]
        rates = bound.contact[: tick + 1].mean(0)
        for i, (place, seen) in enumerate(zip(robots, contact, strict=True)):
            color = SEEN if seen else UNSEEN
            (sight,) = [line for line in near.lines if is_between(line, lead, place)]
            assert (sight.get_color(), sight.get_linestyle()) == (color, "-" if seen else "--")
            (bar,) = [b for b in bars.patches if b.get_y() < i < b.get_y() + b.get_height()]
            assert bar.get_width() == pytest.approx(rates[i])
            assert to_hex(bar.get_facecolor()) == color
            assert bar.get_hatch() == ("" if seen else "////")
    animation._func(len(bound.contact) - 1)  # the bound's last tick
    np.testing.assert_allclose([bar.get_width() for bar in bars.patches], bound.contact_rate)
    n_ticks = sum(len(b.contact) for b in mission.bounds)
    animation._func(n_ticks - 1)
    assert near.get_title().endswith(f"bound {len(mission.bounds)} of {len(mission.path) - 1}: ok")
    assert overview.images
    animation._draw_was_started = True  # nobody will: matplotlib would warn


def is_between(line, one, other):
    """Whether a line joins two points."""
    ends = np.transpose(line.get_data())
    return ends.shape == (2, 2) and np.allclose(ends, [one, other])


def test_all_robots_stay_in_sight_of_the_camera(result, mission):
    animation = tb.plots.animate_mission(mission, result.workspace)
    near = animation._fig.axes[0]
    corner = np.array([result.workspace.grid.left, result.workspace.grid.top - 90.0])
    poses = np.concatenate([bound.poses[..., :2] for bound in mission.bounds]) - corner
    for tick in range(0, len(poses), 7):
        animation._func(tick)
        low, high = np.transpose([near.get_xlim(), near.get_ylim()])
        assert ((poses[tick] > low) & (poses[tick] < high)).all()
    animation._draw_was_started = True


def test_a_gif_has_a_frame_for_each_step_of_the_film(result, mission, tmp_path):
    path = tmp_path / "mission.gif"
    span = mission.bounds[-1].t1
    tb.plots.animate_mission(mission, result.workspace, path, speedup=span, fps=4, dpi=40)
    with Image.open(path) as film:
        assert film.n_frames == 5  # four in the one second it lasts, and the end
        assert film.info["duration"] == 250
    assert [file.name for file in tmp_path.iterdir()] == ["mission.gif"]


@pytest.mark.slow
def test_an_mp4_can_be_played(result, mission, tmp_path):
    path = tmp_path / "mission.mp4"
    span = mission.bounds[-1].t1
    tb.plots.animate_mission(mission, result.workspace, path, speedup=span, fps=4, dpi=41)
    frames, _ = imageio_ffmpeg.count_frames_and_secs(path)
    assert frames == 5


def test_without_poses_there_is_nothing_to_show(result, tmp_path):
    mission = tb.Mission.from_arrays([(0, 0), (0, 1)], np.full((1, 3, 2), 0.5), [[0.5] * 3])
    with pytest.raises(tb.TrustboError, match="bound 1 has no poses or contact of its ticks"):
        tb.plots.animate_mission(mission, result.workspace, tmp_path / "mission.gif")
    with pytest.raises(tb.TrustboError, match=r"unknown suffix '.avi'; choose one of .gif, .mp4"):
        tb.plots.animate_mission(mission, result.workspace, tmp_path / "mission.avi")
    assert list(tmp_path.iterdir()) == []


def test_an_mp4_without_ffmpeg_says_what_to_do(result, mission, tmp_path, monkeypatch):
    monkeypatch.setattr(writers, "is_available", lambda name: False)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    message = r"an \.mp4 needs ffmpeg: .*-m pip install imageio-ffmpeg; a \.gif does not"
    with pytest.raises(tb.TrustboError, match=message):
        tb.plots.animate_mission(mission, result.workspace, tmp_path / "mission.mp4")
    span = mission.bounds[-1].t1
    animation = tb.plots.animate_mission(mission, result.workspace, speedup=span / 2, fps=1)
    with pytest.raises(tb.TrustboError, match=message):
        animation.save(tmp_path / "mission.mp4")
    with pytest.raises(tb.TrustboError, match=r"unknown suffix '.avi'; choose one of .gif, .mp4"):
        animation.save(tmp_path / "mission.avi")
    assert list(tmp_path.iterdir()) == []
    animation.save(tmp_path / "mission.gif", dpi=30)
    with Image.open(tmp_path / "mission.gif") as film:
        assert film.info["duration"] == 1000
