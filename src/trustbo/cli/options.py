"""Flags that commands share, and their help."""

import inspect
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import typer

from trustbo.campaign.options import LEARNING, PLANNING, RUNNING, CampaignOptions
from trustbo.cli.config import read_config

PLACE, TEAM, PATHS, MODEL, MISSIONS, PROGRAM = (
    "Terrain and grid", "Robots and sight", "Paths", "Learning", "Missions", "Program",
)  # fmt: skip
_PANELS = {PLANNING: PATHS, LEARNING: MODEL, RUNNING: MISSIONS}
_METAVARS = {int: "N", float: "X", str: "NAME", type(None): "VALUE"}


def _option(panel: str, text: str, *names: str, **more: Any) -> Any:
    return typer.Option(*names, help=text, rich_help_panel=panel, **more)


def with_campaign_options[Command: Callable[..., None]](command: Command) -> Command:
    """Give a command's `**options` a flag for each field of `CampaignOptions` that can be typed."""
    signature = inspect.signature(command)
    parameters = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    entries = re.findall(
        r"^    (\w+): (.+?\.)(?=\s)", inspect.cleandoc(CampaignOptions.__doc__ or ""), re.M | re.S
    )
    texts = {name: " ".join(text.split()) for name, text in entries}
    for option in fields(CampaignOptions):
        kind = type(option.default)
        if kind not in _METAVARS:
            continue
        panel, text = _PANELS[option.metadata["part"]], texts.get(option.name, "")
        parser = _whole_or_name if option.default is None else None
        flag = _option(panel, text, metavar=_METAVARS[kind], parser=parser)
        of_flag: Any = {"default": option.default, "annotation": Annotated[kind, flag]}
        parameters.append(inspect.Parameter(option.name, inspect.Parameter.KEYWORD_ONLY, **of_flag))
    command.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore
    return command


def _whole_or_name(text: str) -> int | str:
    return int(text) if text.isdigit() else text


# --- terrain and grid ---
Dem = Annotated[
    Path, _option(PLACE, "Heights of the ground (DEM), e.g. a GeoTIFF.", metavar="FILE")
]
Dsm = Annotated[
    Path | None,
    _option(
        PLACE,
        "Heights of the canopy (DSM) of the same place; without one, no canopy is known.",
        metavar="FILE",
    ),
]
Start = Annotated[str, _option(PLACE, "First cell; row 0 is in the north.", metavar="ROW,COL")]
Goal = Annotated[str, _option(PLACE, "Last cell.", metavar="ROW,COL")]
Shape = Annotated[str, _option(PLACE, "Planning grid.", metavar="ROWS,COLS")]
Crs = Annotated[
    str | None, _option(PLACE, "CRS of rasters that carry none, e.g. EPSG:32633.", metavar="CRS")
]
Resolution = Annotated[
    float | None, _option(PLACE, "Pixel size of rasters that carry none.", metavar="M")
]

# --- robots and sight ---
Robots = Annotated[int, _option(TEAM, "Number of robots that overwatch the lead.", metavar="N")]
MaxSlope = Annotated[float, _option(TEAM, "Steepest slope that robots can drive.", metavar="DEG")]
LidarRange = Annotated[
    float, _option(TEAM, "Range within which robots track each other.", metavar="M")
]
SightMode = Annotated[
    str,
    _option(
        TEAM,
        "Obstacles to sight: bare (the ground), wall (canopy too), transmittance (canopy dims it).",
        metavar="MODE",
    ),
]

# --- paths ---
Objective = Annotated[
    str,
    _option(
        PATHS,
        "Objective of a path: terminal (trust at the goal, as in the paper), mean (on the way), "
        "success (of every bound), bottleneck (the least on the way), stationary.",
        metavar="NAME",
    ),
]

# --- learning ---
Policy = Annotated[
    str,
    _option(
        MODEL,
        "Choice of the next path: greedy, optimistic, thompson, information, ucb, ei, "
        "epsilon_greedy, cvar, random.",
        metavar="NAME",
    ),
]
Model = Annotated[
    str,
    _option(
        MODEL,
        "Trust model: robots are alike (pooled), similar (hierarchical), or influence each other "
        "(coupled).",
        metavar="NAME",
    ),
]
Observation = Annotated[
    str,
    _option(
        MODEL,
        "Family of contact rates: gaussian (as in the paper), censored, beta_binomial.",
        metavar="NAME",
    ),
]
Sampler = Annotated[
    str,
    _option(
        MODEL,
        "Sampler of the posterior: nuts; exact (importance sampling, which need not compile; "
        "pooled only); joint (nuts, for other than gaussian).",
        metavar="NAME",
    ),
]

# --- missions ---
Iterations = Annotated[
    int, _option(MISSIONS, "Number of missions to run and learn from.", metavar="N")
]
StopRegret = Annotated[
    float | None,
    _option(
        MISSIONS,
        "Stop when the path is within this share of the best with probability 0.9, e.g. 0.05.",
        metavar="SHARE",
    ),
]
Seed = Annotated[int, _option(MISSIONS, "Seed of everything random.", metavar="N")]

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
Quiet = Annotated[bool, _option(PROGRAM, "Show no progress bar and no table.", "--quiet", "-q")]
Debug = Annotated[bool, _option(PROGRAM, "Show the whole traceback of an error.", "--debug")]
Folder = Annotated[Path, typer.Argument(help="Folder of the campaign's results.", metavar="FOLDER")]
Total = Annotated[
    int | None,
    _option(
        MISSIONS, "Number of missions in all; by default as many as it was begun for.",
        "--iterations", metavar="N",
    ),
]  # fmt: skip
OutFile = Annotated[
    Path | None,
    _option(
        PROGRAM, "File of the page; by default report.html in the folder.", "--out", metavar="FILE"
    ),
]
Title = Annotated[str | None, _option(PROGRAM, "Title of the page.", metavar="TEXT")]
Formats = Annotated[
    list[str],
    typer.Option(
        "--format",
        help="Format, given once for each: geotiff, cog, netcdf (maps); geojson, gpx, geopackage "
        "(the path); csv (path and missions); ros_map, ros1_bag, ros2_bag (cost and path); or all "
        "that can be written.",
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
    Path, typer.Argument(help="Study in YAML; see docs/studies.md.", metavar="CONFIG")
]
StudyOut = Annotated[
    Path, _option(PROGRAM, "Folder for the results, made if need be.", "--out", metavar="FOLDER")
]
Executor = Annotated[
    str,
    typer.Option(
        help="Executor of the runs: serial, loky, dask, or a scheduler's address, tcp://host:8786.",
        metavar="NAME",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        help="Number of processes of loky or dask; by default one for each core.", metavar="N"
    ),
]
