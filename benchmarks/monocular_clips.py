"""The clips of the monocular benchmark: parts of real motion capture, filmed by three cameras, and their truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.monocular_film import FOCAL, HEIGHT, WIDTH, Eye, Film, eye_towards, write_video
from caphy.io.bundle import AvatarBundle
from caphy.io.poses import read_poses
from caphy.rotations import matrix_from_axis_angle
from service.engine import GarmentEngine

FPS = 30.0
SECONDS = 3.2

CLIPS: dict[str, tuple[str, float]] = {
    "jumps": ("bvh/01_01.bvh", 1.0),
    "walk": ("bvh/02_01.bvh", 0.0),
    "turning walk": ("bvh_from_expmap/train_walking_extra_walking_23.bvh", 1.0),
    "kneeling dance": ("bvh/131_01.bvh", 2.0),
    "basketball": ("bvh_from_expmap/test_basketball_basketball_1.bvh", 0.5),
    "soccer": ("bvh_from_expmap/test_soccer_soccer_1.bvh", 0.5),
    "traffic": ("bvh_from_expmap/train_directing_traffic_directing_traffic_1.bvh", 8.1),
    "squats": ("bvh_from_expmap/train_jumping_jumping_2.bvh", 2.0),
}
"""Name: file below the folder of CMU clips, and where the part begins [s]. None of these parts has a jump in it."""

CAMERAS: dict[str, tuple[float, float, float]] = {
    "front": (15.0, 1.4, 0.0),
    "high": (-50.0, 2.4, 3.0),
    "low": (70.0, 0.9, -4.0),
}
"""Azimuth against where the body faces in the mean [degrees], height [m], roll [degrees]."""


@dataclass(frozen=True, eq=False)
class Clip:
    """What really happened. poses: (T, 55, 3) [rad]. transl: (T, 3) [m]. garments: vertices (T, V, 3) [m] by name."""

    name: str
    poses: np.ndarray
    transl: np.ndarray
    garments: dict[str, np.ndarray]


def read_clips(folder: Path, bundle: AvatarBundle, names: tuple[str, ...] = ()) -> Iterator[Clip]:
    """The clips of ``names``, all by default, on the avatar's body, dressed by its own networks."""
    engines = {garment.name: GarmentEngine(garment) for garment in bundle.garments}
    for name, (file, begin) in CLIPS.items():
        if names and name not in names:
            continue
        motion = read_poses(folder / file).to_y_up(bundle.joints[0]).resample(FPS)
        motion = motion[round(begin * FPS) : round((begin + SECONDS) * FPS)]
        middle = (motion.transl.min(axis=0) + motion.transl.max(axis=0)) / 2
        transl = motion.transl - middle * [1, 0, 1]
        inputs = motion.poses.astype(np.float32), transl.astype(np.float32)
        worn = {n: engine.run(*inputs, engine.initial_state())[0] for n, engine in engines.items()}
        yield Clip(name, motion.poses, transl, worn)


def place_camera(clip: Clip, joints: np.ndarray, camera: str) -> Eye:
    """The named camera, as near as it may stand with every posed joint (T, 55, 3) well inside the picture."""
    forward = matrix_from_axis_angle(clip.poses[:, 0])[:, :, 2].mean(axis=0)
    azimuth, height, roll = CAMERAS[camera]
    azimuth += np.degrees(np.arctan2(forward[0], forward[2]))
    target = (joints.min(axis=(0, 1)) + joints.max(axis=(0, 1))) / 2
    low, high = np.array([0.07 * WIDTH, 0.1 * HEIGHT]), np.array([0.93 * WIDTH, 0.9 * HEIGHT])
    for distance in np.arange(2.6, 6.7, 0.1):
        eye = eye_towards(target, azimuth, height, distance, roll)
        pixels = eye.pixels(joints)
        inside = (pixels[..., :2] > low).all() and (pixels[..., :2] < high).all()
        if inside and (pixels[..., 2] > 0.5).all():
            break
    return eye


def film(clip: Clip, bundle: AvatarBundle, camera: str, video: Path) -> None:
    """Write ``video`` and its truth beside it (.npz), unless both are there."""
    truth = video.with_suffix(".npz")
    if video.exists() and truth.exists():
        return
    transforms = bundle.transforms(clip.poses, clip.transl)
    joints = np.einsum("tjab,jb->tja", transforms[..., :3], bundle.joints) + transforms[..., 3]
    eye = place_camera(clip, joints, camera)
    studio = Film(eye, bundle)
    partial = video.with_name("partial_" + video.name)
    pictures = (
        studio.frame(transforms[t], {name: worn[t] for name, worn in clip.garments.items()})
        for t in range(len(clip.poses))
    )
    write_video(partial, pictures, FPS)
    np.savez(
        truth,
        poses=clip.poses,
        transl=clip.transl,
        eye=eye.position,
        axes=eye.axes,
        focal=FOCAL,
        **{f"garment_{name}": worn.astype(np.float32) for name, worn in clip.garments.items()},
    )
    partial.replace(video)
