"""From a bare mesh made on a body to a full :class:`Garment`: clearance, threads, attachment, named regions."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from caphy.body.surface import Surface
from caphy.garment import threads, topology
from caphy.garment.attach import skinning_weights
from caphy.garment.cut import Cut, smooth_step
from caphy.garment.landmarks import Landmarks
from caphy.garment.meshing import SHORTEST, collapse_short
from caphy.garment.template import Garment

if TYPE_CHECKING:
    from caphy.garment.families import Family

BAND = 0.03
"""Width [m] of hems, cuffs, collars and waistbands."""
BAND_NAMES = {"neck": "collar", "hem": "hem", "cuff": "cuff", "armhole": "armhole", "waist": "waist"}


def dress(family: Family, marks: Landmarks, cut: Cut, vertices: np.ndarray, faces: np.ndarray) -> Garment:
    """Complete a mesh (V, 3), (F, 3) of ``cut``."""
    if "waist" in cut.openings:
        vertices = draw_in(vertices, marks, cut.openings["waist"](vertices))
        vertices, faces = collapse_short(vertices, faces, SHORTEST * family.edge_length)
    vertices = keep_clear(vertices, faces, marks)
    distance = {name: field(vertices) for name, field in cut.openings.items()}
    regions = name_regions(marks, vertices, distance)
    warp = threads.warp_field(vertices, faces, thread_guide(marks, vertices[faces].mean(axis=1)))
    attached = np.zeros(len(vertices))
    if "waist" in distance:
        attached = 1.0 - smooth_step(distance["waist"], 0.02, 0.05)
    return Garment(
        name=family.family,
        vertices=vertices,
        faces=faces,
        material=threads.lay_flat(vertices, faces, warp),
        weights=skinning_weights(
            vertices, faces, marks.body, marks.vertices, blend=blend_width(family.family, marks, vertices[:, 1])
        ),
        regions=regions,
        layer_thickness=layer(family.layer_thickness, marks, vertices, "neck" in distance),
        attached=attached,
        provenance={k: str(v) for k, v in asdict(family).items()}
        | {"family": family.family, "metric": "3-D rest template"},
        joints=marks.joints,
    )


def draw_in(vertices: np.ndarray, marks: Landmarks, below: np.ndarray, gap: float = 0.008) -> np.ndarray:
    """Lay a waistband on the body: vertices (V, 3) that hang farther out than ``gap`` [m] move in to it.

    A cut hangs straight over the hollow of the back and of the flanks; a waistband is held there, and one that stands
    off pokes through whatever is worn over it. ``below`` (V,) [m] is the distance from the waist's edge; the pull ends
    8 cm below.
    """
    near = Surface.of(marks.body.faces, marks.vertices).nearest(vertices, marks.vertices)
    pull = (1.0 - smooth_step(below, 0.03, 0.08)) * np.maximum(near.distance - gap, 0.0)
    return vertices - pull[:, None] * near.normal


def keep_clear(vertices: np.ndarray, faces: np.ndarray, marks: Landmarks, least: float = 0.003) -> np.ndarray:
    """Push vertices (V, 3) out until they, points on edges and face centres keep ``least`` [m] from the body."""
    vertices = vertices.copy()
    edge = topology.edges(faces)
    points = np.repeat(np.arange(len(vertices))[:, None], 3, axis=1)
    groups = np.concatenate([points, edge[:, [0, 1, 1]], edge[:, [0, 0, 1]], faces])  # at the corners, thirds, centres
    surface = Surface.of(marks.body.faces, marks.vertices)
    for _ in range(5):
        near = surface.nearest(vertices[groups].mean(axis=1), marks.vertices)
        short = np.maximum(least - near.distance, 0.0)
        late = np.flatnonzero(short)
        if not len(late):
            break
        push = np.zeros((len(vertices), 3))
        for i in late[np.argsort(short[late])]:  # the deepest speaks last
            push[groups[i]] = 1.2 * short[i] * near.normal[i]
        vertices += push
    return vertices


def blend_width(family: str, marks: Landmarks, height: np.ndarray) -> np.ndarray:
    """How far (V,) [m] from the middle left and right joints are shared; between trouser legs not at all."""
    if family in ("trousers", "shorts"):
        return 0.06 * smooth_step(height, marks.crotch - 0.03, marks.crotch + 0.04)
    return np.full(len(height), 0.12)


def thread_guide(marks: Landmarks, points: np.ndarray) -> np.ndarray:
    """Direction (N, 3) that warp should follow: down the trunk and legs, out along the arms."""
    shoulder, wrist = marks.joint("left_shoulder"), marks.joint("left_wrist")
    out = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    side = np.sign(points[:, :1] + 1e-12)
    along = np.concatenate([side * out[0], np.broadcast_to(out[1:], (len(points), 2))], axis=1)
    on_arm = smooth_step(np.abs(points[:, :1]), shoulder[0] - 0.01, shoulder[0] + 0.05)
    on_arm = on_arm * (points[:, 1:2] > marks.armpit - 0.12)
    return on_arm * along + (1.0 - on_arm) * np.array([0.0, -1.0, 0.0])


def name_regions(marks: Landmarks, vertices: np.ndarray, distance: dict[str, np.ndarray]) -> np.ndarray:
    """Names (V,): bands along the openings, then sleeves and chest or back, or legs and hips."""
    x, y, z = vertices.T
    side = np.where(x >= 0, "left", "right")
    if "neck" in distance:
        names = np.where(z >= marks.joint("spine3")[2], "chest", "back").astype("U16")
        names[y < marks.joint("spine1")[1]] = "belly"
        arm = (np.abs(x) > marks.joint("left_shoulder")[0] + 0.02) & (y > marks.armpit - 0.1)
        names = np.where(arm & ("cuff" in distance), np.char.add("sleeve_", side), names)
    else:
        names = np.where(y < marks.crotch, np.char.add("leg_", side), "hips")
    for opening, value in distance.items():
        band = BAND_NAMES[opening]
        here = value < BAND
        names = np.where(here, np.char.add(band + "_", side) if band in ("cuff", "armhole") else band, names)
    return names.astype("U16")


def layer(thickness: float, marks: Landmarks, vertices: np.ndarray, is_top: bool) -> np.ndarray:
    """Extra distance to the body (V,) [m]: everywhere, or for a top from the waist down."""
    if not is_top:
        return np.full(len(vertices), thickness)
    waist = marks.crotch + 0.13 * marks.height
    return thickness * (1.0 - smooth_step(vertices[:, 1], waist, waist + 0.06))
