"""Motions: reading every common pose file, and writing caphy's own."""

from caphy.io.poses.canonical import write_poses
from caphy.io.poses.ground import on_ground, placed_on
from caphy.io.poses.read import read_poses
from caphy.io.poses.sequence import Jump, PoseSequence, concatenate

__all__ = ["Jump", "PoseSequence", "concatenate", "on_ground", "placed_on", "read_poses", "write_poses"]
