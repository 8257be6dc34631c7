"""Biovision hierarchy files (.bvh): a skeleton, then one line of channel values per frame.

Format: Meredith and Maddock, "Motion Capture File Formats Explained", University of Sheffield 2001. A joint's rotation
is the product of its channels' rotations in the order listed: "Zrotation Yrotation Xrotation" means Rz Ry Rx.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.skeleton import SkeletonMotion, axis_rotations, read_text

CHANNELS = {f"{axis}{kind}": (kind, i) for i, axis in enumerate("XYZ") for kind in ("position", "rotation")}


MAX_DEPTH = 200


def read_bvh(path: Path, fps: float | None = None) -> SkeletonMotion:
    """The motion in a BVH file. ``fps`` overrides the file's frame time; raises :class:`CaphyError`."""
    path = Path(path)
    head, found, tail = read_text(path).partition("MOTION")
    if not found:
        raise CaphyError(f"{path}: not a whole BVH file; it must hold a HIERARCHY and a MOTION section")
    hierarchy = _Hierarchy(head, path)
    values, file_fps = _parse_motion(tail, sum(map(len, hierarchy.channels)), path)
    rotations, root = _rotations(hierarchy, values, path)
    return SkeletonMotion(
        names=tuple(hierarchy.names),
        parents=np.array(hierarchy.parents),
        offsets=np.array(hierarchy.offsets),
        tips=np.array(hierarchy.tips),
        rotations=rotations,
        root=root,
        fps=fps or file_fps,
        source=str(path),
    )


class _Hierarchy:
    """The skeleton of a BVH file, read by descent through its braces."""

    def __init__(self, text: str, path: Path):
        self.path = path
        self.words = iter(text.split())
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.tips: list[list[float]] = []
        self.channels: list[list[str]] = []
        self._expect("HIERARCHY")
        self._expect("ROOT")
        self._joint(parent=-1, depth=0)
        rest = next(self.words, None)
        if rest is not None:
            raise CaphyError(f"{path}: one ROOT must hold the whole hierarchy, but {rest!r} follows it")

    def _next(self) -> str:
        word = next(self.words, None)
        if word is None:
            raise CaphyError(f"{self.path}: the hierarchy is cut short after joint {(self.names or ['none'])[-1]!r}")
        return word

    def _expect(self, *words: str) -> str:
        word = self._next()
        if word not in words:
            where = f" in or after joint {self.names[-1]!r}" if self.names else ""
            raise CaphyError(f"{self.path}: the hierarchy must go on with {' or '.join(words)}{where}, got {word!r}")
        return word

    def _joint(self, parent: int, depth: int) -> None:
        name, index = self._next(), len(self.names)
        if name in self.names:
            raise CaphyError(f"{self.path}: joint {name!r} appears twice in the hierarchy")
        if depth > MAX_DEPTH:
            raise CaphyError(f"{self.path}: joints are nested more than {MAX_DEPTH} deep at {name!r}")
        self.names.append(name)
        self.parents.append(parent)
        self._expect("{")
        self.offsets.append(self._offset())
        self.tips.append([0.0, 0.0, 0.0])
        self._expect("CHANNELS")
        self.channels.append(self._channels(name))
        while (word := self._expect("JOINT", "End", "}")) != "}":
            if word == "JOINT":
                self._joint(index, depth + 1)
            else:
                self._expect("Site")
                self._expect("{")
                self.tips[index] = self._offset()
                self._expect("}")

    def _offset(self) -> list[float]:
        self._expect("OFFSET")
        return _numbers([self._next() for _ in range(3)], self.path, f"OFFSET of {self.names[-1]!r}")

    def _channels(self, joint: str) -> list[str]:
        count = self._next()
        names = [self._next() for _ in range(int(count))] if count in tuple("0123456") else []
        if count != str(len(names)) or not set(names) <= set(CHANNELS) or len(set(names)) != len(names):
            raise CaphyError(
                f"{self.path}: joint {joint!r} must list up to six of {', '.join(CHANNELS)}, got {count} {names}"
            )
        return names


def _parse_motion(text: str, width: int, path: Path) -> tuple[np.ndarray, float]:
    lines = [line.strip() for line in text.strip().splitlines() if line.strip()]
    if len(lines) < 3 or not lines[0].startswith("Frames:") or not lines[1].startswith("Frame Time:"):
        raise CaphyError(f"{path}: MOTION must begin with 'Frames:' and 'Frame Time:' and hold a frame")
    (count,) = _numbers(lines[0].removeprefix("Frames:").split()[:1] or ["none"], path, "Frames")
    (step,) = _numbers(lines[1].removeprefix("Frame Time:").split()[:1] or ["none"], path, "Frame Time")
    if not (1e-4 < step < 10):
        raise CaphyError(f"{path}: Frame Time must be between 0.0001 and 10 s, got {step}")
    rows = lines[2:]
    if len(rows) != count:
        raise CaphyError(f"{path}: says {count:g} frames but holds {len(rows)}; the file is cut short or edited")
    values = np.empty((len(rows), width))
    for frame, row in enumerate(rows):
        words = row.split()
        if len(words) != width:
            raise CaphyError(f"{path}: frame {frame} must hold {width} values, got {len(words)}")
        values[frame] = _numbers(words, path, f"frame {frame}")
    return values, _frame_rate(step)


def _frame_rate(step: float) -> float:
    """Frame rate of a printed frame time [s]: .0083333 is meant as 120 Hz; .0333667 stays 29.97 Hz."""
    rate = 1 / step
    return float(round(rate)) if abs(rate - round(rate)) < 1e-4 * rate else rate


def _numbers(words: list[str], path: Path, what: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise CaphyError(f"{path}: {what} must hold numbers: {error}") from error
    if not np.isfinite(values).all():
        raise CaphyError(f"{path}: {what} must hold finite numbers, got {words[:3]}...")
    return values


def _rotations(hierarchy: _Hierarchy, values: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    rotations = np.tile(np.eye(3), (len(values), len(hierarchy.names), 1, 1))
    root = np.tile(np.array(hierarchy.offsets[0]), (len(values), 1))
    column = 0
    for joint, channels in enumerate(hierarchy.channels):
        for name in channels:
            kind, axis = CHANNELS[name]
            if kind == "rotation":
                turn = axis_rotations(axis, np.radians(values[:, column]))
                rotations[:, joint] = rotations[:, joint] @ turn
            elif joint == 0:
                root[:, axis] += values[:, column]
            elif np.ptp(values[:, column]) > 1e-3:
                raise CaphyError(
                    f"{path}: joint {hierarchy.names[joint]!r} changes its length ({name} varies); "
                    "only the root may have moving position channels"
                )
            column += 1
    return rotations, root
