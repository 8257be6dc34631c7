"""A small avatar made in a second: shells of the bundled body as garments, with networks of random weights."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.garment.template import Garment
from caphy.io.bundle import AvatarBundle
from caphy.io.poses import PoseSequence
from caphy.network.garment_network import GarmentNetwork
from caphy.report.render import vertex_normals
from export.avatar import avatar_bundle, bundled_garment

PARTS = {
    "tshirt": ("spine1", "spine2", "spine3", "left_collar", "right_collar", "left_shoulder", "right_shoulder"),
    "trousers": ("pelvis", "left_hip", "right_hip", "left_knee", "right_knee"),
}


def shell(name: str) -> Garment:
    """The part of the body that follows some joints, 1 cm outside of it."""
    body = default_body("medium")
    owners = [JOINT_NAMES.index(joint) for joint in PARTS[name]]
    chosen = np.isin(body.weights.argmax(axis=1), owners)
    faces = body.faces[chosen[body.faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    vertices = (body.v_template + 0.01 * vertex_normals(body.v_template, body.faces))[used]
    count = len(used)
    return Garment(
        name=name,
        vertices=vertices,
        faces=faces,
        material=vertices[faces][..., :2],
        weights=body.weights[used],
        regions=np.where(vertices[:, 1] > np.median(vertices[:, 1]), "upper", "lower"),
        layer_thickness=np.zeros(count),
        attached=np.zeros(count),
    )


def random_network(garment: Garment, width: int = 24, layers: int = 4, offset: float = 0.02) -> GarmentNetwork:
    """A network of smooth random blend shapes: some centimetres of offset."""
    torch.manual_seed(len(garment.vertices))
    network = GarmentNetwork(
        garment.vertices, garment.weights, default_body("medium").joints, width=width, layers=layers
    )
    waves = torch.randn(width, 3) * 4
    directions = torch.nn.functional.normalize(torch.randn(width, 3), dim=-1)
    phase = network.template @ waves.T
    with torch.no_grad():
        network.head.weight.copy_((offset * torch.sin(phase)[:, None] * directions.T).flatten(0, 1))
        network.head.bias.normal_(std=1e-3)
    return network


def wiggle(seconds: float = 2.0, fps: float = 30.0, seed: int = 0) -> PoseSequence:
    """A smooth motion of every joint, walking along a curve, told for the bundled body."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * fps)) / fps
    speed, phase = rng.uniform(1, 6, (55, 3)), rng.uniform(0, 6, (55, 3))
    poses = 0.35 * np.sin(time[:, None, None] * speed + phase)
    poses[:, 0, 1] += time
    transl = np.stack([np.sin(time), 0.05 * np.sin(9 * time), 0.8 * time], axis=-1)
    pelvis = default_body("medium").joints[0]
    return PoseSequence(poses=poses, transl=transl, fps=fps, source=f"wiggle {seed}", pelvis=pelvis)


@lru_cache(maxsize=1)
def shell_avatar() -> AvatarBundle:
    """T-shirt and trousers on the bundled body."""
    garments = []
    for name in PARTS:
        garment = shell(name)
        garments.append(bundled_garment(garment, random_network(garment), [wiggle(seed=1)], [wiggle(seed=2)]))
    return avatar_bundle("shell", default_body("medium"), garments, fps=30.0, provenance={"made_by": "tests"})
