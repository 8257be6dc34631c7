"""SMPL-family parameters in one ``.npz``: AMASS SMPL-H, AMASS SMPL-X "stageii", and plain SMPL-X files.

AMASS (Mahmood et al., ICCV 2019) has z up and absolute hand rotations. Its SMPL-H files hold ``poses`` (T, 156),
``trans`` and ``mocap_framerate``; its SMPL-X files ``root_orient``, ``pose_body``, ``pose_hand``, ``pose_jaw``,
``pose_eye`` and, spelt otherwise, ``mocap_frame_rate``. Plain files use the ``smplx`` package's argument names.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.archive import Archive
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import mean_betas, poses_from_columns, require_fps, rest_pelvis
from caphy.rotations import matrix_from_axis_angle

RATES: Final = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate", "framerate")

PARTS: Final = (
    (("global_orient", "root_orient"), 0, 1),
    (("body_pose", "pose_body"), 1, 22),
    (("jaw_pose", "pose_jaw"), 22, 23),
    (("leye_pose",), 23, 24),
    (("reye_pose",), 24, 25),
    (("pose_eye",), 23, 25),
    (("left_hand_pose",), 25, 40),
    (("right_hand_pose",), 40, 55),
    (("pose_hand",), 25, 55),
)
"""Names of a part of the pose, and the range of SMPL-X joints it fills."""

UPRIGHT: Final = 0.7
"""Share of the trunk's length along an axis that tells which one is up."""


def read_smplx_npz(archive: Archive, fps: float | None = None, up: Literal["y", "z"] | None = None) -> PoseSequence:
    """The motion in an AMASS or SMPL-X parameter file, in the file's own axes.

    ``fps`` [Hz] and ``up`` override the file; raises :class:`CaphyError` where neither says.
    """
    where = str(archive.path)
    amass = any(name in archive for name in RATES[:2])
    poses, model, notes = _poses(archive)
    transl = _first(archive, ("transl", "trans"), where)
    if transl.size != 3 * len(poses) or (transl.ndim > 1 and transl.shape[0] != len(poses)):
        raise CaphyError(f"{where}: translation must be ({len(poses)}, 3) like the poses, got {transl.shape}")
    betas = None
    if "betas" in archive:
        betas, more = mean_betas(archive.floats("betas"), where)
        notes += more
    pelvis, more = rest_pelvis(model, archive.text("gender", "neutral"), betas)
    rate = next((float(archive.floats(name).ravel()[0]) for name in RATES if _is_scalar(archive, name)), None)
    if fps is not None and rate is not None and fps != rate:
        notes += (f"frame rate {fps:g} replaces the file's {rate:g}",)
    if up is None and amass:
        up, seen = "z", ("z was up in the file, as in every AMASS file",)
    else:
        up, seen = (up, ()) if up else _up_axis(poses, where)
    return PoseSequence(
        poses=poses,
        transl=transl.reshape(-1, 3),
        fps=require_fps(fps or rate, where, f"does not say its frame rate (looked for {', '.join(RATES)})"),
        up_axis=up,
        source=where,
        betas=betas,
        model=model,
        pelvis=pelvis,
        notes=(*notes, *seen, *more),
    )


def parts_of_pose(archive: Archive, frames: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """Poses (T, 55, 3) [rad] put together from their named parts, and notes on what rests."""
    poses, notes = np.zeros((frames, 55, 3)), ()
    for names, first, last in PARTS:
        for name in names:
            if name not in archive:
                continue
            values, width = archive.floats(name), 3 * (last - first)
            if "hand" in name and values.size != frames * width and values.size % frames == 0:
                notes += (f"{name} has {values.size // frames} columns, PCA coefficients; the hand rests",)
                continue
            poses[:, first:last] = archive.columns(name, width, frames).reshape(frames, -1, 3)
    if "left_hand_pose" in archive and not notes:
        notes += ("hand rotations are taken as absolute (flat_hand_mean=True)",)
    return poses, notes


def _poses(archive: Archive) -> tuple[np.ndarray, str, tuple[str, ...]]:
    root = next((name for name in PARTS[0][0] if name in archive), None)
    body = next((name for name in PARTS[1][0] if name in archive), None)
    if root is None or body is None:
        archive.require("poses")
        return poses_from_columns(archive.floats("poses"), str(archive.path))
    values = archive.floats(root)
    shape, frames = values.shape, values.size // 3
    matrices = len(shape) > 2 and shape[-2:] == (3, 3)
    if frames == 0 or shape[-1:] != (3,) or matrices:
        kind = "rotation matrices" if matrices else "6D rotations" if shape[-1:] == (6,) else ""
        hint = f", {kind}; save them as axis-angle" if kind else ""
        raise CaphyError(f"{archive.path}: {root} must be axis-angle, (frames, 3) [rad], got {shape}{hint}")
    if archive.floats(body).size == frames * 69:
        raise CaphyError(f"{archive.path}: {body} has SMPL's 23 joints; SMPL-X has 21. Save it as poses (T, 72)")
    poses, notes = parts_of_pose(archive, frames)
    return poses, "smplx", notes


def _up_axis(poses: np.ndarray, where: str) -> tuple[Literal["y", "z"], tuple[str, ...]]:
    """The axis along which the trunk points on average, or :class:`CaphyError` asking for it."""
    trunk = matrix_from_axis_angle(poses[:, 0])[:, :, 1].mean(axis=0)
    axes: tuple[tuple[Literal["y", "z"], float], ...] = (("y", trunk[1]), ("z", trunk[2]))
    for axis, length in axes:
        if length > UPRIGHT:
            return axis, (f"the file does not say which axis is up; {axis}, because the trunk points there",)
    raise CaphyError(
        f"{where}: does not say which axis is up, and the trunk points to {trunk.round(2)} on average; "
        "give it with 'caphy poses convert --up y' or '--up z'"
    )


def _first(archive: Archive, names: tuple[str, ...], where: str) -> np.ndarray:
    for name in names:
        if name in archive:
            return archive.floats(name)
    raise CaphyError(f"{where}: must hold a translation, {' or '.join(names)}; it has {', '.join(archive.names)}")


def _is_scalar(archive: Archive, name: str) -> bool:
    return name in archive and archive.floats(name).size == 1
