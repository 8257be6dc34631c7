"""The sum of the effects: shapes, threads, devices, and what it refuses."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from caphy.effects import potential as potential_module
from caphy.effects.base import companions
from caphy.effects.battery import kernel_agrees
from caphy.effects.cloth import Cloth
from caphy.effects.compiled import KERNELS
from caphy.effects.gravity import Gravity
from caphy.effects.model import Model
from caphy.effects.potential import Potential, kernel_of
from caphy.effects.presets import fabric_model, snug_model
from caphy.effects.registry import find_effect, registered_effects
from caphy.effects.trial import flat_cloth, irregular_cloth, moment, pleated_cloth
from caphy.errors import CaphyError
from caphy.recorded import WARM


@pytest.mark.parametrize("model", [snug_model(), fabric_model("gray-interlock")], ids=["snug", "measured"])
def test_compiled_loops_say_what_the_closed_forms_say(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    cloth = irregular_cloth()
    at = moment(cloth, (4,))
    potential = Potential(model, cloth)
    compiled = potential.gradient(at.x, at.step, at.body)
    monkeypatch.setattr(potential_module, "kernel_of", lambda effect: None)
    torch.testing.assert_close(compiled, potential.gradient(at.x, at.step, at.body), rtol=1e-11, atol=1e-14)


def test_every_compiled_loop_is_used() -> None:
    assert all(kernel_of(effect) is not None for effect in KERNELS)


@pytest.fixture
def heavier(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Somebody has changed the formula of the weight, and its compiled loop not."""
    plain = Gravity.gradient
    monkeypatch.setattr(Gravity, "energy", lambda self, e, p: 2 * gravity_energy(self, e, p))
    monkeypatch.setattr(Gravity, "gradient", lambda self, e, p: tuple(2 * part for part in plain(self, e, p)))
    kernel_of.cache_clear()
    yield
    kernel_of.cache_clear()


gravity_energy = Gravity.energy


def test_the_file_of_an_effect_rules_over_its_compiled_loop(heavier: None) -> None:
    cloth = flat_cloth()
    x = torch.as_tensor(cloth.vertices)
    _, gradient = Potential(Model(0.2, {"gravity": {}}), cloth).gradient(x)
    weight = 2 * 9.81 * 0.2 * float(cloth.vertex_area.sum())
    assert float(gradient[:, 1].sum()) == pytest.approx(weight)
    with pytest.raises(AssertionError, match=r"effects.gravity and its compiled loop \(_gravity .* change it too"):
        kernel_agrees("gravity")


def test_the_total_is_the_sum_of_its_effects() -> None:
    cloth = irregular_cloth()
    at = moment(cloth, (2,))
    potential = Potential(snug_model(), cloth)
    energy, _ = potential.gradient(at.x, at.step, at.body)
    torch.testing.assert_close(energy, torch.stack(list(potential.energies(at.x, at.step, at.body).values())).sum(0))


def test_the_number_of_threads_changes_nothing() -> None:
    cloth = irregular_cloth()
    at = moment(cloth, (5,))
    potential, threads = Potential(snug_model(), cloth), torch.get_num_threads()
    try:
        results = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            results.append(potential.gradient(at.x, at.step, at.body))
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


def test_the_loss_weighs_frames_and_detaches_history() -> None:
    cloth = irregular_cloth()
    at = moment(cloth, (3,))
    potential = Potential(snug_model(), cloth)
    x = at.x.clone().requires_grad_(True)
    previous = at.step.origin.clone().requires_grad_(True)
    weights = torch.tensor([1.0, 0.0, -2.0], dtype=torch.float64)
    step = type(at.step).implicit_euler(at.step.dt, previous, at.step.lagged)
    (weights * potential.loss(x, step, at.body)).sum().backward()
    _, gradient = potential.gradient(at.x, step, at.body)
    torch.testing.assert_close(x.grad, weights[:, None, None] * gradient)
    assert previous.grad is None


def test_missing_numbers_are_passed_on() -> None:
    cloth = irregular_cloth()
    at = moment(cloth)
    at.x[3, 1] = torch.nan
    for model in (snug_model(), fabric_model("gray-interlock")):
        energy, gradient = Potential(model, cloth).gradient(at.x, at.step, at.body)
        assert bool(energy.isnan()) and bool(gradient[3].isnan().any())


def test_positions_of_another_cloth_or_precision_are_refused() -> None:
    potential = Potential(snug_model(), flat_cloth())
    with pytest.raises(ValueError, match=r"positions must be \(\.\.\., 42, 3\) torch.float64"):
        potential.gradient(torch.zeros(43, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"got \(42, 3\) torch.float32"):
        potential.gradient(torch.zeros(42, 3))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("name", registered_effects() if torch.cuda.is_available() else ["inertia"])
def test_a_cuda_device_gives_the_same(name: str) -> None:
    """Called so often that it is recorded, each time elsewhere."""
    cloth = irregular_cloth()
    at = moment(cloth, (2,)).to(torch.float32)
    effects: dict[str, Any] = {other: {} for other in (*companions(find_effect(name)), name)}
    here, there = (Potential(Model(0.2, effects), cloth, torch.float32, device) for device in ("cpu", "cuda"))
    for shift in range(WARM + 3):
        moved = at.map(lambda field, by=0.001 * shift: field + by * field.flip(-1))
        away = moved.map(lambda field: field.cuda())
        mine, theirs = (p.gradient(m.x, m.step, m.body) for p, m in ((here, moved), (there, away)))
        for one, other in zip(mine, theirs, strict=True):
            scale = float(one.abs().max())
            torch.testing.assert_close(other.cpu(), one, rtol=1e-4, atol=1e-5 * scale + 1e-12)
    (recorded,) = there._recorded.values()
    assert recorded._plays and recorded._work not in recorded._plays.values()


@pytest.mark.parametrize("name", registered_effects())
def test_nothing_is_made_on_another_device(name: str) -> None:
    """On the meta device, which computes shapes only, mixing in a tensor of the CPU raises."""
    cloth = irregular_cloth()
    at = moment(cloth, (2,)).to(torch.float32)
    effects: dict[str, Any] = {other: {} for other in (*companions(find_effect(name)), name)}
    potential = Potential(Model(0.2, effects), cloth, torch.float32, "meta")
    at = at.map(lambda field: field.to("meta"))
    x, step, body = at.x, at.step, at.body
    energy, gradient = potential.gradient(x, step, body)
    assert energy.is_meta and gradient.is_meta and gradient.shape == x.shape
    for _, term, elements in potential.acting(x, step, body):
        for hessian in (term.effect.hessian, term.effect.projected_hessian):
            assert hessian(elements, term.values).is_meta


def test_density_is_the_models() -> None:
    cloth = flat_cloth()
    potential = Potential(Model(0.5, {"gravity": {}}), cloth)
    _, gradient = potential.gradient(torch.as_tensor(cloth.vertices))
    assert float(gradient[:, 1].sum()) == pytest.approx(0.5 * 0.012 * 9.81)


def test_a_cloth_without_attachment_is_left_alone() -> None:
    cloth = flat_cloth()
    free = Cloth(cloth.vertices, cloth.faces, cloth.material, 0.2, cloth.layer_thickness, np.zeros(len(cloth.vertices)))
    at = moment(free, (2,))
    potential = Potential(Model(0.2, {"attachment": {}}), free)
    energy, gradient = potential.gradient(at.x, at.step, at.body)
    assert float(energy.abs().max()) == 0 and float(gradient.abs().max()) == 0
    ((_, term, elements),) = potential.acting(at.x, at.step, at.body)
    assert term.effect.projected_hessian(elements, term.values).shape[-1] == 0


@pytest.mark.parametrize("cloth", [flat_cloth(), pleated_cloth(), irregular_cloth()])
def test_rest_measures_of_a_cloth(cloth: Cloth) -> None:
    assert cloth.mass.sum() == pytest.approx(cloth.density * cloth.face_area.sum())
    lengths = np.linalg.norm(cloth.hinge_edges, axis=-1)
    np.testing.assert_allclose(lengths[:, 0], lengths[:, 1], rtol=1e-9)
    a, b, c = np.moveaxis(cloth.material, 1, 0)
    edges = np.stack([b - a, c - a], -1)
    np.testing.assert_allclose(edges @ cloth.face_inverse, np.broadcast_to(np.eye(2), edges.shape), atol=1e-9)


def test_a_face_without_rest_area_is_refused() -> None:
    class Sliver:
        name = "sliver"
        vertices = np.zeros((3, 3))
        faces = np.array([[0, 1, 2]])
        material = np.array([[[0, 0], [1, 0], [2, 0]]], dtype=float)
        layer_thickness = attached = np.zeros(3)

    with pytest.raises(CaphyError, match="'sliver': every face needs a rest area, but 1 of 1 have none"):
        Cloth.of(Sliver(), 0.2)


def test_an_area_that_rounding_left_is_none() -> None:
    """Two vertices in one place have material corners 1e-11 m apart where the face was laid flat."""

    class Sliver:
        name = "sliver"
        vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0]], dtype=float)
        faces = np.array([[0, 1, 2]] * 3 + [[0, 2, 3], [1, 3, 2]])
        material = np.array(
            [[[0, 0], [1, 0], [0, 1]]] * 3 + [[[0, 0], [0, 1], [-1e-11, 1]], [[0, 0], [1, 1e-11], [1, 0]]]
        )
        layer_thickness = attached = np.zeros(4)

    with pytest.raises(CaphyError, match=r"2 of 5 have none \(first: face 3\)"):
        Cloth.of(Sliver(), 0.2)
