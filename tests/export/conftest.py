"""The shell avatar and a motion on it, as the service would answer it."""

from __future__ import annotations

import numpy as np
import pytest
from shell_avatar import shell_avatar, wiggle

from caphy.io.bundle import AvatarBundle
from caphy.io.poses import PoseSequence
from service.engine import GarmentEngine


@pytest.fixture(scope="session")
def bundle() -> AvatarBundle:
    return shell_avatar()


@pytest.fixture(scope="session")
def motion() -> PoseSequence:
    return wiggle(1.5, seed=3)


@pytest.fixture(scope="session")
def served(bundle: AvatarBundle, motion: PoseSequence) -> dict[str, np.ndarray]:
    """Vertices (T, V, 3) per garment."""
    poses, transl = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    engines = [GarmentEngine(garment) for garment in bundle.garments]
    return {engine.name: engine.run(poses, transl, engine.initial_state())[0] for engine in engines}
