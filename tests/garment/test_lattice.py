"""A flat cloth meshed anew: it bends in all directions alike, and is the same cloth otherwise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from caphy.challenge.dressed import cloths
from caphy.challenge.sheets import other_square, users_square
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.garment.lattice import Lattice
from caphy.garment.subdivision import Subdivision
from caphy.garment.template import Garment
from caphy.garment.topology import check_manifold, face_angles, face_normals

BENT = Model(0.2, {"bending": {"stiffness_weft": 1.0, "stiffness_warp": 1.0}})
CURVATURE = 2.0  # [1/m]


def laid(sheet: Garment, fixed: np.ndarray | None = None) -> Lattice:
    """The lattice of a sheet that has one."""
    mesh = Lattice.of(sheet, fixed)
    assert mesh is not None
    return mesh


def part(keep, of: Garment) -> Garment:
    """The faces of a sheet whose middles are kept."""
    faces = of.faces[keep(of.vertices[of.faces].mean(axis=1))]
    used = np.unique(faces)
    number = np.full(len(of.vertices), -1)
    number[used] = np.arange(len(used))
    return replace(
        of,
        faces=number[faces].astype(np.int32),
        material=of.material[keep(of.vertices[of.faces].mean(axis=1))],
        **{n: getattr(of, n)[used] for n in ("vertices", "weights", "regions", "layer_thickness", "attached")},
    )


L_SHAPE = part(lambda x: (x[:, 0] < 0) | (x[:, 1] < 0.2), users_square(21))
HOLED = part(lambda x: np.hypot(x[:, 0], x[:, 1] - 0.2) > 0.09, users_square(21))


def stiffness(garment: Garment, angle: float) -> float:
    """Energy per area of hinges of bending to a cylinder, across an angle, over plate theory's k kappa^2 / 8."""
    across = np.array([np.cos(angle), np.sin(angle)])
    flat = (garment.vertices - garment.vertices.mean(axis=0))[:, :2]
    along = flat @ across
    rolled = np.sin(CURVATURE * along) / CURVATURE - along
    x = flat + np.outer(rolled, across)
    z = (1 - np.cos(CURVATURE * along)) / CURVATURE
    energy = Potential(BENT, Cloth.of(garment, 0.2)).energies(torch.from_numpy(np.column_stack([x, z])))["bending"]
    return float(energy) / hinged_area(garment) / (CURVATURE**2 / 8)


def hinged_area(garment: Garment) -> float:
    """A third of each face's area for each of its edges that is a hinge: edges of the rim store nothing."""
    wings = garment.hinges
    corner = garment.vertices
    a, b, c, d = (corner[wings[:, k]] for k in range(4))
    doubled = [np.linalg.norm(np.cross(b - a, other - a), axis=1).sum() for other in (c, d)]
    return sum(doubled) / 6


def spread(garment: Garment) -> float:
    """Of the stiffest direction over the softest."""
    every = [stiffness(garment, angle) for angle in np.linspace(0, np.pi, 9)[:-1]]
    return max(every) / min(every)


@pytest.mark.parametrize("sheet", [users_square(), users_square(25), other_square(0.025)], ids=["17", "25", "other"])
def test_it_bends_in_all_directions_as_a_plate_does(sheet):
    garment = laid(sheet).garment
    every = np.array([stiffness(garment, angle) for angle in np.linspace(0, np.pi, 9)[:-1]])
    np.testing.assert_allclose(every, 1.0, atol=0.08)


def test_squares_with_diagonals_do_not_and_quarters_of_them_less():
    assert spread(users_square()) > 1.5
    assert spread(Subdivision.of(users_square()).garment) > 1.6
    assert spread(laid(users_square()).garment) < 1.06


@pytest.mark.parametrize(
    "sheet", [users_square(), L_SHAPE, HOLED, other_square()], ids=["square", "L", "holed", "other"]
)
def test_it_is_the_same_cloth(sheet):
    mesh = laid(sheet)
    fine = mesh.garment
    assert not check_manifold(fine.faces)
    assert 2.6 * len(sheet.faces) < len(fine.faces) < 3.4 * len(sheet.faces)
    assert np.degrees(face_angles(fine.vertices, fine.faces).min()) > 20
    assert len(fine.boundary_loops) == len(sheet.boundary_loops)
    np.testing.assert_allclose(fine.masses(0.2).sum(), sheet.masses(0.2).sum(), rtol=1e-9)
    assert (face_normals(fine.vertices, fine.faces) @ face_normals(sheet.vertices, sheet.faces)[0] > 0.999).all()
    rim, known = fine.boundary_loops[0], {tuple(np.round(x, 9)) for x in fine.vertices}
    assert len(rim) == 2 * len(sheet.boundary_loops[0])
    assert {tuple(np.round(x, 9)) for x in sheet.vertices[sheet.boundary_loops[0]]} <= known


@pytest.mark.parametrize("sheet", [users_square(), L_SHAPE, HOLED], ids=["square", "L", "holed"])
def test_fields_go_to_it_and_back(sheet):
    mesh, linear = laid(sheet), np.random.default_rng(0).normal(size=(3, 3))
    np.testing.assert_allclose(mesh.carried(sheet.vertices @ linear), mesh.garment.vertices @ linear, atol=1e-12)
    np.testing.assert_allclose(mesh.seen(mesh.garment.vertices @ linear), sheet.vertices @ linear, atol=1e-12)


def test_stretched_it_stores_what_the_coarse_one_does():
    """Material coordinates are the cloth's own, where threads run askew and rest lengths are not the template's too."""
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    sheet = users_square(9)
    sheet = replace(sheet, material=0.97 * sheet.material @ turn)
    mesh = laid(sheet)
    model = Model(0.2, {"strain_measured": {}})
    stretched = sheet.vertices * [1.05, 0.99, 1.0]
    energies = [
        float(Potential(model, Cloth.of(one, 0.2)).energies(torch.from_numpy(x))["strain_measured"])
        for one, x in ((sheet, stretched), (mesh.garment, mesh.carried(stretched)))
    ]
    assert energies[0] > 0
    assert energies[1] == pytest.approx(energies[0], rel=1e-9)


def test_what_is_held_within_the_cloth_is_among_its_vertices():
    sheet = users_square(21)
    fixed = np.zeros(len(sheet.vertices), bool)
    fixed[220:224] = True
    mesh = laid(sheet, fixed)
    known = (mesh.ends >= 0).all(axis=1)
    held = known & fixed[mesh.ends].all(axis=1)
    assert held.sum() == 7  # four vertices and the three middles between them
    places = sheet.vertices[mesh.ends[held]].mean(axis=1)
    np.testing.assert_allclose(mesh.garment.vertices[held], places, atol=1e-12)


def test_cloth_that_is_not_flat_or_not_even_is_left_to_quarters():
    assert Lattice.of(cloths("skirt")[0]) is None
    sheet = users_square()
    graded = sheet.vertices.copy()
    graded[:, 0] *= 0.1 + np.abs(graded[:, 0])
    assert Lattice.of(replace(sheet, vertices=graded, material=graded[sheet.faces][..., :2])) is None
    squashed = sheet.vertices.copy()
    squashed[20] = squashed[21]
    assert Lattice.of(replace(sheet, vertices=squashed)) is None
    faces, turned = np.concatenate([sheet.faces, sheet.faces[:, ::-1]]), sheet.material[:, ::-1] * [-1, 1]
    assert Lattice.of(replace(sheet, faces=faces, material=np.concatenate([sheet.material, turned]))) is None
    puckered = replace(sheet, material=sheet.material * (1 + 0.02 * sheet.vertices[sheet.faces, 1])[..., None])
    assert Lattice.of(puckered) is None
