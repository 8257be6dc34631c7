"""A :class:`Garment` from a user's own mesh: rest metric from its panels or its 3-D shape, attachment to a body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.body.surface import nearest_on_surface
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.garment import panels, threads, topology
from caphy.garment.attach import skinning_weights
from caphy.garment.cut import smooth_step
from caphy.garment.dressing import thread_guide
from caphy.garment.families import RANGES
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.garment.usermesh import UserMesh

FARTHEST = 0.5
"""A garment whose middle vertex is farther [m] than this from the body is not on it."""
NEARER = 0.5
"""Times as near to the body, in the middle vertex, as a garment lies with its feet down to be taken for one so made."""
WITHIN = 0.5
"""Share of the vertices that may lie inside the body; solvers push out what is there by some millimetres."""
INWARD = 0.7
"""Share of the area that may look at the body, as folds and linings do."""


def garment_from_mesh(
    mesh: UserMesh,
    name: str,
    marks: Landmarks,
    *,
    panel_scale: float = 1.0,
    waistband: bool = False,
    layer_thickness: float = 0.0,
    provenance: dict[str, str] | None = None,
) -> Garment:
    """Attach ``mesh``, which must already lie on the body in T-pose, and give it a rest metric.

    ``waistband`` holds the highest opening to the body. Regions are named after the joint that moves them most.

    Raises
        CaphyError: if the layer is none to be worn, or the mesh is nowhere near the body, mostly within it, inside out,
            or has faces without area.
    """
    low, high = RANGES["layer_thickness"]
    if not low <= layer_thickness <= high:
        raise CaphyError(f"{name}: layer thickness must lie between {low:g} and {high:g} m, got {layer_thickness:g} m")
    distance = clearance(mesh, marks)
    if (drop := _height_of_a_stand(mesh, marks, distance)) is not None:
        raise CaphyError(
            f"{name}: the garment must lie on the body, whose hips are at the origin, but seems to be made for one "
            f"that stands with its feet at y = 0; pass --offset 0 {-drop:.3f} 0"
        )
    if np.median(np.abs(distance)) > FARTHEST:
        raise CaphyError(
            f"{name}: the garment must lie on the body, whose hips are at the origin, but is "
            f"{np.median(np.abs(distance)):.2f} m away at the median; pass --offset X Y Z in metres to move it"
        )
    if (within := float((distance < 0).mean())) > WITHIN:
        raise CaphyError(
            f"{name}: the garment must lie outside the body in T-pose, but {100 * within:.0f} % of its vertices are "
            "inside; move it with --offset, or fit it in a mesh editor"
        )
    if (inward := _inward(mesh, marks)) > INWARD:
        raise CaphyError(
            f"{name}: faces must be counter-clockwise seen from outside, but {100 * inward:.0f} % of its area looks "
            "at the body; turn all faces over in a mesh editor (flip normals)"
        )
    material, metric = rest_metric(mesh, marks, panel_scale)
    flat = topology.without_area(material)
    if len(flat):
        raise CaphyError(
            f"{name}: every face needs an area, but {len(flat)} of {len(mesh.faces)} have none (first: face "
            f"{flat[0]}); remove them in a mesh editor (merge by distance, dissolve degenerate)"
        )
    weights = skinning_weights(mesh.vertices, mesh.faces, marks.body, marks.vertices)
    return Garment(
        name=name,
        vertices=mesh.vertices,
        faces=mesh.faces,
        material=material,
        weights=weights,
        regions=np.array(JOINT_NAMES)[weights.argmax(axis=1)],
        layer_thickness=np.full(len(mesh.vertices), layer_thickness),
        attached=_top_band(mesh) if waistband else np.zeros(len(mesh.vertices)),
        provenance={**(provenance or {}), "metric": metric},
        joints=marks.joints,
    )


def rest_metric(mesh: UserMesh, marks: Landmarks, panel_scale: float = 1.0) -> tuple[np.ndarray, str]:
    """Material coordinates (F, 3, 2) [m] and their origin: the panels if those are metric, else the 3-D shape."""
    reason = "the file has no panel coordinates"
    if mesh.panel is not None:
        panel = mesh.panel * panel_scale
        report = panels.examine(mesh.vertices, mesh.faces, panel)
        if report.usable:
            return panels.material_from_panels(panel), "panel coordinates"
        reason = report.complaint(panel_scale)
    guide = thread_guide(marks, mesh.vertices[mesh.faces].mean(axis=1))
    warp = threads.warp_field(mesh.vertices, mesh.faces, guide)
    return threads.lay_flat(mesh.vertices, mesh.faces, warp), f"3-D shape, because {reason}"


def clearance(mesh: UserMesh, marks: Landmarks) -> np.ndarray:
    """Signed distance (V,) [m] of the garment's vertices to the body, negative inside."""
    return nearest_on_surface(mesh.vertices, marks.vertices, marks.body.faces).distance


def _height_of_a_stand(mesh: UserMesh, marks: Landmarks, distance: np.ndarray) -> float | None:
    """How high [m] the body's origin stands over its soles, where the garment fits far better from there than where it
    is; ``distance`` (V,) [m] is its clearance."""
    drop = -float(marks.vertices[:, 1].min())
    lower = replace(mesh, vertices=mesh.vertices - [0.0, drop, 0.0])
    there = float(np.median(np.abs(clearance(lower, marks))))
    return drop if there < NEARER * np.median(np.abs(distance)) else None


def _inward(mesh: UserMesh, marks: Landmarks) -> float:
    """Share of the area whose front looks at the nearest point of the body."""
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(area, axis=1)
    outward = nearest_on_surface(corners.mean(axis=1), marks.vertices, marks.body.faces).normal
    return float(size[(area * outward).sum(axis=1) < 0].sum() / max(size.sum(), 1e-300))


def _top_band(mesh: UserMesh) -> np.ndarray:
    """1 on the highest opening, falling to 0 within 5 cm below it."""
    loops = topology.boundary_loops(mesh.faces)
    if not loops:
        return np.zeros(len(mesh.vertices))
    top = max(loops, key=lambda loop: mesh.vertices[loop, 1].mean())
    below = mesh.vertices[top, 1].min() - mesh.vertices[:, 1]
    return 1.0 - smooth_step(below, 0.02, 0.05)
