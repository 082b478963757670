"""Reasons why a model has no exact evidence."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trustbo.models.model import TrustModel

_REFUSED: tuple[tuple[tuple[str, ...], set[str], str], ...] = (
    (
        ("coupled",),
        {"not Gaussian"},
        "its robots influence each other, and its observations are not Gaussian",
    ),
    (("other",), set(), "its robots share some parameters only, or influence each other"),
    (("each",), {"places"}, "it has effects of places, and robots with nothing else in common"),
)
"""Models without an evidence: their `robot_sets`, () for any, what they have, and the reason."""


def why_not_exact(model: "TrustModel") -> str | None:
    """Reason why the exact sampler cannot treat a model; None if it can."""
    family, sets = model.family, model.robot_sets
    traits = {"not Gaussian": not family.integrates_out, "places": model.place is not None}
    mine = {name for name, has in traits.items() if has}
    reasons = (why for of, what, why in _REFUSED if sets in (of or (sets,)) and what <= mine)
    return next(reasons, None)
