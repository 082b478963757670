"""Settings of a study, checked before any work starts, and its table of runs."""

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self

from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER, CampaignOptions
from trustbo.errors import TrustboError, require_choice, require_whole
from trustbo.files import FilePath, read_yaml
from trustbo.inference.samplers.choice import SAMPLERS, resolve_sampler
from trustbo.planning import OBJECTIVES, POLICIES
from trustbo.study.parts import MODELS, SIMULATORS, parts_of
from trustbo.study.run import Run
from trustbo.study.terrains import TERRAINS

OPTIONS = (
    *(option.name for option in fields(CampaignOptions) if option.name != "callbacks"),
    "stop",
)
"""Names in `Study.options`."""


@dataclass(frozen=True)
class Study:
    """Every policy with every objective, model, sampler, simulator, terrain, option and seed.

    Terrains, simulators and models are given as a mapping of your own names to settings, the `kind`
    among them; or as a list of kinds, with their defaults. See docs/studies.md.

    Attributes:
        terrains: Terrains of the kinds `synthetic`, `files`, `random`.
        policies: Names in `planning.POLICIES`.
        objectives: Names in `planning.OBJECTIVES`.
        models: Models of the kinds `pooled`, `places`, `hierarchical`, `coupled`, `own`.
        samplers: `"auto"`, `"exact"`, `"nuts"`, `"joint"`.
        simulators: Simulators of the kinds `kinematic`, `model`.
        seeds: Seeds, or their number: 0, 1, ...
        n_iterations: Missions of a run.
        options: Fields of `CampaignOptions` but callbacks, and `stop`, the settings of a
            `RegretBound`; a list of values means each of them.

    Raises:
        TrustboError: An unknown name or setting, or an impossible value.
    """

    terrains: Any
    policies: Any = (POLICY,)
    objectives: Any = (OBJECTIVE,)
    models: Any = ("pooled",)
    samplers: Any = (SAMPLER,)
    simulators: Any = ("kinematic",)
    seeds: Any = 1
    n_iterations: int = 8
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        keep = object.__setattr__
        for name, kinds in (("terrain", TERRAINS), ("simulator", SIMULATORS), ("model", MODELS)):
            keep(self, f"{name}s", parts_of(name, getattr(self, f"{name}s"), kinds))
        for what, plural, choices in (
            ("policy", "policies", POLICIES),
            ("objective", "objectives", OBJECTIVES),
            ("sampler", "samplers", SAMPLERS),
        ):
            names = _listed(plural, getattr(self, plural))
            keep(self, plural, tuple(require_choice(what, name, choices) for name in names))
        seeds = self.seeds
        if not isinstance(seeds, list | tuple | range):
            seeds = range(require_whole("seeds (how many, or a list)", seeds, 1))
        seeds = [require_whole("seed", seed, 0) for seed in _listed("seeds", list(seeds))]
        keep(self, "seeds", tuple(seeds))
        keep(self, "n_iterations", require_whole("n_iterations", self.n_iterations, 1))
        keep(self, "options", _options(self.options))
        for name, model in self.models.items():
            for sampler in self.samplers:
                try:
                    resolve_sampler(model.model(), sampler)
                except TrustboError as error:
                    raise TrustboError(f"model {name!r}: {error}") from None

    @classmethod
    def of(cls, configuration: "Study | Mapping[str, Any]") -> Self:
        """Study with these settings.

        Raises:
            TrustboError: The settings are no mapping, or one of them is unknown.
        """
        if isinstance(configuration, cls):
            return configuration
        if not isinstance(configuration, Mapping):
            raise TrustboError(f"a study is a Study or a mapping; got {configuration!r}.")
        known = [f.name for f in fields(cls)]
        for name in configuration:
            require_choice("setting of a study", name, known)
        if "terrains" not in configuration:
            raise TrustboError("a study needs terrains, e.g. terrains: [random].")
        return cls(**configuration)

    def runs(self) -> list[Run]:
        """List the runs, seed by seed, so that the first to end are of every kind."""
        axes: dict[str, Any] = {
            "seed": self.seeds,
            "terrain": self.terrains,
            "simulator": self.simulators,
            "model": self.models,
            "sampler": self.samplers,
            "objective": self.objectives,
            **self.options,
            "policy": self.policies,
        }
        return [
            self._run(dict(zip(axes, values, strict=True)))
            for values in itertools.product(*axes.values())
        ]

    def _run(self, labels: dict[str, Any]) -> Run:
        return Run(
            labels,
            self.terrains[labels["terrain"]].at(labels["seed"]),
            self.simulators[labels["simulator"]],
            self.models[labels["model"]],
            labels["policy"],
            labels["objective"],
            labels["sampler"],
            labels["seed"],
            self.n_iterations,
            {name: labels[name] for name in self.options},
        )

    def settings(self) -> dict[str, Any]:
        """Settings as JSON can hold them; `Study.of` reads them."""
        own: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        for name in ("terrains", "simulators", "models"):
            own[name] = {label: part.settings() for label, part in own[name].items()}
        return own


def read_study(path: FilePath) -> Study:
    """Read a study from a YAML file; paths of rasters are relative to its folder.

    Raises:
        TrustboError: No such file, no YAML, or settings that `Study` refuses.
    """
    file = Path(path)
    configuration = read_yaml(file)
    try:
        if isinstance(configuration, Mapping):
            configuration = _with_paths_from(file.parent, dict(configuration))
        return Study.of(configuration)
    except TrustboError as error:
        raise TrustboError(f"{file}: {error}") from None


def _with_paths_from(folder: Path, configuration: dict[str, Any]) -> dict[str, Any]:
    terrains = configuration.get("terrains")
    if isinstance(terrains, Mapping):
        configuration["terrains"] = {
            name: {
                key: str(folder / value) if key in ("dem", "dsm") else value
                for key, value in settings.items()
            }
            if isinstance(settings, Mapping)
            else settings
            for name, settings in terrains.items()
        }
    return configuration


def _listed(what: str, values: object) -> Sequence[Any]:
    """List of distinct values, at least one."""
    listed = list(values) if isinstance(values, list | tuple) else [values]
    if not listed or len({repr(value) for value in listed}) < len(listed):
        raise TrustboError(f"{what} must be at least one, and distinct; got {listed}.")
    return listed


def _options(options: object) -> dict[str, tuple[Any, ...]]:
    """Values of each option."""
    if not isinstance(options, Mapping):
        raise TrustboError(f"options must be a mapping of names to values; got {options!r}.")
    for name, value in options.items():
        require_choice("option", name, OPTIONS)
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            raise TrustboError(
                f"option {name!r} must be a number, a name, or a list of these; got {value!r}."
            ) from None
    return {name: tuple(_listed(name, value)) for name, value in options.items()}
