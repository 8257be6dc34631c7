"""A person who is seen perfectly, or with chosen faults: landmarks projected from poses, and no pictures needed."""

from __future__ import annotations

import numpy as np

from caphy.io.bundle import AvatarBundle
from service.clients.monocular.landmarks import LANDMARKS, Landmarks
from service.clients.monocular.skeleton import Skeleton

SIZE, FOCAL = (1280, 720), 1000.0
HIPS = [LANDMARKS.index("left_hip"), LANDMARKS.index("right_hip")]
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""A level camera's axes, as rows, in a world whose z axis points at it."""


def landmark_places(bundle: AvatarBundle, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Where the landmarks are (T, 33, 3) [m], by the package's own kinematics."""
    skeleton = Skeleton.of(bundle.joints)
    transforms = bundle.transforms(poses, transl)[:, skeleton.carrier]
    return np.einsum("tsab,sb->tsa", transforms[..., :3], skeleton.sites) + transforms[..., 3]


def into_camera(points: np.ndarray, axes: np.ndarray = UPRIGHT, distance: float = 4.0) -> np.ndarray:
    """Points (..., 3) in a camera ``distance`` [m] in front of the origin, at hip height."""
    eye = -distance * axes[2]
    return (points - eye) @ axes.T


def seen(
    points: np.ndarray,
    random: np.random.Generator | None = None,
    pixel_noise: float = 0.0,
    space_noise: float = 0.0,
    visibility: np.ndarray | None = None,
) -> Landmarks:
    """What a detector says of landmarks (33, 3) [m] in the camera; noise [pixels] and [m]."""
    random = random or np.random.default_rng(0)
    pixels = FOCAL * points[:, :2] / points[:, 2:] + np.array(SIZE) / 2
    middle = points[HIPS].mean(axis=0)
    forward = middle / np.linalg.norm(middle)
    right = np.cross([0.0, 1.0, 0.0], forward)  # the frame whose third axis is the ray through the person
    right /= np.linalg.norm(right)
    world = (points - middle) @ np.stack([right, np.cross(forward, right), forward]).T
    return Landmarks(
        pixels + random.normal(0, pixel_noise, pixels.shape),
        world + random.normal(0, space_noise, world.shape),
        np.ones(len(LANDMARKS)) if visibility is None else visibility,
    )
