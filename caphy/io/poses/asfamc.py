"""Acclaim skeleton (.asf) and motion (.amc) files.

Format: Lander, "Working with Motion Capture File Formats", Game Developer 1998. A bone with axis C moves by
C Rz Ry Rx C^-1, with the degrees of freedom it has. A bone becomes the joint at its start, so that the skeleton has
the same joints as the BVH files made from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.skeleton import SkeletonMotion, axis_rotations, read_text

AXES = {"x": 0, "y": 1, "z": 2}


@dataclass
class _Bone:
    vector: np.ndarray = field(default_factory=lambda: np.zeros(3))
    axis: np.ndarray = field(default_factory=lambda: np.eye(3))
    dof: list[str] = field(default_factory=list)


def read_amc(path: Path, fps: float | None, skeleton: Path | None = None) -> SkeletonMotion:
    """The motion in an AMC file with its ASF skeleton, by default the one beside it of the same subject.

    AMC files do not hold their frame rate, so ``fps`` [Hz] must be given. Raises :class:`CaphyError`.
    """
    path = Path(path)
    if fps is None:
        raise CaphyError(
            f"{path}: AMC files do not say their frame rate; give it with 'caphy poses convert --fps RATE' (CMU: 120)"
        )
    bones, parents = _read_asf(skeleton or _skeleton_beside(path))
    values = _read_values(path, bones)
    names = tuple(bones)
    count = len(values["root"])
    rotations = np.tile(np.eye(3), (count, len(names), 1, 1))
    for joint, (name, bone) in enumerate(bones.items()):
        angles = {dof: values[name][:, i] for i, dof in enumerate(bone.dof) if dof[0] == "r"}
        for dof in sorted(angles, reverse=True):  # Rz Ry Rx
            rotations[:, joint] = rotations[:, joint] @ axis_rotations(AXES[dof[1]], angles[dof])
        rotations[:, joint] = bone.axis @ rotations[:, joint] @ bone.axis.T
    root = np.zeros((count, 3))
    for i, dof in enumerate(bones["root"].dof):
        if dof[0] == "t":
            root[:, AXES[dof[1]]] = values["root"][:, i]
    ends = np.array([bones[name].vector for name in names])
    index = {name: i for i, name in enumerate(names)}
    parent_index = np.array([index.get(parents[name], -1) for name in names])
    leaf = np.isin(np.arange(len(names)), parent_index, invert=True)
    return SkeletonMotion(
        names=names,
        parents=parent_index,
        offsets=np.where(parent_index[:, None] > 0, ends[np.maximum(parent_index, 0)], 0.0),
        tips=np.where(leaf[:, None], ends, 0.0),
        rotations=rotations,
        root=root,
        fps=fps,
        source=str(path),
    )


def _skeleton_beside(path: Path) -> Path:
    """The ASF file of the clip's subject: named as the clip's name up to the underscore, or the only one there."""
    every = sorted(path.parent.glob("*.asf"))
    subject = path.stem.split("_")[0]
    own = [other for other in every if other.stem.split("-")[0] == subject] or every
    if len(own) != 1:
        raise CaphyError(
            f"{path}: put its one skeleton beside it as {subject}.asf; found {[p.name for p in every] or 'none'}"
        )
    return own[0]


def _read_asf(path: Path) -> tuple[dict[str, _Bone], dict[str, str]]:
    """Bones by name, parents first, and each bone's parent."""
    sections: dict[str, list[list[str]]] = {}
    rows: list[list[str]] = []
    for line in _lines(path):
        if line.startswith(":"):
            words = line[1:].split()
            rows = sections.setdefault(words[0] if words else "", [])
            rows.append(words[1:])
        else:
            rows.append(line.split())
    for name in ("root", "bonedata", "hierarchy"):
        if name not in sections:
            raise CaphyError(f"{path}: an ASF skeleton must have a section :{name}; got {', '.join(sections)}")
    degrees = ["angle", "rad"] not in sections.get("units", [])
    bones = {"root": _root(sections["root"], degrees, path), **_bones(sections["bonedata"], degrees, path)}
    parents = {"root": ""}
    for words in sections["hierarchy"]:
        for child in words[1:] if words and words[0] in bones else ():
            if child not in bones or child in parents or words[0] not in parents:
                raise CaphyError(
                    f"{path}: hierarchy line {' '.join(words)!r} has an unknown, repeated or unordered bone"
                )
            parents[child] = words[0]
    missing = bones.keys() - parents.keys()
    if missing:
        raise CaphyError(f"{path}: the hierarchy leaves out {', '.join(sorted(missing))}")
    return {name: bones[name] for name in parents}, parents


def _root(rows: list[list[str]], degrees: bool, path: Path) -> _Bone:
    values = {words[0]: words[1:] for words in rows if words}
    dof = [word.lower() for word in values.get("order", [])]
    if sorted(dof) != ["rx", "ry", "rz", "tx", "ty", "tz"]:
        raise CaphyError(f"{path}: the root's order must name TX TY TZ RX RY RZ once each, got {dof}")
    axis = [*values.get("orientation", ["0"] * 3), *values.get("axis", ["XYZ"])]
    return _Bone(axis=_axis(axis, degrees, path, "root"), dof=dof)


def _bones(rows: list[list[str]], degrees: bool, path: Path) -> dict[str, _Bone]:
    bones: dict[str, _Bone] = {}
    bone, name, direction, length = _Bone(), "", np.zeros(3), 0.0
    for words in rows:
        key, rest = (words[0], words[1:]) if words else ("", [])
        if key == "begin":
            bone, name, direction, length = _Bone(), "", np.zeros(3), 0.0
        elif key == "name" and rest:
            name = rest[0]
        elif key == "direction":
            direction = numbers(rest, 3, path, f"direction of {name!r}")
        elif key == "length":
            (length,) = numbers(rest, 1, path, f"length of {name!r}")
        elif key == "axis":
            bone.axis = _axis(rest, degrees, path, name)
        elif key == "dof":
            bone.dof = [word.lower() for word in rest]
            if not set(bone.dof) <= {"rx", "ry", "rz"} or len(set(bone.dof)) != len(bone.dof):
                raise CaphyError(f"{path}: bone {name!r} may turn about rx, ry and rz, got {rest}")
        elif key == "end":
            if not name or name == "root" or name in bones:
                raise CaphyError(f"{path}: bones need names of their own, got {name!r} twice or none")
            bone.vector = direction * length
            bones[name] = bone
    return bones


def _axis(words: list[str], degrees: bool, path: Path, name: str) -> np.ndarray:
    """Rotation (3, 3) of angles in the order given: "XYZ" turns about x first."""
    angles = numbers(words[:3], 3, path, f"axis of {name!r}")
    order = (words[3:] or ["XYZ"])[0].lower()
    if sorted(order) != ["x", "y", "z"]:
        raise CaphyError(f"{path}: the axis order of {name!r} must be a permutation of XYZ, got {order!r}")
    rotation = np.eye(3)
    for axis in order:
        angle = angles[AXES[axis]]
        rotation = axis_rotations(AXES[axis], np.asarray(np.radians(angle) if degrees else angle)) @ rotation
    return rotation


def _read_values(path: Path, bones: dict[str, _Bone]) -> dict[str, np.ndarray]:
    """Values (T, dof) of every bone, angles in radians; zero where the file leaves a bone out of every frame."""
    frames: list[dict[str, np.ndarray]] = []
    degrees = True
    for line in _lines(path):
        words = line.split()
        if line.startswith(":"):
            degrees = degrees and line.upper() != ":RADIANS"
        elif len(words) == 1 and words[0].isdigit():
            if int(words[0]) != len(frames) + 1:
                raise CaphyError(f"{path}: frame {len(frames) + 1} must come next, got {words[0]}; frames are missing")
            frames.append({})
        elif not frames or words[0] not in bones or words[0] in frames[-1]:
            raise CaphyError(f"{path}: frame {len(frames)} has a line {words[:2]} that its skeleton cannot take")
        else:
            dof = bones[words[0]].dof
            frames[-1][words[0]] = numbers(words[1:], len(dof), path, f"frame {len(frames)}, {words[0]!r}")
    if not frames or "root" not in frames[0]:
        raise CaphyError(f"{path}: holds no frame with a root; is it an AMC file?")
    for number, frame in enumerate(frames, start=1):
        if frame.keys() != frames[0].keys():
            different = ", ".join(sorted(frame.keys() ^ frames[0].keys()))
            raise CaphyError(f"{path}: frame {number} differs from frame 1 in its bones ({different}); cut short?")
    values = {}
    for name, bone in bones.items():
        column = (
            np.array([frame[name] for frame in frames]) if name in frames[0] else np.zeros((len(frames), len(bone.dof)))
        )
        turns = np.array([dof[0] == "r" for dof in bone.dof], dtype=bool)
        values[name] = np.where(turns, np.radians(column) if degrees else column, column)
    return values


def _lines(path: Path) -> list[str]:
    lines = (line.strip() for line in read_text(path).splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def numbers(words: list[str], count: int, path: Path, what: str) -> np.ndarray:
    """``count`` finite numbers, or :class:`CaphyError` saying ``what`` must hold them."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise CaphyError(f"{path}: {what} must hold numbers: {error}") from error
    if len(values) != count or not np.isfinite(values).all():
        raise CaphyError(f"{path}: {what} must hold {count} finite numbers, got {words[:6]}")
    return values
