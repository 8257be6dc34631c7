"""The loss against a plain loop over frames, and what is learnt from it; the preconditioned head."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_world import swaying, tube

from caphy.body.bundled import default_body
from caphy.body.kinematics import joint_transforms
from caphy.body.skinning import blend_transforms, skin
from caphy.body.surface import Surface
from caphy.effects.base import BodyState, Step
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.rotations import matrix_from_axis_angle
from caphy.training import loop
from caphy.training.learner import Learner, stiffness
from caphy.training.loop import evened
from caphy.training.motions import Motions
from caphy.training.objective import Objective, Past
from caphy.training.preconditioner import Preconditioner
from caphy.training.skin_seen import ByTree, InGroups
from caphy.training.streams import Windows

FRAMES = np.array([np.arange(5, 10), np.arange(20, 25), np.full(5, 12)])
SCORED = np.array([[0, 2, 1, 3, 4], [4, 1, 3, 2, 0], [0, 1, 2, 3, 4]])
WINDOWS = Windows(FRAMES, np.array([4, 19, 12]), np.array([True, False, False]), np.array([False, False, True]), SCORED)


@pytest.fixture(scope="module")
def world() -> tuple[Objective, Motions]:
    garment, body = tube(), default_body()
    model = snug_model().with_effect("body_friction")
    potential = Potential(model, Cloth.of(garment, model.density), torch.float64)
    template, weights = torch.tensor(garment.vertices), torch.tensor(garment.weights)
    motions = Motions.of([swaying(40)], body, [3], 30.0)
    motions.transforms.data = motions.transforms.double()
    return Objective(potential, body, template, weights, 30.0), motions


def random_offsets(size: float = 0.01) -> torch.Tensor:
    random = np.random.default_rng(0)
    return torch.tensor(random.normal(scale=size, size=(3, 5, len(tube().vertices), 3)))


def posed(motions: Motions, frame: int, offsets: torch.Tensor) -> torch.Tensor:
    garment, body = tube(), default_body()
    transforms = joint_transforms(matrix_from_axis_angle(motions.poses[frame]), body.joints, body.parents)
    points = skin(blend_transforms(garment.weights, transforms), garment.vertices + offsets.numpy())
    return torch.tensor(points + motions.transl[frame])


def plain_energies(world, offsets: torch.Tensor, past: Past) -> torch.Tensor:
    """One frame after another, nearest points from the exact tree."""
    objective, motions = world
    body, dt = default_body(), 1 / 30
    surface, mass = Surface.of(body.faces, body.v_template), torch.as_tensor(objective.potential.cloth.mass)
    total = torch.zeros(3, 5, dtype=torch.float64)
    for b in range(3):
        before, previous = past.before[b], past.previous[b]
        if WINDOWS.fresh[b]:
            previous = posed(motions, int(WINDOWS.before[b]), offsets[b, 0])
        for t, frame in enumerate(FRAMES[b]):
            x = posed(motions, frame, offsets[b, t])
            still = WINDOWS.held[b] or (WINDOWS.fresh[b] and t == 0)
            last = frame if still else frame - 1
            now, earlier = body.pose(motions.poses[[frame, last]], motions.transl[[frame, last]])
            found = surface.nearest(x.numpy(), now)
            corners = body.faces[found.face]
            velocity = (found.point - np.einsum("vk,vkc->vc", found.barycentric, earlier[corners])) / dt
            point = torch.tensor(found.point)
            anchor = posed(motions, frame, 0 * offsets[b, t])
            state = BodyState(point, torch.tensor(found.normal), torch.tensor(velocity), anchor)
            step = Step.implicit_euler(dt, x, x) if still else Step.implicit_euler(dt, previous, before)
            total[b, t] = sum(objective.potential.energies(x, step, state).values())
            total[b, t] -= 9.81 * (mass * anchor[:, 1]).sum()  # weight counts from the skinned template
            before, previous = previous, x
    return torch.gather(total, 1, torch.from_numpy(SCORED))


def random_past(world) -> Past:
    _, motions = world
    offsets = random_offsets()
    before, previous = (torch.stack([posed(motions, f, offsets[0, 0] * k) for f in (3, 18, 12)]) for k in (0.9, 1.1))
    return Past(before, previous)


def test_equals_a_plain_loop_over_frames(world):
    objective, motions = world
    past = random_past(world)
    actual, _ = objective(motions, WINDOWS, random_offsets(), past)
    torch.testing.assert_close(actual, plain_energies(world, random_offsets(), past), rtol=2e-4, atol=2e-5)


def test_returns_the_last_two_frames(world):
    objective, motions = world
    _, past = objective(motions, WINDOWS, random_offsets(), random_past(world))
    for b in range(3):
        torch.testing.assert_close(past.before[b], posed(motions, FRAMES[b, 3], random_offsets()[b, 3]))
        torch.testing.assert_close(past.previous[b], posed(motions, FRAMES[b, 4], random_offsets()[b, 4]))
    assert not past.previous.requires_grad


def test_history_is_detached(world):
    """The potential of a frame pulls on that frame alone."""
    objective, motions = world
    offsets = random_offsets().requires_grad_(True)
    potential, _ = objective(motions, WINDOWS, offsets, random_past(world))
    (gradient,) = torch.autograd.grad(potential[1, 2], offsets)  # frame 3 of window 1
    size = gradient.norm(dim=(2, 3))
    assert size[1, 3] > 1e-3
    size[1, 3] = 0
    assert (size == 0).all()


def test_gradient_against_finite_differences(world):
    """Of the last frame of each window, which is nobody's past, in the vertices outside the body."""
    objective, motions = world
    past, offsets = random_past(world), random_offsets().requires_grad_(True)
    last = replace(WINDOWS, scored=np.full((3, 1), 4))
    potential, _ = objective(motions, last, offsets, past)
    (gradient,) = torch.autograd.grad(potential.sum(), offsets)
    direction, step = torch.zeros_like(offsets), 1e-3  # 10 micrometres: above float32 rounding
    direction[:, 4] = random_offsets()[:, 4]
    up, down = (objective(motions, last, offsets.detach() + s * direction, past)[0].sum() for s in (step, -step))
    torch.testing.assert_close((gradient * direction).sum(), (up - down) / (2 * step), rtol=1e-4, atol=1e-6)


def test_preconditioned_head_is_the_network_s_head(make_trainer):
    trainer = make_trainer()
    learner, network = trainer.learner, trainer.network
    torch.nn.init.normal_(learner.head.weight)
    torch.nn.init.normal_(learner.head.bias)
    features = torch.randn(2, 3, network.gru.input_size)
    offsets, hidden = learner(features, trainer.track.hidden[:, :2])
    learner.fold(network)
    folded, after = network.offsets(features, trainer.track.hidden[:, :2])
    torch.testing.assert_close(offsets, folded, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(hidden, after)


def test_a_step_in_the_head_is_a_newton_step_of_the_linear_cloth(make_trainer):
    """dU = S S^T (-g) solves the template's stiffness, up to one factor for all; held against scipy's dense inverse."""
    potential = make_trainer().objective.potential
    stiff = stiffness(Potential(potential.model, potential.cloth), 30.0)
    unit = torch.eye(stiff.shape[0], dtype=torch.float64, requires_grad=True)
    basis = Preconditioner(stiff).times(unit)
    basis.backward(basis.detach())  # the gradient of |S|^2 / 2: S^T S
    basis = basis.detach().numpy()
    product = stiff @ basis @ basis.T
    np.testing.assert_allclose(product, product[0, 0] * np.eye(len(product)), atol=1e-9 * product[0, 0])
    np.testing.assert_allclose(unit.grad, basis.T @ basis, atol=1e-12 * product[0, 0])
    np.testing.assert_allclose(np.sqrt((basis**2).sum(1).mean()), 0.01)
    assert isinstance(make_trainer("other").model, Learner)


def test_cloth_without_inertia_is_preconditioned_as_with_it(make_trainer):
    """Nothing else holds what is not attached: without it offsets could but move rigidly."""
    potential = make_trainer().objective.potential
    still = replace(
        potential.model, effects={name: given for name, given in potential.model.effects.items() if name != "inertia"}
    )
    with_it, without = (stiffness(Potential(model, potential.cloth), 30.0) for model in (potential.model, still))
    np.testing.assert_allclose(with_it.toarray(), without.toarray(), rtol=1e-12)


def test_a_frame_of_high_potential_counts_for_less():
    """Slopes of 1 up to zero, a half at the usual potential, and as 1 / potential beyond; no jump in between."""
    potential = torch.tensor([-0.2, -1e-9, 1e-9, 0.5, 4.5], dtype=torch.float64, requires_grad=True)
    seen = evened(potential, 0.5)
    seen.sum().backward()
    torch.testing.assert_close(potential.grad, torch.tensor([1, 1, 1, 0.5, 0.1], dtype=torch.float64))
    torch.testing.assert_close(seen[1], seen[2], rtol=0, atol=1e-8)


def test_motions_are_learnt_evened_and_scans_are_not(make_trainer, monkeypatch):
    asked = []
    monkeypatch.setattr(loop, "evened", lambda loss, usual: (asked.append((loss.detach(), usual)), loss)[1])
    trainer = make_trainer()
    told = trainer.step()
    ((loss, usual),) = asked
    assert told == pytest.approx(float(loss.mean()))
    assert usual == pytest.approx(0.12 * tube().rest_areas.sum())
    monkeypatch.setattr(trainer, "scans", object())  # as if there were some, which weigh against physics
    monkeypatch.setattr(trainer, "_turn", lambda: trainer.track)
    trainer.step()
    assert len(asked) == 1


@pytest.mark.parametrize("corrected", [False, True])
def test_in_groups_cloth_sees_the_body_that_it_sees_by_a_tree(corrected):
    """Of another shape, turning and travelling; the bundled body has no pose correctives, SMPL-X's has."""
    body, random = default_body(), np.random.default_rng(5)
    if corrected:
        body = replace(body, posedirs=0.01 * random.normal(size=(*body.v_template.shape, 486)))
    betas, template = np.array([1.5, -1.0]), torch.tensor(tube().vertices)
    motions = Motions.of([swaying(40)], body, [3], 30.0, betas)
    frames, last = np.array([5, 20, 12]), np.array([4, 19, 12])
    x = torch.tensor(np.stack([posed(motions, frame, random_offsets(0.02)[0, 0]).numpy() for frame in frames]))
    tree, groups = (sees(body, betas, template)(motions, frames, last, x, 1 / 30) for sees in (ByTree, InGroups))
    for one, other in zip(groups, tree, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=2e-5)
    still = tree[2].norm(dim=-1).amax(1)
    assert still[2] == 0 and still[0] > 0.1
