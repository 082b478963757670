"""Choice of the sampler of a model's posterior."""

from trustbo.errors import TrustboError, require_choice
from trustbo.inference.samplers.exact import why_not_conjugate
from trustbo.inference.samplers.scores import why_no_quantiles
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.models.model import TrustModel

SAMPLERS = ("auto", "exact", "nuts")


def require_sampler(model: TrustModel, sampler: str) -> None:
    """Refuse a sampler that cannot treat the model.

    Raises:
        TrustboError: The sampler is `"exact"`, and `TrustModel.why_not_exact` or a prior gives a
            reason; or it is `"nuts"`, and the rates are not Gaussian.
    """
    if sampler == "exact" and (reason := model.why_not_exact):
        remedy = ' Use sampler="auto".' if model.family.integrates_out else ""
        raise TrustboError(f'sampler "exact" cannot treat {model.describe()}: {reason}.{remedy}')
    alone = model.effects or model.memory != "level"  # the evidence alone has these
    if sampler == "exact" and (reason := why_not_priors(model)):
        remedy = "Give others" if alone else 'Use sampler="nuts", which takes any'
        raise TrustboError(f'sampler "exact": {reason}. {remedy}.')
    if sampler == "nuts" and alone and (reason := why_not_scores(model)):
        remedy = "" if model.why_not_exact or why_not_priors(model) else ' Use sampler="exact".'
        raise TrustboError(f'sampler "nuts" cannot treat {model.describe()}: {reason}.{remedy}')
    if sampler == "nuts" and not model.family.integrates_out:
        raise TrustboError(
            f'sampler "nuts" is for Gaussian rates, and observation is "{model.observation}". Use '
            'sampler="exact", or MCMC(NUTS(model.numpyro_model(missions))) of NumPyro.'
        )


def resolve_sampler(model: TrustModel, sampler: str) -> tuple[str, str]:
    """The sampler to use, and why: for `"auto"` the exact one where it applies, else NUTS.

    Raises:
        TrustboError: See `require_sampler`.
    """
    require_sampler(model, require_choice("sampler", sampler, SAMPLERS))
    if sampler != "auto":
        return sampler, "asked for"
    reason = model.why_not_exact or why_not_priors(model)
    if reason is None:
        by = "" if model.family.integrates_out else " by expectation propagation, and weights"
        return "exact", f"trust and coefficients integrate out{by}"
    if model.memory != "level":
        raise TrustboError(
            f'no sampler can treat {model.describe()}: {reason}. Give memory="level", or others of '
            "these."
        )
    if model.effects:
        raise TrustboError(
            f"no sampler can treat {model.describe()}: {reason}. Give a model without effects of "
            f"{model.effects[0].noun}, or other priors."
        )
    if not model.family.integrates_out:
        raise TrustboError(
            f"no sampler can treat {model.describe()}: {reason}. Use "
            "MCMC(NUTS(model.numpyro_model(missions))) of NumPyro."
        )
    return "nuts", reason


def why_not_scores(model: TrustModel) -> str | None:
    """Reason why no evidence serves NUTS of scores alone; None if one does.

    It is for Gaussian rates, robots whose coefficients are columns, and priors of scores.
    """
    if reason := model.why_not_exact:
        return reason
    if not model.family.integrates_out:
        return "its observations are not Gaussian"
    if model.robot_sets not in ("all", "each", "pooled"):
        return "its robots influence each other"
    pooled = model.robot_sets == "pooled"
    return why_not_conjugate(model.priors) or why_no_quantiles(model.priors, partial_pooling=pooled)


def with_warmup(settings: NutsSettings, model: TrustModel) -> NutsSettings:
    """Settings with the default warm-up of a model: half of it for scores, of known metric."""
    warmup = NutsSettings().warmup
    return settings._replace(warmup=warmup if why_not_scores(model) else warmup // 2)


def why_not_priors(model: TrustModel) -> str | None:
    """Reason why a model's priors do not suit its evidence or scores; None if they do."""
    coupled, pooled = model.robot_sets == "coupled", model.robot_sets == "pooled"
    if reason := why_not_conjugate(model.priors, coupled=coupled):
        return reason
    return None if by_sums(model) else why_no_quantiles(model.priors, partial_pooling=pooled)


def by_sums(model: TrustModel) -> bool:
    """Whether the exact sampler needs no more of missions than their sums (`evidence.gram`)."""
    alone = model.place is None and not model.effects and model.memory == "level"
    return alone and model.family.integrates_out and model.robot_sets in ("all", "each")


def needs_evidence(model: TrustModel, sampler: str) -> bool:
    """Whether a sampler integrates effects out by the evidence of all of them."""
    if model.effects or model.memory != "level":
        return True
    return model.place is not None and why_not_scores(model) is None


def slow_places(reason: str) -> str:
    """Text of the warning that NUTS samples effects of places, with the reason."""
    return (
        f"effects of places are sampled by NUTS, as {reason}: minutes for some 10 missions. Fast "
        "are PooledTrust(place=...) and the same model with place=None."
    )


def faster_than_nuts(model: TrustModel) -> str:
    """Advice on what takes less time than NUTS on this model."""
    if resolve_sampler(model, "auto")[0] == "exact":
        return 'sampler "exact" takes seconds'
    return "fewer draws or chains take less"
