"""The options that commands share, and what their help says."""

from pathlib import Path
from typing import Annotated, Any

import typer

from trustbo.cli.config import read_config

WHERE, TEAM, PATHS, LEARNING, LENGTH, PROGRAM = (
    "Where", "Who, and what they see", "Which path is good", "How it learns", "How long it goes on",
    "This program",
)  # fmt: skip


def _option(panel: str, text: str, *names: str, **more: Any) -> Any:
    return typer.Option(*names, help=text, rich_help_panel=panel, **more)


# --- where ---
Dem = Annotated[
    Path, _option(WHERE, "Heights of the ground (DEM), e.g. a GeoTIFF.", metavar="FILE")
]
Dsm = Annotated[
    Path, _option(WHERE, "Heights of the canopy (DSM), of the same place.", metavar="FILE")
]
Start = Annotated[str, _option(WHERE, "First cell; row 0 is the north.", metavar="ROW,COL")]
Goal = Annotated[str, _option(WHERE, "Last cell.", metavar="ROW,COL")]
Shape = Annotated[str, _option(WHERE, "Planning grid.", metavar="ROWS,COLS")]
Crs = Annotated[
    str | None, _option(WHERE, "Of rasters that carry none, e.g. EPSG:32633.", metavar="CRS")
]
Resolution = Annotated[
    float | None, _option(WHERE, "Pixel size of rasters that do not say it.", metavar="M")
]

# --- who ---
Robots = Annotated[int, _option(TEAM, "How many overwatch the lead.", metavar="N")]
MaxSlope = Annotated[float, _option(TEAM, "Steepest slope they stand.", metavar="DEG")]
LidarRange = Annotated[float, _option(TEAM, "How far they track each other.", metavar="M")]
SightMode = Annotated[
    str,
    _option(
        TEAM,
        "What blocks sight: bare (the ground), wall (canopy too), transmittance (canopy dims it).",
        metavar="MODE",
    ),
]

# --- paths ---
Objective = Annotated[
    str,
    _option(
        PATHS,
        "terminal (trust at the goal, as in the paper), mean (on the way), success (that every "
        "bound succeeds), bottleneck (the least on the way), stationary.",
        metavar="NAME",
    ),
]
TeamTrust = Annotated[
    str, _option(PATHS, "The team's trust is the mean or the min of its robots'.", metavar="NAME")
]
Connectivity = Annotated[int, _option(PATHS, "8, or 4 for no diagonal bounds.", metavar="N")]
MaxBounds = Annotated[
    str | None,
    _option(PATHS, "shortest, shortest+2, or the most bounds allowed.", metavar="BOUNDS"),
]

# --- learning ---
Policy = Annotated[
    str,
    _option(
        LEARNING,
        "How the next path is chosen: greedy, optimistic, thompson, information, ucb, ei, "
        "epsilon_greedy, cvar, random.",
        metavar="NAME",
    ),
]
Model = Annotated[
    str,
    _option(
        LEARNING,
        "Robots are alike (pooled), similar (hierarchical), or influence each other (coupled).",
        metavar="NAME",
    ),
]
Observation = Annotated[
    str,
    _option(
        LEARNING,
        "What contact rates are: gaussian (as in the paper), censored, beta_binomial.",
        metavar="NAME",
    ),
]
Sampler = Annotated[
    str,
    _option(
        LEARNING,
        "nuts; exact (importance sampling, which need not compile; pooled only); joint (nuts, for "
        "other than gaussian).",
        metavar="NAME",
    ),
]
Awareness = Annotated[
    str,
    _option(
        LEARNING, "Trust the awareness map (map), or let missions correct it (belief).",
        metavar="NAME",
    ),
]  # fmt: skip

# --- how long ---
Iterations = Annotated[
    int, _option(LENGTH, "How many missions to run and learn from.", metavar="N")
]
StopRegret = Annotated[
    float | None,
    _option(
        LENGTH,
        "Stop when the path is within this share of the best with probability 0.9, e.g. 0.05.",
        metavar="SHARE",
    ),
]
Replan = Annotated[
    str, _option(LENGTH, "Plan again after each mission, or each bound.", metavar="WHEN")
]
Seed = Annotated[int, _option(LENGTH, "Same seed, same result.", metavar="N")]

# --- program ---
Config = Annotated[
    Path | None,
    _option(
        PROGRAM,
        "Read flags from a YAML file, e.g. [b]max-slope: 30[/b]; flags given here win.",
        callback=read_config,
        is_eager=True,
        metavar="FILE",
    ),
]
Out = Annotated[
    Path,
    _option(
        PROGRAM,
        "Folder for the results, made if need be; not one that holds a campaign.",
        metavar="FOLDER",
    ),
]
Overwrite = Annotated[
    bool, _option(PROGRAM, "Replace the campaign that the folder holds.", "--overwrite")
]
Quiet = Annotated[bool, _option(PROGRAM, "No progress bar, no table.", "--quiet", "-q")]
Debug = Annotated[bool, _option(PROGRAM, "Show the whole traceback of an error.", "--debug")]
Folder = Annotated[Path, typer.Argument(help="Folder of the campaign's results.", metavar="FOLDER")]
Total = Annotated[
    int | None,
    _option(
        LENGTH, "How many missions in all; by default as many as it was begun for.",
        "--iterations", metavar="N",
    ),
]  # fmt: skip
OutFile = Annotated[
    Path | None,
    _option(PROGRAM, "The page; by default report.html in the folder.", "--out", metavar="FILE"),
]
Title = Annotated[str | None, _option(PROGRAM, "Title of the page.", metavar="TEXT")]
Formats = Annotated[
    list[str],
    typer.Option(
        "--format",
        help="geotiff, cog, netcdf (maps); geojson, gpx, geopackage (the path); csv (path and "
        "missions); ros_map, ros1_bag, ros2_bag (cost and path); or all that can be written. Give "
        "it once for each.",
        metavar="NAME",
    ),
]
OutFolder = Annotated[
    Path | None,
    _option(
        PROGRAM, "Folder for the files; by default the result's.", "--out", metavar="FOLDER"
    ),
]  # fmt: skip
ExportResolution = Annotated[
    float | None,
    typer.Option(
        "--resolution",
        help="Pixel size of maps for ROS; by default a cell, or a tenth of its shorter side where "
        "cells are not square.",
        metavar="M",
    ),
]

# --- of a study ---
StudyConfig = Annotated[
    Path, typer.Argument(help="The study, in YAML; see docs/studies.md.", metavar="CONFIG")
]
StudyOut = Annotated[
    Path, _option(PROGRAM, "Folder for the results; made if need be.", "--out", metavar="FOLDER")
]
Executor = Annotated[
    str,
    typer.Option(
        help="serial, loky, dask, or a scheduler's address, tcp://host:8786.", metavar="WHERE"
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(help="Processes of loky or dask; by default one for each core.", metavar="N"),
]
