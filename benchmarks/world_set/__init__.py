"""Worlds of the benchmarks: terrains on which truth and assumptions differ in known ways."""

from world_set.cases import available, worlds
from world_set.world import COURSES, REAL, World, drawn

__all__ = ["COURSES", "REAL", "World", "available", "drawn", "worlds"]
