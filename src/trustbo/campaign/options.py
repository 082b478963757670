"""Options of a campaign: one frozen object, checked when it is made.

Its import is fast, as `trustbo --help` is made from its fields.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Self, cast

from trustbo.errors import TrustboError, require_choice, require_known, unknown

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign
    from trustbo.data import Mission
    from trustbo.hazard import Hazard
    from trustbo.planning import Policy

    Callback = Callable[[Campaign, Mission], None]

POLICY, OBJECTIVE, SAMPLER = "greedy", "lost_contact", "auto"
"""Defaults of keywords that are no options; commands and studies have the same."""
PLANNING, LEARNING, RUNNING = "planning", "learning", "running"
_CUSTOM = ("callbacks",)
"""Options that are objects which a folder cannot hold."""


def _option(group: str, *choices: str) -> dict[str, Any]:
    return {"part": group, "choices": choices}


@dataclass(frozen=True, kw_only=True)
class CampaignOptions:
    """Options of a campaign, in addition to its model, policy, objective, sampler and seed.

    `iterate` and `Campaign` take them one by one, or all as `options=CampaignOptions(...)`. The
    flags of `trustbo run` and the options of studies are made from the fields; the help of a flag
    is the first sentence of its entry here.

    Attributes:
        connectivity: Number of directions of a bound: 8, or 4 for no diagonal bounds.
        max_bounds: Admissible paths: shortest, shortest+n, or the most bounds allowed. See
            `Planner`, also for the default.
        team: Trust of the team, the mean or the min of its robots'.
        length_weight: Cost of a metre of the path, in units of the objective. See `Planner`.
        unseen_cost: Cost of a bound in which nobody sees anybody, in units of the objective. See
            `Planner`; it needs a terrain.
        max_failure: Largest chance that a mission fails; where no path keeps within it, the
            safest is taken, with a warning. By default no limit.
        failure_cost: Cost of a failure for lost_contact, in bounds. By default 0 until a mission
            has failed, then all bounds of the shortest path, see `Planner`.
        initial: Source of the first plan: prior_mean, or prior_draw (one random draw of the prior,
            as in the paper).
        hazard: Priors of the chance that a bound fails. A `hazard.Hazard`, or some of its fields
            by name.
        n_chains: Number of chains of NUTS; draws of other samplers are divided among them.
        warmup: Warm-up draws of each chain of NUTS, by default those of `fit`.
        draws: Draws kept of each chain, 1000 by default; 250 of the exact sampler with places.
        target_accept: Acceptance rate of NUTS, .9 by default; towards 1 it takes smaller steps.
        max_tree_depth: Doublings of a trajectory of NUTS at most, 10 by default.
        callbacks: Functions `callback(campaign, mission)`, called after each mission by `iterate`
            and `Campaign.run`.

    Raises:
        TrustboError: An unknown name, or a number outside its range.
    """

    connectivity: int = field(default=8, metadata=_option(PLANNING))
    max_bounds: int | str | None = field(default=None, metadata=_option(PLANNING))
    team: str = field(default="mean", metadata=_option(PLANNING, "mean", "min"))
    length_weight: float = field(default=0.0, metadata=_option(PLANNING))
    unseen_cost: float = field(default=0.0, metadata=_option(PLANNING))
    max_failure: float | None = field(default=None, metadata=_option(PLANNING))
    failure_cost: float | None = field(default=None, metadata=_option(PLANNING))
    initial: str = field(
        default="prior_mean", metadata=_option(LEARNING, "prior_mean", "prior_draw")
    )
    hazard: "Hazard | Mapping[str, Any]" = field(default_factory=dict, metadata=_option(LEARNING))
    n_chains: int | None = field(default=None, metadata=_option(LEARNING))
    warmup: int | None = field(default=None, metadata=_option(LEARNING))
    draws: int | None = field(default=None, metadata=_option(LEARNING))
    target_accept: float | None = field(default=None, metadata=_option(LEARNING))
    max_tree_depth: int | None = field(default=None, metadata=_option(LEARNING))
    callbacks: "Sequence[Callback]" = field(default=(), metadata=_option(RUNNING))

    def __post_init__(self) -> None:
        from trustbo.inference.samplers.settings import NutsSettings

        for option in fields(self):
            choices = option.metadata["choices"]
            if choices:
                require_choice(option.name, getattr(self, option.name), choices)
        NutsSettings.of(self.sampling)
        object.__setattr__(self, "hazard", _hazard_of(self.hazard))
        object.__setattr__(self, "callbacks", tuple(self.callbacks))
        for callback in self.callbacks:
            if not callable(callback):
                raise TrustboError(f"callbacks must be callables; got {callback!r}.")

    @classmethod
    def from_keywords(
        cls, given: Mapping[str, Any], call: Callable[..., Any] | None = None
    ) -> Self:
        """Make options from keywords, or return the object that is passed as `options`.

        TrustboError: an unknown option, with similar names, those of keywords of `call` included;
        or options in addition to the object.
        """
        if "options" not in given:
            names = [option.name for option in fields(cls)]
            for name in given:
                if name not in names:
                    keywords = getattr(call, "__kwdefaults__", None) or {}
                    raise unknown("option", name, [*names, *keywords])
            return cls(**given)
        whole, *others = given["options"], *(name for name in given if name != "options")
        if others or not isinstance(whole, cls):
            raise TrustboError(
                "give options=CampaignOptions(...), or options one by one; got options="
                f"{whole!r}{' and ' if others else ''}{', '.join(others)}."
            )
        return whole

    @property
    def prior_hazard(self) -> "Hazard":
        """Priors of the chance that a bound fails."""
        return cast("Hazard", self.hazard)

    @property
    def sampling(self) -> dict[str, Any]:
        """Options of draws that are given, by the names of `tb.fit`."""
        names = ("n_chains", "warmup", "draws", "target_accept", "max_tree_depth")
        given = {name: getattr(self, name) for name in names}
        return {name: value for name, value in given.items() if value is not None}

    def to_record(self) -> dict[str, Any]:
        """JSON-serialisable options, without callbacks."""
        record = {o.name: getattr(self, o.name) for o in fields(self) if o.name != "callbacks"}
        priors = asdict(self.prior_hazard).items()
        record["hazard"] = {n: list(v) if isinstance(v, tuple) else v for n, v in priors}
        return record


PLANNING_OPTIONS = [o.name for o in fields(CampaignOptions) if o.metadata["part"] == PLANNING]


def _hazard_of(given: "Hazard | Mapping[str, Any]") -> "Hazard":
    """Priors of a hazard, given as such or by name; TrustboError: neither, or an unknown name."""
    from trustbo.hazard import Hazard

    if isinstance(given, Hazard):
        return given
    if not isinstance(given, Mapping):
        raise TrustboError(f"hazard must be a hazard.Hazard, or some of its fields; got {given!r}.")
    require_known("prior of the hazard", given, [prior.name for prior in fields(Hazard)])
    return Hazard(**given)


def arguments_of(
    record: Mapping[str, Any], policy: "Policy | None", **custom: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Restore the arguments of `Campaign`, and the record of its model.

    `record` is the field `options` of `CampaignState`; a missing option has its default. A custom
    policy must be passed again, any other is refused; callbacks are optional.
    """
    require_known("option of one's own", custom, _CUSTOM)
    record = dict(record)
    given: dict[str, Any] = {name: tuple(record.pop(name)) for name in ("start", "goal")}
    given["policy"] = _restored("policy", record.pop("policy"), policy, record.pop("own_policy"))
    given |= {name: record.pop(name) for name in ("objective", "sampler", "seed")}
    model = record.pop("model")
    return given | {"options": CampaignOptions.from_keywords({**record, **custom})}, model


def _restored(name: str, stored: Any, given: Any, custom: bool) -> Any:
    """Return the stored value, or the custom object where it could not be stored."""
    if custom and given is None:
        raise TrustboError(
            f"the campaign's {name} was your own ({stored!r}); give it again with {name}=."
        )
    if given is not None and not custom:
        raise TrustboError(f"the campaign's {name} is {stored!r}, none of your own; leave {name}=.")
    return stored if given is None else given
