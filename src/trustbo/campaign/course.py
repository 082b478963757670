"""Course of a mission: from where to where, and which robots watch."""

from typing import Any, NamedTuple, Self

from trustbo.data import Cell, path_text
from trustbo.planning import Plan


class Course(NamedTuple):
    """What a campaign is asked for.

    Attributes:
        start: First cell.
        goal: Last cell.
        robots: Robots of T2 that take part, in the order of the team.
        closed: Closed cells and bounds with their reasons, as in `Workspace.closed`.
    """

    start: Cell
    goal: Cell
    robots: tuple[str, ...]
    closed: tuple[tuple[tuple[Cell, ...], str], ...] = ()

    @classmethod
    def of(cls, plan: Plan) -> Self:
        """Return the course of a plan."""
        return cls(plan.start, plan.goal, plan.robots, tuple(plan.workspace.closed.items()))

    @property
    def ends(self) -> tuple[Cell, Cell]:
        """Start and goal."""
        return self.start, self.goal

    def to_row(self) -> dict[str, Any]:
        """Return the columns of the table of missions, as text."""
        return {
            "start": path_text([self.start]),
            "goal": path_text([self.goal]),
            "robots": ", ".join(self.robots),
        }
