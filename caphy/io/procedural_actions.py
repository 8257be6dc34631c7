"""What a procedural body can do: each action gives joint angles, heading rate and jump height over its own time.

Angles are a, b, c of R = Rx(a) Ry(b) Rz(c) [degrees] by joint. Positive a bends the knee, leans the trunk forward and
points the toes down; negative a lifts a thigh or an arm forward. Gait angles follow Winter, "Biomechanics and Motor
Control of Human Movement" (2009).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from caphy.conventions import GRAVITY

Angles = dict[str, list[np.ndarray]]

FREE_FALL: Final = -GRAVITY[1]


@dataclass(frozen=True)
class Action:
    """An action over T frames: angles [degrees], rate of heading [rad/s] and lift above the ground [m], each (T,)."""

    angles: Angles
    turning: np.ndarray | float = 0.0
    lift: np.ndarray | float = 0.0


def stand(time: np.ndarray) -> Angles:
    """The relaxed stance that every action departs from: arms hanging, knees and elbows a little bent."""
    zero = np.zeros_like(time)
    breath = np.sin(2 * np.pi * 0.25 * time)
    angles: Angles = {"spine2": [0.8 * breath, zero, zero], "head": [-0.8 * breath, zero, zero]}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        angles[f"{side}_hip"] = [zero - 4, zero + 4 * sign, zero + 2 * sign]
        angles[f"{side}_knee"] = [zero + 8, zero, zero]
        angles[f"{side}_ankle"] = [zero - 4, zero, zero - 2 * sign]
        angles[f"{side}_shoulder"] = [zero + 2, zero, (zero - 70 - 0.5 * breath) * sign]
        angles[f"{side}_elbow"] = [zero, (zero - 18) * sign, zero]
    return angles


def idle(time: np.ndarray, rng: np.random.Generator) -> Action:
    """Standing, shifting weight and looking around."""
    angles = stand(time)
    look, sway = rng.uniform(-25, 25), rng.uniform(1.5, 3.0) * rng.choice([-1, 1])
    slow = np.sin(np.pi * time / time[-1]) ** 2
    angles["neck"] = [0 * slow, look * slow, 0 * slow]
    angles["spine1"] = [0 * slow, 0.3 * look * slow, sway * slow]
    return Action(angles)


def walk(time: np.ndarray, rng: np.random.Generator, turning: float = 0.0, reach: float = 1.0) -> Action:
    """Walking ahead; ``turning`` [rad/s] and ``reach`` (1 is a full step) make it a turn on the spot."""
    stride = rng.uniform(0.85, 1.0)
    angles = stand(time)
    phase = 2 * np.pi * stride * time + rng.choice([0, np.pi])
    swing = rng.uniform(0.8, 1.1) * reach
    for side, sign, own in (("left", 1.0, phase), ("right", -1.0, phase + np.pi)):
        hip = 8 + 22 * swing * np.cos(own)
        knee = 8 + 12 * swing * _bump(own, 0.13, 8) + (30 + 25 * swing) * _bump(own, 0.72, 5)
        sole = 25 * swing * _bump(own, 0.60, 14) - 12 * swing * _bump(own, 0.98, 12)  # toes down is positive
        angles[f"{side}_hip"][0] = -hip
        angles[f"{side}_knee"][0] = knee
        angles[f"{side}_ankle"][0] = np.clip(sole + hip - knee, -28, 25)
        angles[f"{side}_foot"] = [-0.8 * np.maximum(sole, 0), 0 * own, 0 * own]
        angles[f"{side}_shoulder"][0] = 4 + 20 * swing * np.cos(own)
        angles[f"{side}_elbow"][1] = sign * (-22 - 8 * swing * (1 - np.cos(own)))
    yaw = 4 * swing * np.cos(phase)
    angles["spine1"] = [0 * phase + 2, yaw, 0 * phase]
    angles["spine3"] = [0 * phase, yaw, 0 * phase]
    return Action(angles, turning=turning * _plateau(time))


def turn(time: np.ndarray, rng: np.random.Generator) -> Action:
    """Turning on the spot with small steps, by 60 to 180 degrees either way."""
    total = np.radians(rng.uniform(60, 180)) * rng.choice([-1, 1])
    return walk(time, rng, turning=total / (time[-1] * 0.75), reach=0.3)


def raise_arms(time: np.ndarray, rng: np.random.Generator) -> Action:
    """Both arms, or one, lifted sideways or forward and lowered again, elbows bending on the way."""
    angles = stand(time)
    up = _plateau(time)
    forward, height, bend = rng.uniform(0, 1), rng.uniform(60, 150), rng.uniform(0, 60)
    one = rng.choice([0.0, 1.0, 2.0], p=[0.2, 0.2, 0.6])
    for side, sign, number in (("left", 1.0, 0.0), ("right", -1.0, 1.0)):
        if one not in (2.0, number):
            continue
        angles[f"{side}_shoulder"][0] = angles[f"{side}_shoulder"][0] - min(height, 92) * forward * up
        angles[f"{side}_shoulder"][2] = angles[f"{side}_shoulder"][2] + sign * height * (1 - forward) * up
        angles[f"{side}_collar"] = [0 * up, 0 * up, sign * 12 * up * (1 - forward)]
        angles[f"{side}_elbow"][1] = angles[f"{side}_elbow"][1] - sign * bend * np.sin(np.pi * time / time[-1]) ** 2
    return Action(angles)


def squat(time: np.ndarray, rng: np.random.Generator) -> Action:
    """Down and up again with the arms ahead for balance."""
    return Action(_crouched(stand(time), _plateau(time) * rng.uniform(0.8, 1.0)))


def jump(time: np.ndarray, rng: np.random.Generator) -> Action:
    """Crouch, jump straight up, land softly; the flight is a free fall."""
    flight = rng.uniform(0.36, 0.48)
    start = 0.35 * time[-1]
    end = start + flight
    depth = rng.uniform(0.45, 0.6)
    keys = (0, 0.15 * time[-1], start - 0.25, start, end, end + 0.25, 0.9 * time[-1], time[-1])
    crouch = _keyed(time, keys, (0, 0, depth, -0.05, -0.05, 0.7 * depth, 0, 0))
    angles = _crouched(stand(time), crouch)
    point = 22 * _keyed(time, (start - 0.12, start, end, end + 0.1), (0, 1, 0.7, 0))
    for side in ("left", "right"):
        angles[f"{side}_ankle"][0] = angles[f"{side}_ankle"][0] + point
        swing = _keyed(time, keys, (0, 0, 35, -80, -45, -20, 0, 0))
        angles[f"{side}_shoulder"][0] = 2 + swing
    since = np.clip(time - start, 0, flight)
    return Action(angles, lift=FREE_FALL * since * (flight - since) / 2)


ACTIONS: Final = {
    "idle": (idle, 2.0),
    "walk": (walk, 4.0),
    "turn": (turn, 3.0),
    "raise_arms": (raise_arms, 3.0),
    "squat": (squat, 3.0),
    "jump": (jump, 2.4),
}
"""Actions and how long each takes [s]."""


def _crouched(angles: Angles, depth: np.ndarray) -> Angles:
    """``angles`` with hips and knees bent by ``depth`` (1 is a deep squat) over flat feet."""
    lean, thigh, knee = 28 * depth, 88 * depth, 100 * depth
    angles["pelvis"] = [lean, 0 * depth, 0 * depth]
    angles["spine1"] = [8 * depth, 0 * depth, 0 * depth]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        angles[f"{side}_hip"][0] = angles[f"{side}_hip"][0] - thigh
        angles[f"{side}_hip"][2] = angles[f"{side}_hip"][2] + sign * 6 * depth
        angles[f"{side}_knee"][0] = angles[f"{side}_knee"][0] + knee
        angles[f"{side}_ankle"][0] = angles[f"{side}_ankle"][0] + thigh - knee - lean * 0.6
        angles[f"{side}_shoulder"][0] = angles[f"{side}_shoulder"][0] - 65 * depth
    return angles


def _bump(phase: np.ndarray, centre: float, sharpness: float) -> np.ndarray:
    """A smooth periodic bump of height 1 at ``centre`` of the cycle."""
    return np.exp(sharpness * (np.cos(phase - 2 * np.pi * centre) - 1))


def _plateau(time: np.ndarray) -> np.ndarray:
    """Rises from 0 to 1 over the first 40 % of the time and falls over the last 40 %."""
    end = time[-1]
    return _keyed(time, (0, 0.4 * end, 0.6 * end, end), (0, 1, 1, 0))


def _keyed(time: np.ndarray, at: tuple[float, ...], values: tuple[float, ...]) -> np.ndarray:
    """Values eased from key to key with zero rate at each (cubic)."""
    keys = np.asarray(at, dtype=np.float64)
    index = np.clip(np.searchsorted(keys, time, side="right") - 1, 0, len(keys) - 2)
    share = np.clip((time - keys[index]) / (keys[index + 1] - keys[index]), 0, 1)
    levels = np.asarray(values, dtype=np.float64)
    return levels[index] + (levels[index + 1] - levels[index]) * share**2 * (3 - 2 * share)
