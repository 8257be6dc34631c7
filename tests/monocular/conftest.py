"""The avatar and a motion that the monocular client's tests share."""

from __future__ import annotations

from pathlib import Path

import pytest

import caphy
from caphy.io.bundle import AvatarBundle, read_bundle
from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion


@pytest.fixture(scope="session")
def bundle() -> AvatarBundle:
    return read_bundle(Path(caphy.__file__).parent / "data" / "avatars" / "default")


@pytest.fixture(scope="session")
def motion(bundle: AvatarBundle) -> PoseSequence:
    """Three seconds of a made-up motion about the origin, its limbs as far as made-up motions turn them."""
    made = procedural_motion(seed=3, seconds=3.0, fps=30.0)
    middle = made.transl.mean(axis=0) + bundle.joints[0]
    return PoseSequence(made.poses, made.transl - middle, made.fps, pelvis=bundle.joints[0])
