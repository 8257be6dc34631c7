"""The avatar at rest, as JSON or GLB."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from caphy.io.bundle import AvatarBundle, SkinnedMesh

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
    """The same as one static GLB with a node per mesh."""
    import trimesh  # here, because it pulls in whatever optional package it finds

    scene = trimesh.Scene()
    for name, mesh in _meshes(bundle).items():
        scene.add_geometry(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), node_name=name, geom_name=name)
    return cast(bytes, scene.export(file_type="glb"))
