"""E_3d against plain loops, what of the cloth a scan shows, whose turn it is, and who hides whom."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import trimesh
from small_scans import posed, sampled, scan, supervised_trainer, worn, write_run
from small_world import tube

from caphy.body.bundled import default_body
from caphy.body.surface import Surface
from caphy.effects.base import BodyState, Step
from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.garment.topology import face_areas
from caphy.register.points import ScanPoints, read_points, read_split, split
from caphy.training.counterparts import Grouped, Target, look
from caphy.training.scans import FARTHEST, Chamfer, ScanStreams, innermost_first, scan_motions
from caphy.training.streams import HELD_WINDOWS


def vertex_area(garment: Garment) -> np.ndarray:
    area = np.zeros(len(garment.vertices))
    np.add.at(area, garment.faces, face_areas(garment.material)[:, None] / 3)
    return area


def chamfer(garment: Garment) -> Chamfer:
    return Chamfer(garment.faces, garment.vertices, vertex_area(garment))


def points_of(lower: np.ndarray, upper: np.ndarray | None = None, body: np.ndarray | None = None) -> ScanPoints:
    none = np.zeros((0, 3), np.float32)
    parts = [none if part is None else part.astype(np.float32) for part in (body, upper, lower)]
    return ScanPoints("made", *parts, np.zeros((55, 3)), np.zeros(3))


def crumpled(size: float = 0.004) -> np.ndarray:
    vertices = tube().vertices
    return vertices + np.random.default_rng(1).normal(scale=size, size=vertices.shape)


def from_surface(points: np.ndarray, x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distances (N,) of points from a mesh: the least over all its triangles."""
    triangles, each = np.tile(x[faces], (len(points), 1, 1)), np.repeat(points, len(faces), axis=0)
    apart = np.linalg.norm(trimesh.triangles.closest_point(triangles, each) - each, axis=1)
    return apart.reshape(len(points), -1).min(axis=1)


def test_both_sides_are_mean_squares_of_plain_loops():
    garment, x = tube(), crumpled()
    points = sampled(worn(garment, 0.005), garment.faces, 2500, 2).astype(np.float32).astype(np.float64)
    there = np.linalg.norm(x[:, None] - points, axis=2).min(axis=1)
    area = vertex_area(garment)
    expected = (area * there**2).sum() / area.sum() + (from_surface(points, x, garment.faces) ** 2).mean()
    (found,) = chamfer(garment)(torch.tensor(x[None]), [Target.of(points_of(points), "lower", ())])
    assert float(found) == pytest.approx(expected, rel=1e-5)


def test_gradient_against_finite_differences():
    """Nearest points are looked up anew on either side of the step."""
    garment, target = tube(), Target.of(scan(0), "lower", ())
    loss = chamfer(garment)
    at = posed(garment.vertices, garment.weights, scan(0).pose, scan(0).transl)
    x = torch.tensor(at[None], requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(x, [target]), x)
    direction = torch.tensor(np.random.default_rng(3).normal(size=x.shape))
    up, down = (float(loss(x.detach() + sign * 1e-7 * direction, [target])) for sign in (1, -1))
    assert float((gradient * direction).sum()) == pytest.approx((up - down) / 2e-7, rel=1e-4)


def test_what_another_garment_hides_is_not_pulled():
    garment = tube()
    x, below = garment.vertices, garment.vertices[:, 1] < 0
    points = sampled(worn(garment), garment.faces, 4000, 2)
    shirt = points[points[:, 1] > 0] * [1.05, 1, 1.05]
    scanned = points_of(points[points[:, 1] < 0], shirt)
    _, shown = Target.of(scanned, "lower", ("upper",)).counterparts(x)
    assert (shown == below).mean() > 0.98
    moved = torch.tensor(x[None], requires_grad=True)
    target, loss = Target.of(scanned, "lower", ("upper",)), chamfer(garment)
    gradient = torch.autograd.grad(loss.to_points(moved, look(loss.surface, moved, [target])), moved)[0][0]
    assert (gradient[torch.tensor(~shown)] == 0).all() and (gradient[torch.tensor(shown)] != 0).any(-1).all()
    # The shirt itself lies on top: nothing hides it, though trousers are near.
    assert Target.of(scanned, "upper", ()).counterparts(shirt)[1].all()


def test_what_no_camera_saw_is_not_pulled_but_cloth_over_bare_skin_is():
    garment = tube()
    x = garment.vertices
    seen = sampled(x, garment.faces, 4000, 2)
    front = seen[seen[:, 2] > 0.01]
    _, shown = Target.of(points_of(front), "lower", ()).counterparts(x)
    assert shown[x[:, 2] > 0.02].all() and not shown[x[:, 2] < -0.03].any()
    skin = seen[seen[:, 2] < 0.01] * [0.95, 1, 0.95]
    assert Target.of(points_of(front, body=skin), "lower", ()).counterparts(x)[1].all()


@pytest.mark.parametrize("thinned", [20_000, 60])
def test_groups_find_the_counterparts_that_trees_find(monkeypatch, thinned):
    """On the CPU too, on which no training uses them; scans of different sizes, one under a shirt, one half unseen.

    Where everything is thinned far, the garment's own points alone tell that it was seen.
    """
    monkeypatch.setattr("caphy.training.counterparts.THINNED", thinned)
    garment = tube()
    points = sampled(worn(garment), garment.faces, 4000, 2)
    shirt = points[points[:, 1] > 0] * [1.05, 1, 1.05]
    scanned = [
        points_of(points[points[:, 1] < 0], shirt),
        points_of(points[points[:, 2] > 0.01]),
        points_of(points[:90]),
    ]
    targets = [Target.of(scan, "lower", ("upper",)) for scan in scanned]
    x = torch.tensor(np.stack([crumpled(), garment.vertices, crumpled(0.01)])).float()
    loss = chamfer(garment)
    trees = look(loss.surface, x, targets)
    groups = Grouped(loss.surface, targets[::-1], x.device).look(x, [2, 1, 0])
    assert {int(shown.sum()) for shown in trees.shown} != {len(garment.vertices)}
    for name in ("point", "shown", "sample", "share"):
        torch.testing.assert_close(getattr(groups, name), getattr(trees, name), rtol=0, atol=1e-6)
    torch.testing.assert_close(loss.apart(x, groups), loss.apart(x, trees), rtol=1e-5, atol=0)


def test_points_without_a_counterpart_do_not_pull():
    garment, x = tube(), torch.tensor(crumpled()[None], requires_grad=True)
    points = sampled(garment.vertices, garment.faces, 500, 2)
    strays = np.concatenate([points, points[:50] + np.array([0, 2 * FARTHEST, 0.5])])
    gradients = []
    for given in (points, strays):
        target, loss = Target.of(points_of(given), "lower", ()), chamfer(garment)
        loss = loss.to_cloth(x, look(loss.surface, x, [target])) * len(given)
        gradients.append(torch.autograd.grad(loss, x)[0])
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=1e-12)


def test_an_epoch_shows_every_scan_for_three_windows_from_a_cold_start():
    streams, shown = ScanStreams(7, 4, seed=3), []
    for _ in range(7 * HELD_WINDOWS):
        windows = streams.advance()
        assert windows.held.all() and (windows.frames == windows.frames[:, :1]).all()
        shown += [(int(scan), bool(fresh)) for scan, fresh in zip(windows.frames[:, 0], windows.fresh, strict=True)]
    counts = np.bincount([scan for scan, _ in shown], minlength=7)
    assert (counts == 4 * HELD_WINDOWS).all()
    assert sum(fresh for _, fresh in shown) == len(shown) // HELD_WINDOWS
    other = ScanStreams(7, 4, seed=3)
    for _ in range(5):
        other.advance()
    again = ScanStreams(7, 4, seed=3)
    again.restore(other.place)
    np.testing.assert_array_equal(again.advance().frames, other.advance().frames)


def test_the_loss_is_the_potential_at_rest_and_lambda_times_the_distances(tmp_path):
    trainer = supervised_trainer(tmp_path / "both", scans=3)
    assert trainer.scans is not None
    given, potential = trainer.scans, trainer.objective.potential
    windows = ScanStreams(3, 3, 0).advance()
    offsets = 0.005 * torch.randn(3, 1, len(tube().vertices), 3)
    x, loss, _ = given.loss.judge(given.motions, windows, offsets, trainer.track.past)
    distances, body = [], default_body()
    surface = Surface.of(body.faces, body.v_template)
    for b, index in enumerate(windows.frames[:, 0]):
        seen = scan(index, 300)
        at = posed(tube().vertices + offsets[b, 0].numpy(), tube().weights, seen.pose, seen.transl)
        np.testing.assert_allclose(x[b, 0].numpy(), at, atol=2e-6)
        near = surface.nearest(at, body.pose(seen.pose[None], seen.transl[None])[0])
        anchor = posed(tube().vertices, tube().weights, seen.pose, seen.transl)
        fields = (torch.tensor(f, dtype=torch.float32) for f in (at, near.point, near.normal, 0 * at, anchor))
        now, point, normal, velocity, anchored = fields
        state, rest = BodyState(point, normal, velocity, anchored), Step.implicit_euler(1 / 30, now, now)
        distances.append(float(given.loss.chamfer(torch.tensor(at[None]), [given.loss.targets[index]])))
        expected = sum(potential.energies(now, rest, state).values()) + 1000 * distances[-1]
        expected -= 9.81 * potential.model.density * (vertex_area(tube()) * anchor[:, 1]).sum()  # wherever the floor is
        assert float(loss[b, 0]) == pytest.approx(float(expected), rel=1e-4)
    bare = supervised_trainer(tmp_path / "bare", scans=3, physics=False).scans
    _, alone, _ = bare.loss.judge(bare.motions, windows, offsets, trainer.track.past)
    np.testing.assert_allclose(alone[:, 0].numpy(), 1000 * np.array(distances), rtol=1e-4)


@pytest.mark.parametrize("physics", [True, False])
def test_one_epoch_of_motions_to_four_of_scans(tmp_path, monkeypatch, physics):
    trainer, played = supervised_trainer(tmp_path, scans=4, physics=physics), []
    for name, track in (("motion", trainer.track), ("scan", trainer.scan_track)):
        monkeypatch.setattr(track, "advance", lambda model, name=name: played.append(name) or (None, model.zero()))
    monkeypatch.setattr(type(trainer.learner), "zero", lambda self: sum(0 * p.sum() for p in self.parameters()), False)
    for _ in range(30):
        trainer.step()
    epoch = 4 * HELD_WINDOWS // 4
    assert played == (2 * (epoch * ["motion"] + 4 * epoch * ["scan"]) if physics else 30 * ["scan"])


def test_the_inner_garment_is_the_one_that_scans_hide():
    garment, points = tube(), []
    for index in range(3):
        cloth = scan(index, 4000)
        low = cloth.lower[:, 1] < cloth.transl[1]
        points.append(ScanPoints(cloth.name, cloth.body, cloth.lower[~low] * [1.02, 1, 1.02], cloth.lower[low],
                                 cloth.pose, cloth.transl))  # fmt: skip
    short = garment.vertices[:, 1] > 0
    worn_parts = {
        "lower": (garment.vertices, garment.weights),
        "upper": (1.02 * garment.vertices[short], garment.weights[short]),
    }
    motions = scan_motions(points, default_body(), [0], 30.0)
    assert innermost_first(points, worn_parts, motions) == ["lower", "upper"]
    exchanged = [ScanPoints(p.name, p.body, p.lower, p.upper, p.pose, p.transl) for p in points]
    parts = {"lower": worn_parts["upper"], "upper": worn_parts["lower"]}
    assert innermost_first(exchanged, parts, motions) == ["upper", "lower"]


def test_points_survive_their_file_and_mistakes_are_named(tmp_path):
    run = write_run(tmp_path, train=2, held_out=1)
    (held_out,) = read_points(run, "held_out")
    assert held_out.name == "scan2"
    for name in ("body", "upper", "lower", "pose", "transl"):
        np.testing.assert_array_equal(getattr(held_out, name), getattr(scan(2), name))
    path = run / "points" / "scan1.npz"
    arrays = dict(np.load(path))
    for key, value, message in (
        ("pose", np.zeros((3, 3)), "pose is missing or of the wrong shape"),
        ("lower", np.full((60, 3), np.nan), "lower must be finite"),
        ("format", np.array("other"), "caphy register points"),
    ):
        np.savez(path, **{**arrays, key: value})
        with pytest.raises(CaphyError, match=message):
            read_points(run, "train")
    np.savez(path, **{**arrays, "lower": arrays["lower"][:10]})
    with pytest.raises(CaphyError, match="scan1: has 10 points of the lower garment"):
        Target.of(read_points(run, "train")[1], "lower", ())
    (run / "split.json").write_text(json.dumps({"train": ["scan0", "scan2"], "held_out": ["scan2"]}))
    with pytest.raises(CaphyError, match="scan2 is both"):
        read_split(run)


def test_a_fifth_is_held_out_and_the_seed_says_which():
    names = [f"scan{i}" for i in range(40)]
    sides = split(names, 3)
    assert len(sides["held_out"]) == 8 and sorted(sides["train"] + sides["held_out"]) == sorted(names)
    assert split(names, 3) == sides != split(names, 4)
    assert split(["one"]) == {"train": ["one"], "held_out": []}
