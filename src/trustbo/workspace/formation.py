"""Formation: the rules of the lead's stops and of the posts of T2."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from trustbo.errors import TrustboError, require_choice, require_not_negative, require_positive

SPACING = 2.0
"""Least distance between two robots of T2, m."""
POSTS, STOPS = ("end", "way"), ("centre", "sight")
_RADII = {"end": 8.0, "way": 25.0}
_DISCOUNT = 0.005  # 1/m
_DOUBT, _DOUBT_REACH = 0.1, 40.0  # share of the unexpected that is seen at 0 m; its reach, m


@dataclass(frozen=True)
class Formation:
    """Rules of the lead's stops and of the posts of T2, see `posts`.

    Attributes:
        posts: `"end"`: where T2 sees the lead's next stop, inside the lead's cell. `"way"`: where
            it sees the lead's whole way, and is seen from its stops.
        stops: `"centre"`: on easy ground near the centre of the cell. `"sight"`: where most of the
            ways to the stops around is seen.
        radius: Largest distance of T2 from the lead's stop, m.
        discount: Rate at which sight is taken to fall with distance in the choice of posts and
            stops, 1/m: maps lack things that block sight.
    """

    posts: str = "way"
    stops: str = "sight"
    radius: float = _RADII["way"]
    discount: float = _DISCOUNT

    @classmethod
    def of(cls, posts: str, stops: str, radius: float | None, discount: float | None) -> Self:
        """Check the options of `Workspace.from_terrain`; None for the rules' own.

        Raises:
            TrustboError: An unknown rule, a radius below the robots' least distance, or a negative
                discount.
        """
        require_choice("posts", posts, POSTS)
        require_choice("stops", stops, STOPS)
        radius = _RADII[posts] if radius is None else require_positive("formation_radius", radius)
        if radius < SPACING:
            raise TrustboError(
                f"formation_radius must be at least {SPACING:g} m, the least distance between two "
                f"robots; got {radius:g}."
            )
        if discount is None:
            discount = 0.0 if (posts, stops) == ("end", "centre") else _DISCOUNT
        kept = require_not_negative("sight_discount", discount)
        return cls(posts, stops, radius, kept)

    def doubted(self, seen: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Chance of detection where maps may be wrong; that of the map without a discount.

        A share exp(-discount x distance) of what is expected to be seen is, and of the rest a share
        that falls with distance.
        """
        if not self.discount:
            return seen
        kept = seen * np.exp(-self.discount * distance)
        return kept + _DOUBT * np.exp(-distance / _DOUBT_REACH) * (1.0 - kept)

    @property
    def is_wide(self) -> bool:
        """Whether posts are up to 25 m away: ways keep clear of obstacles, and may be long."""
        return self.posts == "way"
