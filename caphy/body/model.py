"""A body in the SMPL-X format: one loader and one skinning path for the licensed model and the bundled free body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from zipfile import BadZipFile

import numpy as np

from caphy.body.kinematics import joint_positions, joint_transforms
from caphy.body.skinning import blend_transforms, skin
from caphy.conventions import JOINT_COUNT, JOINT_PARENTS
from caphy.errors import CaphyError
from caphy.rotations import matrix_from_axis_angle

POSE_FEATURES = 9 * (JOINT_COUNT - 1)
"""Entries of (R - I) of every joint but the root, row-major: what the pose correctives multiply."""

MAX_COEFFICIENT = 30.0
"""Shape and expression coefficients beyond this are of no person."""

_FRAMES_AT_ONCE = 64  # bounds memory: 64 frames of 12 k vertices are 75 MB of blended transforms


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A skinned body with shape, expression and pose-corrective blend shapes (Pavlakos et al., CVPR 2019).

    Lengths in metres, T-pose, y up, facing +z, joints in the order of :data:`caphy.conventions.JOINT_NAMES`.
    """

    v_template: np.ndarray
    """Rest vertices at the mean shape, (V, 3)."""
    faces: np.ndarray
    """Triangles, (F, 3) int32, counter-clockwise seen from outside."""
    joints: np.ndarray
    """Rest joints at the mean shape, (55, 3)."""
    weights: np.ndarray
    """Skinning weights, (V, 55), rows sum to one."""
    parents: np.ndarray
    """Parent of each joint, (55,) int32; the root's is -1."""
    shapedirs: np.ndarray
    """Vertex displacement per unit of each shape coefficient, (V, 3, S)."""
    joint_shapedirs: np.ndarray
    """Joint displacement per unit of each shape coefficient, (55, 3, S)."""
    expressiondirs: np.ndarray
    """Vertex displacement per unit of each expression coefficient, (V, 3, E); E may be 0."""
    joint_expressiondirs: np.ndarray
    """Joint displacement per unit of each expression coefficient, (55, 3, E)."""
    posedirs: np.ndarray | None = None
    """Pose correctives, (V, 3, 486), or none."""
    hand_components: Mapping[str, np.ndarray] | None = None
    """Hand pose components per side ("left", "right"), (45, 45), or none."""
    hand_means: Mapping[str, np.ndarray] | None = None
    """Mean hand pose per side, (45,) rad, or none."""

    @classmethod
    def load(cls, path: str | Path) -> BodyModel:
        """Read an SMPL-X-format ``.npz``.

        Raises:
            CaphyError: the file is missing, not an npz, or a key is missing, pickled or of the wrong shape.
        """
        return _read(Path(path))

    def rest(
        self, betas: np.ndarray | None = None, expression: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rest vertices (V, 3) and joints (55, 3) [m] of shape ``betas`` (<= S,) and ``expression`` (<= E,)."""
        vertices, joints = self.v_template, self.joints
        groups = (
            ("betas", betas, self.shapedirs, self.joint_shapedirs),
            ("expression", expression, self.expressiondirs, self.joint_expressiondirs),
        )
        for name, given, vertex_dirs, joint_dirs in groups:
            if given is not None:
                coefficients = np.asarray(given, dtype=np.float64)
                if coefficients.ndim != 1:
                    raise CaphyError(f"{name} must be one vector of coefficients, got shape {coefficients.shape}")
                if not (np.abs(coefficients) <= MAX_COEFFICIENT).all():
                    raise CaphyError(
                        f"{name} must be numbers from -{MAX_COEFFICIENT:g} to {MAX_COEFFICIENT:g} (of people they are "
                        f"within 5), got {coefficients[~(np.abs(coefficients) <= MAX_COEFFICIENT)][0]:g}"
                    )
                count = _coefficient_count(name, coefficients, vertex_dirs.shape[2])
                vertices = vertices + vertex_dirs[..., :count] @ coefficients
                joints = joints + joint_dirs[..., :count] @ coefficients
        return vertices, joints

    def transforms(self, poses: np.ndarray, betas: np.ndarray | None = None) -> np.ndarray:
        """Skinning transforms (T, 55, 3, 4) of poses (T, 55, 3) [rad], before ``transl``."""
        return joint_transforms(matrix_from_axis_angle(_checked_poses(poses)), self.rest(betas)[1], self.parents)

    def pose(
        self,
        poses: np.ndarray,
        transl: np.ndarray | None = None,
        betas: np.ndarray | None = None,
        expression: np.ndarray | None = None,
    ) -> np.ndarray:
        """Vertices (T, V, 3) [m] of poses (T, 55, 3) [rad] moved by ``transl`` (T, 3) [m].

        The root turns about the pelvis joint; ``transl`` is added afterwards.
        """
        poses = _checked_poses(poses)
        transl = np.zeros((len(poses), 3)) if transl is None else np.asarray(transl, dtype=np.float64)
        if transl.shape != (len(poses), 3):
            raise CaphyError(f"transl must have shape ({len(poses)}, 3), one per pose, got {transl.shape}")
        rest, joints = self.rest(betas, expression)
        posed = np.empty((len(poses), *rest.shape))
        for start in range(0, len(poses), _FRAMES_AT_ONCE):
            part = slice(start, start + _FRAMES_AT_ONCE)
            rotations = matrix_from_axis_angle(poses[part])
            posed[part] = self.skinned(rest, rotations, joint_transforms(rotations, joints, self.parents))
            posed[part] += transl[part, None]
        return posed

    def skinned(self, rest: np.ndarray, rotations: np.ndarray, transforms: np.ndarray) -> np.ndarray:
        """Vertices (T, V, 3) [m] of rest vertices (V, 3), joint rotations (T, 55, 3, 3) and the skinning transforms
        (T, 55, 3, 4) that follow from them, before ``transl``."""
        return skin(blend_transforms(self.weights, transforms), self._corrected(rest, rotations))

    def posed_joints(
        self, poses: np.ndarray, transl: np.ndarray | None = None, betas: np.ndarray | None = None
    ) -> np.ndarray:
        """Joint positions (T, 55, 3) [m] of poses (T, 55, 3) [rad] moved by ``transl`` (T, 3) [m]."""
        positions = joint_positions(self.transforms(poses, betas), self.rest(betas)[1])
        return positions if transl is None else positions + np.asarray(transl)[:, None]

    def _corrected(self, rest: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Rest vertices (V, 3), or (T, V, 3) with the pose correctives of rotations (T, 55, 3, 3)."""
        if self.posedirs is None:
            return rest
        feature = (rotations[:, 1:] - np.eye(3)).reshape(len(rotations), POSE_FEATURES)
        return rest + (feature @ self.posedirs.reshape(-1, POSE_FEATURES).T).reshape(-1, *rest.shape)

    def hand_pose(
        self, coefficients: np.ndarray, side: Literal["left", "right"], flat_hand_mean: bool = False
    ) -> np.ndarray:
        """Hand joint rotations (..., 15, 3) [rad] of hand-PCA coefficients (..., N), N <= 45.

        As published: the first N components, plus the mean hand unless ``flat_hand_mean``. Estimators store
        coefficients made with either setting; the stock package's default is ``flat_hand_mean=False``.

        Raises:
            CaphyError: the model file carries no hand components.
        """
        if self.hand_components is None or self.hand_means is None:
            raise CaphyError(
                "this body has no hand-PCA components (hands_componentsl/r, hands_meanl/r); "
                "give hand poses as axis-angle instead, or load an SMPL-X file that has them"
            )
        count = _coefficient_count("hand coefficients", coefficients, len(self.hand_components[side]))
        flat = np.asarray(coefficients, dtype=np.float64) @ self.hand_components[side][:count]
        flat = flat if flat_hand_mean else flat + self.hand_means[side]
        return flat.reshape(*flat.shape[:-1], 15, 3)


def _coefficient_count(name: str, given: np.ndarray, available: int) -> int:
    count = np.shape(given)[-1]
    if not 0 < count <= available:
        raise CaphyError(f"{name}: this body takes 1 to {available} coefficients, got shape {np.shape(given)}")
    return count


def _checked_poses(poses: np.ndarray) -> np.ndarray:
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (JOINT_COUNT, 3):
        raise CaphyError(f"poses must have shape (T, {JOINT_COUNT}, 3), axis-angle in rad, got {poses.shape}")
    return poses


def _read(path: Path) -> BodyModel:
    arrays = _Arrays(path)
    v_template = arrays.get("v_template", (None, 3))
    count = len(v_template)
    weights = arrays.get("weights", (count, JOINT_COUNT))
    shapes, expressions = _split_shapedirs(arrays.get("shapedirs", (count, 3, None)))
    if "J" in arrays:  # the bundled body: joints of the true skeleton, which no linear map of the surface gives exactly
        joints = arrays.get("J", (JOINT_COUNT, 3))
        joint_shapes = arrays.get("J_shapedirs", (JOINT_COUNT, 3, shapes.shape[2]))
        joint_expressions = np.zeros((JOINT_COUNT, 3, expressions.shape[2]))
    else:
        regressor = arrays.get("J_regressor", (JOINT_COUNT, count))
        joints = regressor @ v_template
        joint_shapes = np.einsum("jv,vcs->jcs", regressor, shapes)
        joint_expressions = np.einsum("jv,vcs->jcs", regressor, expressions)
    has_hands = "hands_componentsl" in arrays
    return BodyModel(
        v_template=v_template,
        faces=_read_faces(arrays, count),
        joints=joints,
        weights=weights,
        parents=_read_parents(arrays),
        shapedirs=shapes,
        joint_shapedirs=joint_shapes,
        expressiondirs=expressions,
        joint_expressiondirs=joint_expressions,
        posedirs=arrays.get("posedirs", (count, 3, POSE_FEATURES)) if "posedirs" in arrays else None,
        hand_components=_per_hand(arrays, "hands_components", (45, 45)) if has_hands else None,
        hand_means=_per_hand(arrays, "hands_mean", (45,)) if has_hands else None,
    )


class _Arrays:
    """The float64 arrays of an npz, checked one by one; errors name the file and the key."""

    def __init__(self, path: Path):
        self.path = path
        try:
            self._file = np.load(path, allow_pickle=False)
            self._names = set(self._file.files)
        except FileNotFoundError:
            raise CaphyError(f"{path}: there is no such body model file") from None
        except (AttributeError, BadZipFile, EOFError, OSError, ValueError):
            raise CaphyError(f"{path}: a body model must be an SMPL-X-format .npz, this file is none") from None

    def __contains__(self, key: str) -> bool:
        return key in self._names

    def get(self, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """The array ``key`` whose shape must match, ``None`` meaning any size."""
        if key not in self._names:
            raise CaphyError(
                f"{self.path}: key {key!r} is missing; an SMPL-X-format body has v_template, f, weights, "
                f"kintree_table, shapedirs and J_regressor. This file has: {', '.join(sorted(self._names))}"
            )
        try:
            array = np.asarray(self._file[key], dtype=np.float64)
        except ValueError:
            raise CaphyError(
                f"{self.path}: key {key!r} is not a plain numeric array (pickled objects are not read); "
                "save it as a dense array"
            ) from None
        matches = len(array.shape) == len(shape) and all(
            w in (None, n) for w, n in zip(shape, array.shape, strict=True)
        )
        if not matches:
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise CaphyError(
                f"{self.path}: key {key!r} must have shape {wanted}, got {array.shape}; is this an SMPL-X file "
                f"({JOINT_COUNT} joints), not SMPL or SMPL-H?"
            )
        if not np.isfinite(array).all():
            raise CaphyError(f"{self.path}: key {key!r} contains NaN or infinity")
        return array


def _split_shapedirs(shapedirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shape and expression parts: 300 + 100, or 10 + 10 in old files; up to 10 are all shape."""
    shape_count = 300 if shapedirs.shape[2] >= 400 else 10
    return shapedirs[..., :shape_count], shapedirs[..., shape_count:]


def _read_faces(arrays: _Arrays, vertex_count: int) -> np.ndarray:
    faces = arrays.get("f", (None, 3))
    if faces.size and (faces.min() < 0 or faces.max() >= vertex_count):
        raise CaphyError(
            f"{arrays.path}: key 'f' must index vertices 0 to {vertex_count - 1}, "
            f"got {faces.min():.0f} to {faces.max():.0f}"
        )
    return faces.astype(np.int32)


def _read_parents(arrays: _Arrays) -> np.ndarray:
    table = arrays.get("kintree_table", (2, JOINT_COUNT))[0]
    parents = np.where(table > JOINT_COUNT, -1, table).astype(np.int32)  # the root is -1 or 2**32 - 1
    if not np.array_equal(parents, JOINT_PARENTS):
        first = int(np.flatnonzero(parents != np.asarray(JOINT_PARENTS))[0])
        raise CaphyError(
            f"{arrays.path}: key 'kintree_table' is not SMPL-X's joint tree: joint {first} must hang on "
            f"{JOINT_PARENTS[first]}, got {parents[first]}"
        )
    return parents


def _per_hand(arrays: _Arrays, key: str, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    return {side: arrays.get(key + side[0], shape) for side in ("left", "right")}
