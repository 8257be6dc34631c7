"""A measurement made ready for the solver: cloth, pins, body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from caphy.body.bundled import default_body
from caphy.body.model import BodyModel
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.garment.threads import lay_flat, warp_field
from caphy.garment.topology import check_manifold
from caphy.io.measurements import Measurement
from caphy.io.poses import PoseSequence
from caphy.measure.mesh_body import MeshBody
from caphy.measure.pace import paced
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.solve.paths import path
from caphy.solve.rollout import Simulator


@dataclass(frozen=True, eq=False)
class Scene:
    """What drives the cloth of a measurement.

    Attributes:
        measurement: as given, or at a lower rate.
        garment: the template on the body; a bare sheet counts as one that hangs on the root joint.
        motion: the body, posed or as a mesh; none for cloth on pins alone.
        fixed: which vertices are pinned (V,), or none.
        pins: positions (P, 3) [m] of the pinned vertices at a time [s], or none.
        ends: where the cloth was seen to end beside each of its boundary edges (T, E, 3) [m], in the order of
            :class:`~caphy.measure.rim.Rim`, NaN where it was not; of points that were registered with a model's help.
            It guessed where the cloth lies along itself: only distances across the cloth, and across its rim, are
            measured.
        cloud: the points that it was registered from, if it was.
    """

    measurement: Measurement
    garment: Garment
    motion: BodyMotion | MeshBody | None
    fixed: np.ndarray | None
    pins: Callable[[float], Tensor] | None
    ends: np.ndarray | None = None
    cloud: Measurement | None = None

    @classmethod
    def of(cls, measurement: Measurement, garment: Garment | None = None, body: BodyModel | None = None) -> Scene:
        """Bind a measurement to its garment (the one it carries unless given) and body (the bundled one).

        Recordings of many frames a second are used at a lower rate (:func:`~caphy.measure.pace.paced`).

        Raises:
            CaphyError: the measurement lacks a rest shape, or its mesh is not the garment's.
        """
        measurement = paced(measurement)
        garment = _carried_garment(measurement) if garment is None else garment
        if measurement.vertex_count not in (None, len(garment.vertices)):
            raise CaphyError(
                f"{measurement.source or measurement.name}: has {measurement.vertex_count} vertices, garment "
                f"{garment.name!r} {len(garment.vertices)}; they must be one mesh, or the measurement a point cloud"
            )
        if measurement.faces is not None and not one_mesh(measurement.faces, garment.faces):
            raise CaphyError(
                f"{measurement.source or measurement.name}: its faces are not those of garment {garment.name!r}; "
                "vertices must come in the garment's order; give the garment that was measured"
            )
        motion = _motion(measurement, garment, body)
        if motion is None and measurement.pinned is None:
            where = measurement.source or measurement.name
            raise CaphyError(f"{where}: nothing holds the cloth; give poses, body_vertices or pinned")
        fixed, pins = _pins(measurement, len(garment.vertices))
        return cls(measurement, garment, motion, fixed, pins)

    def potential(self, model: Model) -> Potential:
        """The physics of a model on this cloth; raises :class:`CaphyError` where the scene lacks what it needs."""
        if isinstance(self.motion, MeshBody) and "attachment" in model.effects and (self.garment.attached > 0).any():
            where = self.measurement.source or self.measurement.name
            raise CaphyError(
                f"{where}: the garment is attached to its body; give poses, a body mesh alone has no joints"
            )
        return Potential(model, Cloth.of(self.garment, model.density))

    def simulator(self, potential: Potential, tolerance: float) -> Simulator:
        """A simulator of this scene."""
        newton = Newton(potential, self.fixed, tolerance)
        return Simulator(newton, self.motion, pins=self.pins)  # type: ignore[arg-type]

    def body_vertices(self, frames: np.ndarray) -> np.ndarray | None:
        """The body (N, B, 3) [m] in frames (N,), or none."""
        if self.motion is None:
            return None
        times = np.asarray(frames) / self.measurement.fps
        if isinstance(self.motion, MeshBody):
            return np.stack([self.motion.vertices(float(time)) for time in times])
        return self.motion.vertices(times)

    @property
    def slides(self) -> bool:
        """Whether where the cloth lies along itself is not known."""
        return self.ends is not None

    @property
    def unregistered(self) -> Scene:
        """The same with its points in place of what was registered, if it was."""
        return self if self.cloud is None else replace(self, measurement=self.cloud, ends=None, cloud=None)

    @property
    def regions(self) -> np.ndarray:
        """Name of the part each vertex belongs to, (V,): the measurement's own, else the garment's."""
        return self.garment.regions if self.measurement.regions is None else self.measurement.regions

    @property
    def body_faces(self) -> np.ndarray | None:
        """The body's triangles, or none."""
        if self.motion is None:
            return None
        return self.measurement.body_faces if isinstance(self.motion, MeshBody) else self.motion.body.faces


def rest_material(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Flat rest shapes (F, 3, 2) [m] of a mesh without thread directions: warp upwards, along z where it is level."""
    corner = vertices[faces]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    level = np.abs(area[:, 1]).sum() > 0.9 * np.linalg.norm(area, axis=1).sum()
    guide = np.tile([0.0, 0.0, 1.0] if level else [0.0, 1.0, 0.0], (len(faces), 1))
    return lay_flat(vertices, faces, warp_field(vertices, faces, guide))


def one_mesh(faces: np.ndarray, others: np.ndarray) -> bool:
    """Whether triangles (F, 3) are the same ones, in whatever order, whichever of their corners comes first."""
    if faces.shape != others.shape:
        return False
    one, other = (
        np.unique(np.take_along_axis(f, (f.argmin(1)[:, None] + np.arange(3)) % 3, axis=1), axis=0)
        for f in (faces.astype(np.int64), others.astype(np.int64))
    )
    return np.array_equal(one, other)


def _carried_garment(measurement: Measurement) -> Garment:
    where = measurement.source or measurement.name
    if measurement.rest_vertices is None or measurement.faces is None:
        raise CaphyError(f"{where}: a physics model needs the cloth's rest_vertices and faces, or --garment FILE")
    if measurement.poses is not None and measurement.weights is None:
        raise CaphyError(f"{where}: clothing on a posed body needs skinning weights (V, 55); give --garment FILE")
    count, rest, faces = len(measurement.rest_vertices), measurement.rest_vertices, measurement.faces
    if defects := check_manifold(faces, count):
        raise CaphyError(
            f"{where}: faces must be an oriented manifold with boundary that uses all vertices, got "
            f"{defects.describe()}; repair the mesh (merge by distance, recalculate normals), or leave vertices out"
        )
    on_root = np.zeros((count, 55))
    on_root[:, 0] = 1
    regions = measurement.regions
    return Garment(
        name=measurement.name,
        vertices=rest,
        faces=faces.astype(np.int32),
        material=rest_material(rest, faces) if measurement.material is None else measurement.material,
        weights=on_root if measurement.weights is None else measurement.weights,
        regions=np.full(count, "all") if regions is None else regions,
        layer_thickness=np.zeros(count) if measurement.layer_thickness is None else measurement.layer_thickness,
        attached=np.zeros(count) if measurement.attached is None else measurement.attached,
    )


def _motion(measurement: Measurement, garment: Garment, body: BodyModel | None) -> BodyMotion | MeshBody | None:
    if measurement.body_vertices is not None and measurement.body_faces is not None:
        return MeshBody(measurement.body_vertices, measurement.body_faces, measurement.fps)
    if measurement.poses is None or measurement.transl is None:
        return None
    body = default_body() if body is None else body
    there = measurement.about(body.rest(measurement.betas)[1][0])
    assert there.poses is not None and there.transl is not None
    poses = PoseSequence(there.poses, there.transl, there.fps, source=there.source)
    return BodyMotion(body, poses, garment, there.betas)


def _pins(measurement: Measurement, count: int) -> tuple[np.ndarray | None, Callable[[float], Tensor] | None]:
    """The pinned mask and splines through the pins' positions, in the order of the vertices."""
    if measurement.pinned is None or measurement.pinned_positions is None:
        return None, None
    if not 0 <= measurement.pinned.min() <= measurement.pinned.max() < count:
        low, high = measurement.pinned.min(), measurement.pinned.max()
        raise measurement.error(
            f"pinned must index the garment's {count} vertices, got {low} to {high}; is it of another mesh, or counted "
            "from 1?"
        )
    fixed = np.zeros(count, bool)
    fixed[measurement.pinned] = True
    order = np.argsort(measurement.pinned)
    held = path(measurement.pinned_positions[:, order], measurement.fps)
    return fixed, lambda time: torch.from_numpy(np.ascontiguousarray(held(time)))
