"""What the effects need to know of a garment at rest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from caphy.errors import CaphyError
from caphy.garment.topology import edges, face_areas, hinge_faces, hinges, without_area


@dataclass(frozen=True)
class Cloth:
    """A piece of cloth at rest: topology, rest metric and area density.

    Attributes:
        vertices: rest positions [m], (V, 3); only dihedral rest angles are read from them.
        faces: vertex indices, (F, 3).
        material: flat rest shape of each face in the thread frame [m], (F, 3, 2): u along weft, v along warp.
        density: area density [kg/m^2].
        layer_thickness: extra distance that each vertex keeps from the body [m], (V,).
        attached: strength in [0, 1] with which each vertex is held to the body, (V,).
    """

    vertices: np.ndarray
    faces: np.ndarray
    material: np.ndarray
    density: float
    layer_thickness: np.ndarray
    attached: np.ndarray

    @classmethod
    def of(cls, garment, density: float) -> Cloth:
        """The cloth of a :class:`caphy.garment.template.Garment` woven with an area density [kg/m^2]."""
        if not density > 0:
            raise CaphyError(f"the area density must be positive [kg/m^2], got {density}")
        flat = without_area(garment.material)
        if flat.size:
            raise CaphyError(
                f"garment {garment.name!r}: every face needs a rest area, but {flat.size} of {len(garment.faces)} have "
                f"none (first: face {flat[0]}); repair the mesh or its UVs"
            )
        return cls(
            garment.vertices,
            garment.faces,
            garment.material,
            density,
            garment.layer_thickness,
            np.asarray(garment.attached, dtype=float),
        )

    @cached_property
    def face_inverse(self) -> np.ndarray:
        """Inverse of each face's rest edge matrix [1/m], (F, 2, 2): F = [b - a, c - a] @ face_inverse."""
        a, b, c = np.moveaxis(self.material, 1, 0)
        return np.linalg.inv(np.stack([b - a, c - a], axis=-1))

    @cached_property
    def face_area(self) -> np.ndarray:
        """Rest area of each face [m^2], (F,)."""
        return face_areas(self.material)

    @cached_property
    def vertex_area(self) -> np.ndarray:
        """A third of the rest area of the faces around each vertex [m^2], (V,)."""
        area = np.zeros(len(self.vertices))
        np.add.at(area, self.faces, self.face_area[:, None] / 3)
        return area

    @property
    def mass(self) -> np.ndarray:
        """Lumped mass of each vertex [kg], (V,)."""
        return self.density * self.vertex_area

    @cached_property
    def edges(self) -> np.ndarray:
        """Vertex indices of every edge, (E, 2)."""
        return edges(self.faces)

    @cached_property
    def hinges(self) -> np.ndarray:
        """Vertex indices of every interior edge with its two opposite vertices, (H, 4): edge a, edge b, c, d."""
        return hinges(self.faces)

    @cached_property
    def hinge_faces(self) -> np.ndarray:
        """The two faces of each hinge, (H, 2): of a, b, c and of b, a, d."""
        return hinge_faces(self.faces)

    @cached_property
    def hinge_edges(self) -> np.ndarray:
        """Edge a -> b of each hinge in the thread frames of its two faces [m], (H, 2, 2): face, (u, v)."""
        corners = self.faces[self.hinge_faces]
        a, b = ((corners == self.hinges[:, None, end : end + 1]).argmax(-1) for end in (0, 1))
        material = self.material[self.hinge_faces]
        start, end = (np.take_along_axis(material, k[..., None, None], axis=2)[:, :, 0] for k in (a, b))
        return end - start
