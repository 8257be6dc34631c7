"""How far an estimate of a filmed motion is from the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caphy.conventions import BODY_JOINT_COUNT, JOINT_NAMES
from caphy.io.bundle import AvatarBundle
from caphy.rotations import matrix_from_axis_angle
from service.engine import GarmentEngine

LIMBS = {"arm": ("shoulder", "elbow"), "leg": ("hip", "knee")}
BONES = {"arm": (("shoulder", "elbow"), ("elbow", "wrist")), "leg": (("hip", "knee"), ("knee", "ankle"))}
_SETTLED = 10
"""Frames at the beginning that are not counted: both garments are still falling into place."""


@dataclass(frozen=True, eq=False)
class Motion:
    """poses: (T, 55, 3) [rad]. transl: (T, 3) [m]. Both of one world."""

    poses: np.ndarray
    transl: np.ndarray


def joint_error(bundle: AvatarBundle, found: Motion, true: Motion) -> float:
    """Mean distance of the 22 joints after the best rigid alignment of every frame [mm]."""
    a, b = _joints(bundle, found), _joints(bundle, true)
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("tji,tjk->tik", b, a))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return 1e3 * float(np.linalg.norm(a @ np.swapaxes(u @ vt, 1, 2) - b, axis=-1).mean())


def joint_angles(found: Motion, true: Motion, limb: str) -> float:
    """Mean angle between the joints' rotations, against their parents, of a limb's two joints on both sides [deg]."""
    joints = [JOINT_NAMES.index(f"{side}_{name}") for side in ("left", "right") for name in LIMBS[limb]]
    turned = (matrix_from_axis_angle(motion.poses[:, joints]) for motion in (found, true))
    return float(_angles(*turned).mean())


def bone_angles(bundle: AvatarBundle, found: Motion, true: Motion, limb: str) -> float:
    """Mean angle between the directions of a limb's two bones on both sides, in space [deg]."""
    a, b = _joints(bundle, found), _joints(bundle, true)
    errors = []
    for side in ("left", "right"):
        for start, end in BONES[limb]:
            i, j = JOINT_NAMES.index(f"{side}_{start}"), JOINT_NAMES.index(f"{side}_{end}")
            u, v = a[:, j] - a[:, i], b[:, j] - b[:, i]
            cosine = np.einsum("tc,tc->t", u, v) / np.linalg.norm(u, axis=1) / np.linalg.norm(v, axis=1)
            errors.append(np.degrees(np.arccos(cosine.clip(-1, 1))))
    return float(np.mean(errors))


def dressed(bundle: AvatarBundle, motion: Motion) -> dict[str, np.ndarray]:
    """Garments (T, V, 3) [m] that the avatar's networks make of a motion."""
    inputs = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    engines = (GarmentEngine(garment) for garment in bundle.garments)
    return {engine.name: engine.run(*inputs, engine.initial_state())[0] for engine in engines}


def vertex_error(
    bundle: AvatarBundle,
    found: Mapping[str, np.ndarray],
    found_motion: Motion,
    true: Mapping[str, np.ndarray],
    true_motion: Motion,
) -> float:
    """Mean distance of garment vertices, pelvis on pelvis [mm]."""
    moved = (found_motion.transl - true_motion.transl)[:, None]
    errors = [np.linalg.norm(found[name] - moved - true[name], axis=-1)[_SETTLED:].ravel() for name in true]
    return 1e3 * float(np.concatenate(errors).mean())


def jitter(found: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray], fps: float) -> float:
    """Root mean square difference of the vertices' accelerations from the true ones [m/s^2]."""
    differences = [np.diff(found[name].astype(np.float64) - true[name], n=2, axis=0)[_SETTLED:] for name in true]
    return fps**2 * float(np.sqrt(np.mean([np.mean(np.sum(d**2, axis=-1)) for d in differences])))


def lag(found: Motion, true: Motion, fps: float) -> float:
    """How much later the found motion is [s]: the shift at which its joints' angles come nearest to the true ones."""
    a, b = (matrix_from_axis_angle(motion.poses[:, 1:BODY_JOINT_COUNT]) for motion in (found, true))
    shifts = np.arange(-6, 7)
    scores = np.array([_angles(a[6 + s : len(a) - 6 + s], b[6 : len(b) - 6]).mean() for s in shifts])
    best = int(scores.argmin().clip(1, len(shifts) - 2))
    left, middle, right = scores[best - 1 : best + 2]
    return float(shifts[best] + (left - right) / (2 * (left - 2 * middle + right))) / fps


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (...,) between rotations (..., 3, 3) [deg]."""
    trace = np.einsum("...ij,...ij->...", a, b)
    return np.degrees(np.arccos(((trace - 1) / 2).clip(-1, 1)))


def _joints(bundle: AvatarBundle, motion: Motion) -> np.ndarray:
    transforms = bundle.transforms(motion.poses, motion.transl)[:, :BODY_JOINT_COUNT]
    return np.einsum("tjab,jb->tja", transforms[..., :3], bundle.joints[:BODY_JOINT_COUNT]) + transforms[..., 3]
