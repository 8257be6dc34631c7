"""Extra mass, seams and thickness against what they stand for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from situations import DENSITY, gradient, moving, plane, rolled_out

from caphy.effects.base import Step
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.seams import ordered_loops
from caphy.effects.trial import flat_cloth, irregular_cloth, moment
from caphy.errors import CaphyError
from caphy.solve.integrators import State

GRAVITY = (0.0, -9.81, 0.0)


def tube(rows: int = 4, around: int = 12) -> Cloth:
    """An upright tube 20 cm high that narrows from 10 cm radius at its lower opening to 5 cm."""
    height, turn = np.meshgrid(np.linspace(0, 0.2, rows + 1), np.arange(around) / around * 2 * np.pi, indexing="ij")
    radius = 0.1 - 0.25 * height
    vertices = np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], -1).reshape(-1, 3)
    a = (np.arange(rows)[:, None] * around + np.arange(around)).ravel()
    b = (np.arange(rows)[:, None] * around + (np.arange(around) + 1) % around).ravel()
    faces = np.concatenate([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)])
    corner = vertices[faces]
    p, q = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    u = p / np.linalg.norm(p, axis=1, keepdims=True)
    across = np.cross(np.cross(p, q), u)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    flat = [np.stack([(d * u).sum(1), (d * across).sum(1)], 1) for d in (0 * p, p, q)]
    zeros = np.zeros(len(vertices))
    return Cloth(vertices, faces, np.stack(flat, 1), DENSITY, zeros, zeros)


def perimeter(loop: np.ndarray, cloth: Cloth) -> float:
    return float(np.linalg.norm(cloth.vertices[np.roll(loop, -1)] - cloth.vertices[loop], axis=1).sum())


@pytest.mark.parametrize("dynamic", [True, False])
def test_extra_mass_is_density(dynamic: bool) -> None:
    cloth = irregular_cloth()
    at = moment(cloth)
    step = at.step if dynamic else None
    effects: dict[str, Any] = {"gravity": {}, "inertia": {}}
    wanted = Potential(Model(0.26, effects), cloth).gradient(at.x, step)[1]
    got = gradient(cloth, at.x, step, extra_mass={"density": 0.06}, **effects)
    torch.testing.assert_close(got, wanted)


def test_added_mass_is_inertia_without_weight() -> None:
    cloth = irregular_cloth()
    at = moment(cloth)
    heavy = gradient(cloth, at.x, at.step, gravity={}, extra_mass={"density": 0.06})
    light = gradient(cloth, at.x, at.step, gravity={}, added_mass={"density": 0.06})
    weight = torch.as_tensor(0.06 * cloth.vertex_area[:, None] * [0.0, 9.81, 0.0])
    torch.testing.assert_close(heavy - light, weight)


@pytest.mark.parametrize(("name", "falls"), [("extra_mass", True), ("added_mass", False)])
def test_mass_slows_a_spring(name: str, falls: bool) -> None:
    """omega = sqrt(k / (rho + sigma)); a spring of stiffness k per area on every vertex, no gravity."""
    flat, sigma, k = flat_cloth(2, 2), 0.3, 20.0
    cloth = Cloth(flat.vertices, flat.faces, flat.material, DENSITY, flat.layer_thickness, np.ones(9))
    effects: dict[str, Any] = {"inertia": {}, "attachment": {"stiffness": k}, name: {"density": sigma}}
    if falls:
        effects["gravity"] = {"acceleration": (0.0, 0.0, 0.0)}
    anchor = torch.as_tensor(cloth.vertices)
    body = plane(torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64), anchor)
    start = State(0.0, anchor + 0.01, torch.zeros_like(anchor))
    period = 2 * np.pi / np.sqrt(k / (DENSITY + sigma))
    state, _ = rolled_out(Potential(Model(DENSITY, effects), cloth), start, 40, period / 40, body=body)
    np.testing.assert_allclose(state.x - anchor, 0.01, rtol=1e-2)
    np.testing.assert_allclose(state.v, 0, atol=0.02 * 0.01 * 2 * np.pi / period)


def test_a_mass_gradient_moves_mass_downwards() -> None:
    cloth = irregular_cloth()
    x = torch.as_tensor(cloth.vertices)
    weight = gradient(cloth, x, gravity={"acceleration": GRAVITY}, mass_gradient={"gradient": 0.5})[:, 1] / 9.81
    weight -= torch.as_tensor(cloth.mass)
    height = cloth.vertices[:, 1]
    mean = np.average(height, weights=cloth.vertex_area)
    np.testing.assert_allclose(weight, 0.5 * (mean - height) * cloth.vertex_area, atol=1e-15)
    assert float(weight.sum()) == pytest.approx(0, abs=1e-15)


def test_openings_are_counted_from_the_lowest() -> None:
    cloth = tube()
    assert [cloth.vertices[loop, 1].max() for loop in ordered_loops(cloth)] == pytest.approx([0, 0.2])


@pytest.mark.parametrize("height", [1.0149, 1.0049, 0.0])
def test_cuffs_a_fifth_of_a_millimetre_apart_are_level(height: float) -> None:
    """Wherever they are; 2 cm apart the lower one comes first."""
    right, left = (np.array([[x, 0, 0], [x + 0.1, 0, 0], [x, 0, 0.1]]) for x in (-1.0, 1.0))
    for apart, first in ((0.0002, 3), (-0.0002, 3), (0.02, 0), (-0.02, 3)):
        vertices = np.concatenate([right, left + np.array((0, apart, 0))]) + np.array((0, height, 0))
        faces = np.array([[0, 1, 2], [3, 4, 5]])
        cloth = Cloth(vertices, faces, vertices[faces][..., [0, 2]], DENSITY, np.zeros(6), np.zeros(6))
        assert [loop.min() for loop in ordered_loops(cloth)] == [first, 3 - first]


def test_a_hem_weighs_its_line_density_times_its_length() -> None:
    cloth = tube()
    densities = (0.01, 0.03, 5.0, 5.0)
    x = torch.as_tensor(cloth.vertices)
    weight = gradient(cloth, x, gravity={"acceleration": GRAVITY}, heavy_hem={"line_density": densities})[:, 1] / 9.81
    weight = weight.numpy() - cloth.mass
    for loop, density in zip(ordered_loops(cloth), densities, strict=False):
        np.testing.assert_allclose(weight[loop], density * perimeter(loop, cloth) / len(loop), rtol=1e-9)
        weight[loop] = 0
    np.testing.assert_allclose(weight, 0, atol=1e-15)


def test_a_tight_opening_pulls_inwards() -> None:
    """Two tensions T meet at the angle of the regular polygon: 2 T sin(pi / n)."""
    cloth = tube()
    force = -gradient(cloth, torch.as_tensor(cloth.vertices), seam_tension={"tension": (0.0, 0.8, 9.0, 9.0)}).numpy()
    lower, upper = ordered_loops(cloth)
    outward = cloth.vertices[upper] * (1, 0, 1) / 0.05
    np.testing.assert_allclose(force[upper], -2 * 0.8 * np.sin(np.pi / 12) * outward, atol=1e-12)
    np.testing.assert_allclose(force[lower], 0, atol=1e-15)


def test_a_stretched_seam_pulls_by_its_stretch() -> None:
    cloth, s = flat_cloth(), 1.1
    x = torch.as_tensor(cloth.vertices) * s
    force = -gradient(cloth, x, seam_stiffness={"stiffness": (20.0, 0.0, 0.0, 0.0)})
    corner = int(np.argmin(cloth.vertices.sum(1)))
    np.testing.assert_allclose(force[corner], [20 * 0.1, 20 * 0.1, 0], rtol=1e-9)
    inner = np.setdiff1d(np.arange(len(x)), ordered_loops(cloth)[0])
    assert float(force[inner].abs().max()) == 0


def test_stiffness_and_tension_are_a_band_of_its_rest_length() -> None:
    cloth, k, tension = flat_cloth(), 20.0, 5.0
    x = torch.as_tensor(cloth.vertices) * k / (k + tension)
    band: Any = {"seam_stiffness": {"stiffness": (k, 0, 0, 0)}, "seam_tension": {"tension": (tension, 0, 0, 0)}}
    assert float(gradient(cloth, x, **band).abs().max()) < 1e-13


def test_a_cloth_without_openings_has_no_seams() -> None:
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    flat = np.array([[0, 0], [0.1, 0], [0, 0.1]])
    cloth = Cloth(vertices, faces, np.broadcast_to(flat, (4, 3, 2)), DENSITY, np.zeros(4), np.zeros(4))
    x = torch.as_tensor(vertices)
    effects: Any = {"gravity": {"acceleration": (0, 0, 0)}, "heavy_hem": {}, "seam_tension": {}, "seam_stiffness": {}}
    assert float(gradient(cloth, x, moving(x, torch.zeros(3)), **effects).abs().max()) == 0


def test_uniform_acceleration_is_force_per_mass() -> None:
    cloth = irregular_cloth()
    force = -gradient(cloth, moment(cloth).x, uniform_acceleration={"acceleration": (1.0, -2.0, 3.0)})
    np.testing.assert_allclose(force, cloth.mass[:, None] * [1.0, -2.0, 3.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("load", "values"),
    [
        ("extra_mass", {"density": 0.2}),
        ("heavy_hem", {"line_density": (0.02, 0.01, 0.0, 0.0)}),
        ("mass_gradient", {"gradient": 0.5}),
    ],
)
def test_what_goes_by_mass_goes_by_all_mass_with_weight(load: str, values: dict) -> None:
    """A uniform acceleration tilts gravity, and a damping is that of all mass: told by the weight of the cloth."""
    cloth = tube()
    x = torch.as_tensor(cloth.vertices)
    step = moving(x, torch.tensor((1.0, -2.0, 3.0), dtype=torch.float64))
    loaded: Any = {"gravity": {"acceleration": GRAVITY}, load: values}
    weight = gradient(cloth, x, gravity={"acceleration": GRAVITY}, **{load: values})[:, 1:2] / 9.81
    tilted = gradient(cloth, x, uniform_acceleration={"acceleration": (1.0, -2.0, 3.0)}, **loaded)
    torch.testing.assert_close(tilted - gradient(cloth, x, **loaded), weight * torch.tensor([-1.0, 2.0, -3.0]))
    damped = gradient(cloth, x, step, mass_damping={"rate": 2.0}, **loaded)
    torch.testing.assert_close(damped - gradient(cloth, x, step, **loaded), 2 * weight * torch.tensor([1.0, -2.0, 3.0]))


def test_slopes_by_a_load_count_the_acceleration_that_it_feels() -> None:
    cloth = irregular_cloth()
    at = moment(cloth)
    effects: Any = {"gravity": {}, "uniform_acceleration": {}, "mass_damping": {}}

    def loaded(density: float) -> torch.Tensor:
        return gradient(cloth, at.x, at.step, **effects, extra_mass={"density": density})

    potential = Potential(Model(DENSITY, {**effects, "extra_mass": {"density": 0.0}}), cloth)
    slope = potential.parameter_gradients(at.x, at.step, None, {"extra_mass.density"})["extra_mass.density"]
    torch.testing.assert_close(slope, (loaded(0.1) - loaded(-0.1)) / 0.2)


def test_a_pinched_mesh_can_be_accelerated() -> None:
    """Two triangles that meet in a vertex alone: no hem can be sewn along them."""
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]])
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    cloth = Cloth(vertices, faces, vertices[faces][..., :2], DENSITY, np.zeros(5), np.zeros(5))
    force = -gradient(cloth, torch.as_tensor(vertices), uniform_acceleration={"acceleration": (1.0, 0.0, 0.0)})
    np.testing.assert_allclose(force, cloth.mass[:, None] * [1.0, 0.0, 0.0], rtol=1e-12)


@pytest.mark.parametrize("thickness", [0.002, -0.001])
def test_thick_cloth_is_kept_at_a_greater_distance(thickness: float) -> None:
    cloth = irregular_cloth()
    at = moment(cloth)
    contact: Any = {"stiffness": 1e8, "distance": 0.004}
    wanted = gradient(cloth, at.x, None, at.body, body_contact={**contact, "distance": 0.004 + thickness})
    got = gradient(cloth, at.x, None, at.body, body_contact=contact, contact_thickness={"thickness": thickness})
    torch.testing.assert_close(got, wanted)


@pytest.mark.parametrize("thickness", [0.002, -0.001])
def test_thick_cloth_is_held_by_friction_as_at_a_greater_distance(thickness: float) -> None:
    cloth = irregular_cloth()
    at = moment(cloth)
    contact: Any = {"stiffness": 1e8, "distance": 0.004}
    farther: Any = {**contact, "distance": 0.004 + thickness}
    thick: Any = {"thickness": thickness}
    wanted = gradient(cloth, at.x, at.step, at.body, body_contact=farther, body_friction={})
    got = gradient(cloth, at.x, at.step, at.body, body_contact=contact, contact_thickness=thick, body_friction={})
    torch.testing.assert_close(got, wanted)


def test_an_effect_says_what_it_needs() -> None:
    with pytest.raises(CaphyError, match="shrinkage needs strain_stvk or strain_measured in the same model"):
        Model(DENSITY, {"shrinkage": {}})
    assert Model(DENSITY, {"shrinkage": {}, "strain_measured": {}})
    with pytest.raises(CaphyError, match="heavy_hem needs gravity"):
        Model(DENSITY, {"heavy_hem": {}})


def test_the_step_keeps_time_when_mapped() -> None:
    x = torch.zeros(2, 3)
    assert Step.implicit_euler(0.1, x, x, 0.7).map(lambda field: field + 1).time == 0.7
