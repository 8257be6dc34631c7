"""What may be chosen about conditioning."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final, Literal

from caphy.errors import CaphyError

RANGES: Final = {
    "fps": (1.0, 1000.0),
    "latency": (0.0, 1.0),
    "cutoff": (0.2, 60.0),
    "hold": (0.0, 10.0),
    "relax": (0.1, 10.0),
    "scale": (0.1, 10.0),
}
"""What each number may be."""


@dataclass(frozen=True)
class Conditioning:
    """Settings of a :class:`caphy.conditioning.Conditioner`; raises :class:`CaphyError` for what cannot be.

    fps: frames per second that come out [Hz], the model's.
    latency: how much later a moment is shown than it could be, so that poses after it can smooth it [s].
    cutoff: motion faster than this is taken for noise, where 30 sure poses come in a second [Hz].
    hold: how long a joint that is not seen keeps its place [s].
    relax: how long it then takes to the standing pose [s].
    frame: "world" where the poses' y axis points up; "camera" where it is a camera's (x right, y down, z ahead), and
    where gravity points is to be estimated, unless each pose comes with the camera's rotation.
    translation: "given", or "feet" where the source has none worth using: the bearing foot then stands still.
    floor: whether the ground is put at y = 0 by the body's own soles.
    scale: factor of the given translation's size, the avatar's over the source's body; none to estimate it.
    """

    fps: float = 30.0
    latency: float = 0.06
    cutoff: float = 3.0
    hold: float = 0.3
    relax: float = 1.0
    frame: Literal["world", "camera"] = "world"
    up: tuple[float, float, float] | None = None
    translation: Literal["given", "feet"] = "given"
    floor: bool = False
    scale: float | None = 1.0

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if name == "scale" and value is None:
                continue
            if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
                raise CaphyError(f"conditioning: {name} must lie between {low:g} and {high:g}, got {value!r}")
        for name, choices in (("frame", ("world", "camera")), ("translation", ("given", "feet"))):
            if getattr(self, name) not in choices:
                raise CaphyError(f"conditioning: {name} must be one of {choices}, got {getattr(self, name)!r}")
        if self.up is not None:
            if self.frame != "camera":
                raise CaphyError('conditioning: up is for poses in a camera\'s axes; set frame to "camera" too')
            object.__setattr__(self, "up", _direction(self.up))
        if not isinstance(self.floor, bool):
            raise CaphyError(f"conditioning: floor must be true or false, got {self.floor!r}")

    @classmethod
    def of(cls, given: object) -> Conditioning:
        """The settings in a dictionary of them, as JSON holds one."""
        if not isinstance(given, dict):
            raise CaphyError(f"conditioning: must be a table of settings, got {type(given).__name__}")
        known = [field.name for field in fields(cls)]
        unknown = [str(name)[:40] for name in given if name not in known]
        if unknown:
            raise CaphyError(f"conditioning: there is no setting {unknown[0]!r}; there are {', '.join(known)}")
        return cls(**given)


def _direction(given: object) -> tuple[float, float, float]:
    values = tuple(given) if isinstance(given, tuple | list) else ()
    real = [x for x in values if isinstance(x, int | float) and not isinstance(x, bool)]
    numbers = [float(x) for x in real if abs(x) < 1e6]  # asked first: an integer may be more than a float can hold
    length = math.hypot(*numbers)
    if len(values) != 3 or len(numbers) != 3 or not 1e-6 < length < 1e6:
        raise CaphyError(f"conditioning: up must be a direction (x, y, z), got {given!r}")
    return numbers[0] / length, numbers[1] / length, numbers[2] / length
