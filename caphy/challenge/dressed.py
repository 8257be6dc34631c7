"""Scenes: a skirt and a T-shirt on a body that walks, turns, raises its arms and jumps."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import torch

from caphy.body.bundled import default_body
from caphy.body.surface import nearest_on_surface
from caphy.challenge.leapfrog import Drive
from caphy.challenge.planes import FINER, MovingBody
from caphy.challenge.square import MODEL
from caphy.challenge.stage import FPS, RUN_UP, Part, Play, Stage
from caphy.challenge.swings import about_vertical
from caphy.conventions import JOINT_NAMES
from caphy.garment import threads
from caphy.garment.attach import prune
from caphy.garment.dressing import thread_guide
from caphy.garment.families import Skirt, Tshirt, make
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import State
from caphy.solve.preroll import preroll_poses

DRESSING = 1.0
"""Time from the T-pose to the run-up [s]."""
FALLING = 10 / FPS
"""Time in T-pose before that [s], for the cloth to fall."""
MOST_FLEXED = np.radians(60), np.radians(30)
"""How far a hip may turn [rad], and at the first frame of the run-up, into which the body comes from its T-pose.

In a squat cloth is caught in the groin and comes out turned inside out, a knot that stays: without contact of cloth
with itself nothing keeps folds from passing through each other.
"""

FAMILIES = {
    "skirt": (Skirt(length=0.4, edge_length=0.041), Skirt(length=0.4, edge_length=0.031)),
    "tshirt": (Tshirt(edge_length=0.028), Tshirt(edge_length=0.022)),
}
"""The user's mesh and the truth's.

Of 4.1 and 3.3 cm the user's T-shirt could not lie as the truth's sleeves do: a face in twenty was squeezed by a
quarter, and the shirt slid over the body: in a turn by 28 mm in eight frames; of these it is 6 mm off."""

ACTIONS: dict[Part, tuple[str, ...]] = {
    "train": ("legs", "turning", "arms"),
    "held_out": ("jumping",),
    "base": ("legs", "turning"),
}
"""What the body mostly does in each motion."""

_HIPS = [JOINT_NAMES.index(f"{side}_hip") for side in ("left", "right")]

WORN = MODEL.with_effect("attachment")
"""The fabric of the square, worn."""


def dressed(name: str, seed: int, frames: int, same_mesh: bool = False) -> Stage:
    """The scene of a garment with motions drawn from a seed."""
    user, other = cloths(name)
    truth = user if same_mesh else other
    plays = [
        _play(user, truth, part, number, action, frames, np.random.default_rng([seed, ord(part[0]), number]))
        for part, actions in ACTIONS.items()
        for number, action in enumerate(actions)
    ]
    return Stage(name, user, truth, WORN, tuple(plays))


skirt, tshirt = partial(dressed, "skirt"), partial(dressed, "tshirt")


@cache
def cloths(name: str) -> tuple[Garment, Garment]:
    """The user's mesh of a garment, its vertices on the truth's surface, and the truth's mesh."""
    body = default_body()
    coarse, fine = (make(family, body) for family in FAMILIES[name])
    found = nearest_on_surface(coarse.vertices, fine.vertices, fine.faces)
    corners = fine.faces[found.face]

    def carried(field: np.ndarray) -> np.ndarray:
        return np.einsum("vk,vk...->v...", found.barycentric, field[corners])

    vertices = carried(fine.vertices)
    warp = threads.warp_field(
        vertices, coarse.faces, thread_guide(Landmarks.of(body), vertices[coarse.faces].mean(axis=1))
    )
    user = replace(
        coarse,
        vertices=vertices,
        material=threads.lay_flat(vertices, coarse.faces, warp),
        weights=prune(carried(fine.weights)),
        attached=carried(fine.attached),
        layer_thickness=carried(fine.layer_thickness),
    )
    return user, fine


def _play(
    user: Garment, truth: Garment, part: Part, number: int, action: str, frames: int, random: np.random.Generator
) -> Play:
    motion = _motion(action, frames, random)
    worn = BodyMotion(default_body(), motion, truth)
    ahead, place = DRESSING + RUN_UP, worn.anchors(np.zeros(1))[0]
    anchors = worn.anchors(worn.times) if truth.attached.any() else None
    body = MovingBody(worn.vertices(worn.times), worn.body.faces, worn.fps, anchors)
    start = State(-ahead - FALLING, torch.from_numpy(place), torch.zeros(place.shape, dtype=torch.float64))
    seen = motion[round(ahead * FPS) * FINER :: FINER][:frames]
    before = motion[: round(ahead * FPS) * FINER : FINER]
    keys = {
        "poses": seen.poses,
        "transl": seen.transl,
        "preroll_poses": before.poses,
        "preroll_transl": before.transl,
        "weights": user.weights,
        "attached": user.attached,
        "layer_thickness": user.layer_thickness,
        "regions": user.regions,
    }
    return Play(part, number, Drive(body=body, ahead=ahead), start, keys)


def _motion(action: str, frames: int, random: np.random.Generator) -> PoseSequence:
    """From the T-pose into the run-up, and on through the part of a random motion that has most of an action."""
    whole = procedural_motion(int(random.integers(2**31)), 20.0, FINER * FPS)
    length = (round(RUN_UP * FPS) + frames - 1) * FINER
    vigour = np.convolve(_vigour(whole, action), np.ones(length), "valid")
    flexed = np.linalg.norm(whole.poses[:, _HIPS], axis=-1).max(axis=1)
    most = np.lib.stride_tricks.sliding_window_view(flexed, length + 1).max(axis=1)
    upright = (most <= MOST_FLEXED[0]) & (flexed[: len(most)] <= MOST_FLEXED[1])
    first = int(np.where(upright, vigour, -np.inf).argmax())
    pelvis = default_body().rest()[1][0]
    taken = replace(whole[first : first + length + 1], pelvis=pelvis).turned(about_vertical(random.uniform(0, 360)))
    way = preroll_poses(taken, DRESSING).resample(FINER * FPS)[:-1]
    return replace(
        taken,
        poses=np.concatenate([way.poses, taken.poses]),
        transl=np.concatenate([way.transl, taken.transl]),
    )


def _vigour(motion: PoseSequence, action: str) -> np.ndarray:
    """How much of an action there is between frames (T - 1,)."""
    speed = motion.angular_speed()
    match action:
        case "legs":
            return speed[:, _HIPS].sum(1)
        case "turning":
            return speed[:, 0]
        case "arms":
            return speed[:, [JOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right")]].sum(1)
        case _:
            return np.abs(np.diff(motion.transl[:, 1], 2, append=motion.transl[-1:, 1], axis=0))[: len(speed)]
