"""Motions: reading every common pose file, and writing caphy's own."""

from caphy.io.poses.canonical import write_poses
from caphy.io.poses.read import read_poses
from caphy.io.poses.sequence import Jump, PoseSequence, concatenate

__all__ = ["Jump", "PoseSequence", "concatenate", "read_poses", "write_poses"]
