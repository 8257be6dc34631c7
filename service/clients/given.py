"""What callers give the clients, checked before any of it is sent."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any, Final
from urllib.parse import SplitResult, urlsplit

import numpy as np

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError

RATES: Final = (1.0, 1000.0)
"""Frames per second that a service takes poses at."""


def address(url: str, schemes: Collection[str]) -> SplitResult:
    """The parts of a service's address; raises CaphyError for what is none."""
    with suppress(ValueError):  # of ports beyond 65535, brackets that do not close
        parts = urlsplit(url)
        if parts.scheme in schemes and parts.hostname and parts.port != 0:
            return parts
    raise CaphyError(f"a service's address is like http://127.0.0.1:8000, got {url!r}")


def headers(name: str, prefix: str, key: str | None) -> dict[str, str]:
    """The header ``name`` with a key of the service's, or none without one; raises CaphyError where none holds it."""
    if not key:
        return {}
    if not key.isprintable():
        raise CaphyError("a key is one line of letters, this one holds a line's end or the like; leave that out")
    return {name: prefix + key}


def rate(fps: float) -> float:
    """Frames per second of poses [Hz]; raises CaphyError where no service takes them."""
    if not RATES[0] <= fps <= RATES[1]:
        raise CaphyError(f"fps must lie between {RATES[0]:g} and {RATES[1]:g}, got {fps:g}")
    return float(fps)


def frames(poses: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (55, 3) or (T, 55, 3) [rad] and transl (3,) or (T, 3) [m] as (T, 55, 3) and (T, 3), float32.

    Raises CaphyError for other shapes.
    """
    taken = floats("poses", poses), floats("transl", transl)
    poses, transl = (array[None] if array.ndim == rank else array for array, rank in zip(taken, (2, 1), strict=True))
    if poses.shape[1:] != (JOINT_COUNT, 3) or transl.shape != (len(poses), 3):
        raise CaphyError(
            f"poses must have shape (frames, {JOINT_COUNT}, 3), transl (frames, 3), or both none of frames, "
            f"got {taken[0].shape}, {taken[1].shape}"
        )
    return poses, transl


def seen(times: np.ndarray | float, confidence: np.ndarray | float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """When ``count`` poses were seen (T,) float64 [s], and how surely (T, 55) float32; raises CaphyError for others."""
    times = floats("times", times, np.float64).reshape(-1)
    if len(times) != count:
        raise CaphyError(f"there must be a time for each of {count} poses, got {len(times)}")
    trust = floats("confidence", confidence)
    try:
        return times, np.array(np.broadcast_to(trust, (count, JOINT_COUNT)))
    except ValueError:
        wanted = (count, JOINT_COUNT)
        raise CaphyError(f"confidence must be one number or have shape {wanted}, got {trust.shape}") from None


def floats(what: str, array: Any, kind: type[np.floating] = np.float32) -> np.ndarray:
    """A copy of an array; raises CaphyError, which names ``what`` it is, where it holds no numbers."""
    try:
        return np.array(array, kind)
    except (ValueError, TypeError) as error:
        raise CaphyError(f"{what} must be an array of numbers, got {type(array).__name__} ({error})") from error


def joined(states: Mapping[str, np.ndarray], sizes: Mapping[str, int]) -> np.ndarray:
    """The states (S,) of garments, float32, one after another in the order of ``sizes``, their floats by name.

    Raises CaphyError where not every garment has its state, or others have one.
    """
    names = ", ".join(sizes)
    if set(states) != set(sizes):
        raise CaphyError(f"there must be a state of each garment asked for ({names}), got {', '.join(states)}")
    parts = [floats(f"the state of {name}", states[name]) for name in sizes]
    for part, (name, size) in zip(parts, sizes.items(), strict=True):
        if part.shape != (size,):
            raise CaphyError(f"the state of {name} must have shape ({size},), got {part.shape}; pass on what was told")
    return np.concatenate(parts)


def settings(conditioning: Mapping[str, Any]) -> str:
    """Settings of conditioning in JSON; raises CaphyError where it cannot hold them."""
    try:
        return json.dumps(dict(conditioning))
    except (ValueError, TypeError) as error:
        raise CaphyError(
            f"settings of conditioning must be numbers, texts and lists of Python's, got {conditioning!r} ({error})"
        ) from error
