"""Scene: a square of soft cloth on two pins, shaken, in some motions with a ball swinging through it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch
import trimesh

from caphy.challenge.leapfrog import Drive, Leapfrog
from caphy.challenge.planes import FINER, MovingBody
from caphy.challenge.sheets import corners, other_square, users_square
from caphy.challenge.stage import CALM, FPS, RUN_UP, Part, Play, Stage
from caphy.challenge.swings import BASE, HELD_OUT, RADIUS, TRAINING, Swing, about_vertical, ball_path, pin_path
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.garment.template import Garment
from caphy.solve.integrators import State

MODEL = Model(
    0.2,
    {
        "gravity": {},
        "inertia": {},
        "strain_stvk": {"lame_mu": 40.0, "lame_lambda": 25.0},
        "bending": {"stiffness_weft": 6e-5, "stiffness_warp": 6e-5},
        "bending_damping": {"viscosity": 2e-6},
        "body_contact": {},
    },
)
"""A soft fabric of 200 g/m^2. Its little damping keeps cloth from humming, which cameras would never see."""

APART = 0.95
"""Distance of the pins over the square's side."""
BALL = trimesh.creation.icosphere(2, radius=RADIUS)


def square(seed: int, frames: int, same_mesh: bool = False) -> Stage:
    """The scene with motions drawn from a seed."""
    user = users_square()
    truth = user if same_mesh else other_square()
    parts: list[tuple[Part, tuple[Swing, ...]]] = [("train", TRAINING), ("held_out", HELD_OUT), ("base", BASE)]
    plays = [
        _play(user, truth, part, number, swing, frames, np.random.default_rng([seed, ord(part[0]), number]))
        for part, swings in parts
        for number, swing in enumerate(swings)
    ]
    return Stage("square", user, truth, MODEL, tuple(plays))


def _play(
    user: Garment, truth: Garment, part: Part, number: int, swing: Swing, frames: int, random: np.random.Generator
) -> Play:
    swing = replace(swing, facing=swing.facing + random.uniform(-20, 20))
    path, times = pin_path(swing, _hung(truth)[corners(truth)], random, -RUN_UP), np.arange(frames) / FPS
    keys = {"pinned": corners(user), "pinned_positions": np.stack([path(time) for time in times])}
    body = None
    if swing.ball:
        body = _ball(swing, frames, random)
        keys["body_vertices"] = np.stack([body.at(RUN_UP + time) for time in times])
        keys["body_faces"] = body.faces
    pins = corners(truth)
    fixed, order = np.isin(np.arange(len(truth.vertices)), pins), np.argsort(pins)
    turned = _settled(len(truth.vertices) == len(user.vertices)) @ about_vertical(swing.facing).T
    start = State(-RUN_UP - CALM, torch.from_numpy(turned), torch.zeros(turned.shape, dtype=torch.float64))
    return Play(part, number, Drive(fixed, lambda time: path(time)[order], body, RUN_UP), start, keys)


def _ball(swing: Swing, frames: int, random: np.random.Generator) -> MovingBody:
    """The ball from the start of the run-up on."""
    centre, rate = ball_path(swing, random), FINER * FPS
    times = np.arange(round((RUN_UP + frames / FPS) * rate)) / rate
    return MovingBody(np.stack([centre(time) + BALL.vertices for time in times]), np.asarray(BALL.faces), rate)


def _hung(garment: Garment) -> np.ndarray:
    """The flat square with its sides brought together to where the pins are (V, 3) [m]."""
    return garment.vertices * (APART, 1, 1)


@cache
def _settled(same_mesh: bool) -> np.ndarray:
    """The truth's mesh hanging at rest from its pins (V, 3) [m], facing +z; with it all motions begin."""
    truth = users_square() if same_mesh else other_square()
    flat, pins = _hung(truth), np.sort(corners(truth))
    fixed = np.isin(np.arange(len(flat)), pins)
    folds = 0.01 * np.sin(25 * flat[:, 0] + 0.5)  # which way it falls must not be left to rounding
    guess = torch.from_numpy(flat + np.outer(np.where(fixed, 0, folds), (0, 0, 1)))
    cloth = Leapfrog(MODEL, Cloth.of(truth, MODEL.density), Drive(fixed, lambda time: flat[pins]))
    return cloth.run(State(0.0, guess, 0 * guess), 75, FPS, calming=4.0)[-1].x.numpy()
