"""Animation of a mission: robots on the terrain, lines of sight to the lead, contact."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter, writers
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from scipy.ndimage import uniform_filter1d

from trustbo.data import Mission, require_map
from trustbo.errors import TrustboError, pip_install, require_choice, require_kind, require_positive
from trustbo.files import FilePath, write_file
from trustbo.plots.layout import as_text, extent_of, plain
from trustbo.plots.maps import VEGETATION, draw_ground, draw_path, draw_scale
from trustbo.plots.style import MEDIUM, SMALL, theme
from trustbo.workspace import Workspace

SEEN, UNSEEN = "#009e73", "#d55e00"
"""Bluish green and vermilion of Okabe and Ito (2008); lines out of sight are also dashed."""
SUFFIXES = (".gif", ".mp4")
_SECONDS = 12.0  # default length of an animation
_EVEN = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
"""Even numbers of pixels, and a pixel format that every player supports."""
_STEADY = 21  # number of ticks over which the position of the camera is averaged
_DASHED, _DOTTED = (0, (3, 2)), (0, (1, 2))
_MARKERS = "osDv^Pp8hH"


class Film(NamedTuple):
    """State of a mission at each of its ticks."""

    time: np.ndarray  # (tick,), s since the mission's start
    bound: np.ndarray  # (tick,), number of the bound, from 1
    poses: np.ndarray  # (tick, 1 + robot, 2), m from the map's lower left corner, the lead first
    contact: np.ndarray  # (tick, robot), contact of the robot with the lead
    rate: np.ndarray  # (tick, robot), contact rate of the bound so far


def animate_mission(
    mission: Mission,
    workspace: Workspace,
    path: FilePath | None = None,
    *,
    speedup: float | None = None,
    fps: int = 8,
    dpi: int = 80,
) -> FuncAnimation:
    """Animate a mission: robots, lines of sight, and the contact rate of the bound so far.

    The left panel follows the team, over contour lines of the surface and vegetation; the right one
    shows the whole terrain. A line from a robot to the lead is green and solid during contact,
    else red and dashed; the bar of the robot is then filled or hatched. In a notebook,
    `HTML(animation.to_jshtml())` shows the animation.

    Args:
        mission: Mission with the poses and contact of every tick, from a simulator or a bag.
        workspace: Workspace of the mission.
        path: `.gif` or `.mp4` file to write. MP4 needs ffmpeg, or the extra `video`.
        speedup: Seconds of the mission per second of animation; the default makes it last 12 s.
        fps: Frames per second.
        dpi: Resolution of the file, dots per inch.

    Returns:
        Animation, with `save(path)`. If it was written to a file, its figure is closed.

    Raises:
        TrustboError: The mission has no poses, the suffix is another, a number is not positive, or
            there is no ffmpeg.
    """
    for value, kind in ((mission, Mission), (workspace, Workspace)):
        require_kind("plots.animate_mission", value, kind, "give a Mission and its Workspace")
    require_map("plots.animate_mission", [mission])
    target = None if path is None else Path(path)
    if target is not None:
        require_choice("suffix", target.suffix.lower(), SUFFIXES)
    require_positive("fps", fps)
    require_positive("dpi", dpi)
    if target is not None and target.suffix.lower() == ".mp4":
        _ffmpeg()
    film = _film(mission, workspace)
    span = float(film.time[-1] - film.time[0])
    rate = max(1.0, span / _SECONDS) if speedup is None else require_positive("speedup", speedup)
    shown = np.arange(film.time[0], film.time[-1] + rate / fps, rate / fps)
    ticks = np.minimum(np.searchsorted(film.time, shown), len(film.time) - 1)
    figure, draw = _stage(mission, workspace, film)
    animation = _Animation(figure, draw, frames=ticks.tolist(), interval=1000.0 / fps)
    animation.fps = fps
    if target is not None:
        try:
            animation.save(target, dpi=dpi)
        finally:
            plt.close(figure)
    return animation


class _Animation(FuncAnimation):
    """Animation that is saved as .gif or .mp4 by the writers at hand."""

    fps: int = 8

    def save(self, filename: Any, writer: Any = None, *args: Any, **options: Any) -> None:
        """Write a file; TrustboError: another suffix, or no ffmpeg for an .mp4."""
        path, fps = Path(filename), int(options.pop("fps", None) or self.fps)
        if writer is None:
            suffix = require_choice("suffix", path.suffix.lower(), SUFFIXES)
            writer = PillowWriter(fps) if suffix == ".gif" else FFMpegWriter(fps, extra_args=_EVEN)
        settings: dict[Any, Any] = (
            {"animation.ffmpeg_path": _ffmpeg()} if isinstance(writer, FFMpegWriter) else {}
        )
        with mpl.rc_context(settings):
            write_file(path, lambda file: FuncAnimation.save(self, file, writer, *args, **options))


def _film(mission: Mission, workspace: Workspace) -> Film:
    parts, corner = [], workspace.grid.corner
    for k, bound in enumerate(mission.bounds, start=1):
        if bound.poses is None or bound.contact is None:
            raise TrustboError(
                f"bound {k} has no poses or contact of its ticks; simulators and ROS bags record "
                "them, tables and arrays do not."
            )
        n = len(bound.contact)
        if not n:
            continue
        if not np.isfinite(bound.poses[..., :2]).all():
            raise TrustboError(f"bound {k} has a pose that is not known (NaN); fill it first.")
        time = bound.t0 + (bound.t1 - bound.t0) * np.arange(1, n + 1) / n
        rate = np.cumsum(bound.contact, axis=0) / np.arange(1, n + 1)[:, None]
        place = bound.poses[..., :2] - corner
        parts.append(Film(time, np.full(n, k), place, np.asarray(bound.contact, bool), rate))
    if not parts:
        raise TrustboError("the mission has no tick to show.")
    return Film(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _stage(mission: Mission, workspace: Workspace, film: Film):
    """Return the figure before the first frame, and the function that draws a tick on it."""
    figure, axes = plt.subplot_mosaic(
        [["near", "all"], ["near", "bars"]],
        figsize=(7.2, 4.8),
        width_ratios=(4.6, 2.2),
        height_ratios=(1.3, 1.0),
        layout="constrained",
    )
    near, bars = axes["near"], axes["bars"]
    way = np.array([workspace.grid.center(cell) for cell in mission.path]) - workspace.grid.corner
    for ax in (near, axes["all"]):
        draw_ground(ax, workspace)
        ax.plot(*way.T, color=theme().quiet, linewidth=1.0, linestyle=_DOTTED)
    draw_path(axes["all"], mission.path, workspace.grid)
    draw_scale(axes["all"], workspace.grid)
    frame = Rectangle((0, 0), 1, 1, fill=False, edgecolor=theme().ink, linewidth=1.2, zorder=9)
    axes["all"].add_patch(frame)
    team = _Team(near, mission.robots)
    names, edge = [as_text(name) for name in mission.robots], theme().ink
    heights = bars.barh(names, np.zeros(len(names)), height=0.6, edgecolor=edge, linewidth=0.6)
    bars.invert_yaxis()
    bars.set_xlim(0.0, 1.0)
    bars.set_xlabel("contact rate so far", fontsize=SMALL)
    plain(bars)
    center, half = _window(film, workspace)
    draw_scale(near, workspace.grid, width=2.0 * half)
    # Laid out once; the layout of each frame would take most of the time.
    figure.canvas.draw()
    figure.set_layout_engine("none")

    def draw(tick: int):
        team.place(film.poses[tick], film.contact[tick])
        for bar, rate, seen in zip(heights, film.rate[tick], film.contact[tick], strict=True):
            bar.set_width(rate)
            bar.set(facecolor=SEEN if seen else UNSEEN, hatch="" if seen else "////")
        (x, y), k = center[tick], int(film.bound[tick])
        near.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
        frame.set(x=x - half, y=y - half, width=2 * half, height=2 * half)
        clock = f"{film.time[tick]:.0f} s, bound {k} of {len(mission.path) - 1}"
        ended = tick == len(film.time) - 1
        near.set_title(clock + (f": {mission.status}" if ended else ""), fontsize=MEDIUM)
        return []

    return figure, draw


class _Team:
    """Markers of the robots, and the line from each to the lead."""

    def __init__(self, ax: Axes, names: Sequence[str]) -> None:
        style = {"markeredgecolor": "black", "linestyle": "none", "zorder": 5, "color": "white"}
        self.sight = [ax.plot([], [], linewidth=1.8, zorder=4)[0] for _ in names]
        markers = [_MARKERS[i % len(_MARKERS)] for i in range(len(names))]
        self.robots = [
            ax.plot([], [], marker=marker, markersize=8, label=name, **style)[0]
            for marker, name in zip(markers, names, strict=True)
        ]
        lead = style | {"color": "black", "markeredgecolor": "white", "zorder": 6}
        (self.lead,) = ax.plot([], [], marker="*", markersize=15, label="lead", **lead)
        handles, _ = ax.get_legend_handles_labels()
        lines = [
            Line2D([], [], color=SEEN, label="in contact"),
            Line2D([], [], color=UNSEEN, linestyle=_DASHED, label="no contact"),
            Line2D(
                [], [], color=theme().quiet, linestyle=_DOTTED, linewidth=1.0, label="planned path"
            ),
            Patch(facecolor=VEGETATION, label="vegetation"),
        ]
        ax.legend(handles=[*handles, *lines], loc="upper left", fontsize=SMALL, framealpha=0.85)

    def place(self, poses: np.ndarray, contact: np.ndarray) -> None:
        """Move the markers to the poses of a tick, the lead first."""
        (x, y), *others = poses
        for line, robot, pose, seen in zip(self.sight, self.robots, others, contact, strict=True):
            line.set_data([x, pose[0]], [y, pose[1]])
            line.set(color=SEEN if seen else UNSEEN, linestyle="-" if seen else _DASHED)
            robot.set_data([pose[0]], [pose[1]])
        self.lead.set_data([x], [y])


def _window(film: Film, workspace: Workspace) -> tuple[np.ndarray, float]:
    """Window around the team: its centre at each tick, shape (tick, 2), and half its width."""
    middle = (film.poses.min(1) + film.poses.max(1)) / 2.0
    # The camera does not jump where robots start or stop.
    center = uniform_filter1d(middle, min(_STEADY, len(middle)), axis=0, mode="nearest")
    reach = float(np.abs(film.poses - center[:, None]).max())
    left, right, bottom, top = extent_of(workspace.grid)
    return center, min(1.15 * reach + 3.0, max(right - left, top - bottom) / 2.0)


def _ffmpeg() -> str:
    """Return the path of ffmpeg: on the PATH, or in the package imageio-ffmpeg."""
    if writers.is_available("ffmpeg"):
        return str(mpl.rcParams["animation.ffmpeg_path"])
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        raise TrustboError(
            f"an .mp4 needs ffmpeg: {pip_install('imageio-ffmpeg')}; a .gif does not."
        ) from None
    return get_ffmpeg_exe()
