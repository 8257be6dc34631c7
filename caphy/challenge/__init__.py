"""Measurements with a hidden effect: made by a simulator of their own, answered by a sealed envelope."""

from caphy.challenge.hidden import HIDDEN, NOTHING, ONE, OUTSIDE, PAIRS, Hidden
from caphy.challenge.world import SCENES, World, make

__all__ = ["HIDDEN", "NOTHING", "ONE", "OUTSIDE", "PAIRS", "SCENES", "Hidden", "World", "make"]
