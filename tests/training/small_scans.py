"""Scans of the small world: a tube of cloth that hangs wider than its template, seen as points with noise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from small_world import small_trainer, swaying, tube

from caphy.body.bundled import default_body
from caphy.garment.template import Garment
from caphy.register.points import ScanPoints
from caphy.rotations import matrix_from_axis_angle
from caphy.training.loop import Trainer
from caphy.training.scans import Scans

WIDER = 0.02
"""How far the worn tube stands off its template at the lower edge [m]."""


def worn(garment: Garment, wider: float = WIDER) -> np.ndarray:
    """Rest vertices (V, 3) of the garment as it is really worn: wider towards its lower edge."""
    y = garment.vertices[:, 1]
    down = (y.max() - y) / np.ptp(y)
    out = garment.vertices * [1, 0, 1]
    return garment.vertices + (wider * down / np.linalg.norm(out, axis=1))[:, None] * out


def posed(points: np.ndarray, weights: np.ndarray, pose: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Rest points (V, 3) carried by a plain loop over joints."""
    body = default_body()
    turned, place = {}, {}
    for joint, parent in enumerate(body.parents):
        own = matrix_from_axis_angle(pose[joint])
        above = np.eye(3) if parent < 0 else turned[parent]
        turned[joint] = above @ own
        offset = body.joints[joint] - (0 if parent < 0 else body.joints[parent])
        place[joint] = offset if parent < 0 else place[parent] + above @ offset
    moved = [(points - body.joints[j]) @ turned[j].T + place[j] for j in turned]
    return sum(weights[:, j, None] * moved[j] for j in turned) + transl


def sampled(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int, noise: float = 0.001) -> np.ndarray:
    """Noisy points (count, 3) of a surface."""
    rng = np.random.default_rng(seed)
    face, share = rng.integers(len(faces), size=count), rng.dirichlet(np.ones(3), count)
    return np.einsum("nk,nkc->nc", share, vertices[faces[face]]) + noise * rng.standard_normal((count, 3))


def scan(index: int, count: int = 1500, wider: float = WIDER) -> ScanPoints:
    """One scan of the tube, as the lower garment, in a pose of its own."""
    garment, motion = tube(), swaying(300, 7)
    pose, transl = motion.poses[17 * index], motion.transl[17 * index]
    cloth = posed(worn(garment, wider), garment.weights, pose, transl)
    skin = default_body().pose(pose[None], transl[None])[0][::2]
    points = sampled(cloth, garment.faces, count, index).astype(np.float32)
    return ScanPoints(f"scan{index}", skin.astype(np.float32), np.zeros((0, 3), np.float32), points, pose, transl)


def write_run(folder: Path, train: int = 5, held_out: int = 1) -> Path:
    """A run's folder with the points of scans and their split."""
    for index in range(train + held_out):
        scan(index).save(folder / "points")
    names = [f"scan{index}" for index in range(train + held_out)]
    (folder / "split.json").write_text(json.dumps({"train": names[:train], "held_out": names[train:]}))
    tube().save(folder / "lower.npz")
    return folder


def supervised_trainer(
    folder: Path, scans: int = 4, physics: bool = True, steps: int = 12, seed: int = 0, device: str = "cpu"
) -> Trainer:
    """A trainer of the tube on two motions and on scans, 300 points each."""
    base = small_trainer(folder, steps=steps, seed=seed, device=device)
    points = [scan(index, 300) for index in range(scans)]
    given = Scans.of(points, "lower", (), base.objective, base.network.driving, 1000.0, physics)
    return Trainer(folder, base.network, base.objective, base.track.motions, None, base.schedule, seed, base.say, given)
