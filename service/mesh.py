"""The avatar at rest, as JSON or GLB."""

from __future__ import annotations

from typing import Any

import numpy as np

from caphy.io.bundle import AvatarBundle, SkinnedMesh
from caphy.report.avatar_glb import avatar_glb

GLB_MEDIA_TYPE = "model/gltf-binary"


def _meshes(bundle: AvatarBundle) -> dict[str, SkinnedMesh]:
    return {"body": bundle.body, **{garment.name: garment.mesh for garment in bundle.garments}}


def mesh_json(bundle: AvatarBundle) -> dict[str, Any]:
    """Vertices [m], faces and named regions of the body and every garment, in T-pose."""
    return {
        name: {
            "vertices": np.round(mesh.vertices.astype(np.float64), 5).tolist(),
            "faces": mesh.faces.tolist(),
            "regions": {
                region: np.flatnonzero(mesh.region == i).tolist() for i, region in enumerate(mesh.region_names)
            },
        }
        for name, mesh in _meshes(bundle).items()
    }


def mesh_glb(bundle: AvatarBundle) -> bytes:
    """The same as one GLB: a skeleton, and a skinned node per mesh."""
    return avatar_glb(bundle, tolerance=None)


def morph_glb(bundle: AvatarBundle) -> bytes:
    """The same with each garment's blend shapes as morph targets, for clients that take their weights; takes seconds.

    The file states the error of leaving the smallest out.
    """
    return avatar_glb(bundle)
