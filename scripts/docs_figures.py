"""Draws the figures of the documentation from what `make demo` left in out/demo."""

import io
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import trustbo as tb
from trustbo import plots

mpl.use("Agg")
FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"


def main() -> None:
    """Draw them all."""
    result = tb.load_result("out/demo")
    workspace, mean = result.workspace, tb.models.params_of(result.posterior).mean()
    cost = result.planner.cost_map(mean, per_robot=True)
    drawn = {
        "maps": result.plot_maps(),
        "terrain": plots.terrain_maps(workspace),
        "path_posterior": [
            plots.path_posterior(result.maps()["path_probability"], workspace, result.path)
        ],
        "robot_maps": plots.robot_maps(cost, workspace, result.path, n_columns=3),
        "mission_trust": plots.mission_trust(result.posterior),
        "plan_trust": plots.plan_trust(result.plan, workspace.team.names),
        "parameter_history": plots.parameter_history(result.posteriors),
        "campaign_history": plots.campaign_history(result.history),
        "loadings": plots.loadings(workspace.composites),
        "calibration": plots.calibration(tb.models.sbc(n_datasets=100)),
    }
    for name, axes in drawn.items():
        save(axes[0].figure, name)
    film = plots.animate_mission(result.missions[-1], workspace)
    contact = np.concatenate([bound.contact for bound in result.missions[-1].bounds])
    divided = np.flatnonzero(contact.any(1) & ~contact.all(1))
    film._draw_frame(divided[len(divided) // 2])  # matplotlib has no public way to one frame
    film._draw_was_started = True
    save(film._fig, "animate_mission")


def save(figure: Figure, name: str) -> None:
    """Write a small PNG: 200 colours are enough on a page."""
    file = io.BytesIO()
    figure.savefig(file, dpi=85)
    plt.close(figure)
    Image.open(file).convert("RGB").quantize(200).save(FIGURES / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
