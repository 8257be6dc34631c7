"""Measurements: both file forms round-trip, and everything wrong with a file is said in words that help."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from caphy.body.bundled import default_body
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement, read_measurement, write_measurement
from caphy.io.measurements.archive import to_arrays
from caphy.io.measurements.checks import require_plausible
from caphy.io.procedural import procedural_motion


def grid(count: int = 6, side: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.linspace(0, side, count), np.linspace(0, side, count))
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + count + 1, corner + count
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([a, d, c], -1)])
    return np.stack([u.ravel(), -v.ravel(), 0 * u.ravel()], -1), faces


def swinging(frames: int = 20) -> Measurement:
    """A hanging sheet that swings like a pendulum, held at its two upper corners."""
    rest, faces = grid()
    angle = 0.6 * np.sin(2.5 * np.arange(frames) / 30 * 2)
    turned = np.stack([np.broadcast_to(rest[:, 0], (frames, len(rest))), *_turned(rest, angle)], -1)
    pinned = np.array([5, 0])
    return Measurement(
        name="sheet",
        fps=30.0,
        vertices=turned,
        faces=faces,
        rest_vertices=rest,
        pinned=pinned,
        pinned_positions=turned[:, pinned],
        source="sheet.npz",
    )


def _turned(rest: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return rest[:, 1] * np.cos(angle)[:, None], rest[:, 1] * np.sin(angle)[:, None]


def dressed(frames: int = 8) -> Measurement:
    """The skin of a chest as clothing on a moving body."""
    body, motion = default_body(), procedural_motion(3, 1.0, 30.0).to_y_up()
    poses, transl = motion.poses[:frames], motion.transl[:frames]
    chest = np.flatnonzero(body.weights[:, [3, 6, 9]].sum(1) > 0.9)
    place = np.full(len(body.v_template), -1)
    place[chest] = np.arange(len(chest))
    faces = place[body.faces[(place[body.faces] >= 0).all(1)]]
    return Measurement(
        name="vest",
        fps=30.0,
        vertices=body.pose(poses, transl)[:, chest],
        faces=faces,
        rest_vertices=body.v_template[chest],
        weights=body.weights[chest],
        poses=poses,
        transl=transl,
        source="vest.npz",
    )


def same(a: Measurement, b: Measurement) -> None:
    left, right = to_arrays(a), to_arrays(b)
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)


def test_npz_round_trip_keeps_everything(tmp_path):
    vertices = swinging().vertices.copy()
    vertices[3], vertices[5, :7] = np.nan, np.nan
    visible = np.ones(vertices.shape[:2], bool)
    visible[8, 2] = False
    given = replace(
        swinging(), vertices=vertices, visibility=visible, noise_mm=1.5, regions=np.repeat(["hem", "top"], 18)
    )
    same(given, read_measurement(write_measurement(given, tmp_path / "a.npz")))


def test_folder_round_trip_keeps_everything(tmp_path):
    vertices = swinging().vertices.copy()
    vertices[0], vertices[5, :7] = np.nan, np.nan
    given = replace(swinging(), vertices=vertices, noise_mm=0.5)
    back = read_measurement(write_measurement(given, tmp_path / "sheet"))
    same(given, back)
    assert len(back.seen_frames) == len(given) - 1


def test_folder_of_another_program(tmp_path):
    """OBJ files written by trimesh, numbered from 7 with a gap, z up; one vertex was not seen in one of them."""
    vertices = swinging().vertices.copy()
    vertices[4, 20] = np.nan
    given = replace(swinging(), vertices=vertices)
    to_z_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    trimesh.Trimesh(given.rest_vertices, given.faces, process=False).export(tmp_path / "rest.obj")
    for frame in (0, 1, 2, 4, 5):
        mesh = trimesh.Trimesh(given.vertices[frame] @ to_z_up.T, given.faces, process=False)
        (tmp_path / f"scan_{frame + 7:03d}.obj").write_text(trimesh.exchange.obj.export_obj(mesh, digits=12))
    (tmp_path / "measurement.toml").write_text('fps = 30\nrest = "rest.obj"\nup_axis = "z"\n')
    back = read_measurement(tmp_path)
    assert len(back) == 6
    assert back.seen_frames.tolist() == [0, 1, 2, 4, 5]
    np.testing.assert_allclose(back.vertices[[0, 4]], given.vertices[[0, 4]], atol=1e-9)
    assert np.argwhere(~back.observed[[0, 1, 2, 4, 5]]).tolist() == [[3, 20]]


def test_a_rest_mesh_is_found_by_its_name(tmp_path):
    given = swinging()
    write_measurement(given, tmp_path / "flag")
    (tmp_path / "flag" / "measurement.toml").write_text("fps = 30\n")
    back = read_measurement(tmp_path / "flag")
    assert back.registered and back.rest_vertices.shape == given.rest_vertices.shape


def test_cloth_that_hangs_upwards_is_told():
    given, turn = swinging(), np.array([1.0, -1, -1])
    turned = replace(given, vertices=given.vertices * turn, pinned_positions=given.pinned_positions * turn)
    require_plausible(turned, axes_stated=True)
    with pytest.raises(CaphyError, match="hangs upwards"):
        require_plausible(turned, axes_stated=False)


def test_cloth_that_hangs_sideways_is_told():
    given, order = swinging(), [1, 0, 2]
    turned = replace(given, vertices=given.vertices[..., order], pinned_positions=given.pinned_positions[..., order])
    require_plausible(turned, axes_stated=True)
    with pytest.raises(CaphyError, match="hangs along -x from its pins"):
        require_plausible(turned, axes_stated=False)


def test_clouds_round_trip_in_both_forms(tmp_path):
    cloud = np.random.default_rng(0).uniform(0, 0.5, (90, 3))
    given = Measurement(name="scan", fps=15.0, points=cloud, offsets=np.array([0, 40, 40, 90]))
    for name in ("scan.npz", "scan"):
        back = read_measurement(write_measurement(given, tmp_path / name))
        same(given, back)
        assert back.seen_frames.tolist() == [0, 2]
        np.testing.assert_array_equal(back.cloud(2), cloud[40:])


def test_frame_index_leaves_missing_frames_empty(tmp_path):
    arrays = to_arrays(swinging())
    kept = np.array([0, 1, 2, 5, 6, 19])
    arrays |= {"vertices": arrays["vertices"][kept], "frame_index": kept}
    np.savez(tmp_path / "gaps.npz", **arrays)
    back = read_measurement(tmp_path / "gaps.npz")
    assert len(back) == 20
    assert back.seen_frames.tolist() == kept.tolist()


@pytest.mark.parametrize("kind", [bool, int, float])
def test_visibility_of_any_kind_has_nothing_in_missing_frames(tmp_path, kind):
    """Of numbers with a point these were NaN, which is neither seen nor hidden."""
    arrays = to_arrays(swinging())
    kept = np.array([0, 1, 2, 5, 6, 19])
    seen = np.ones(arrays["vertices"][kept].shape[:2], kind)
    seen[:, 0] = 0
    arrays |= {"vertices": arrays["vertices"][kept], "frame_index": kept, "visibility": seen}
    np.savez(tmp_path / "gaps.npz", **arrays)
    observed = read_measurement(tmp_path / "gaps.npz").observed
    assert not observed[:, 0].any() and observed[kept, 1:].all() and not observed[3].any()


def test_z_up_is_turned_with_its_body():
    from caphy.io.measurements.archive import from_arrays

    given = dressed()
    up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    motion = procedural_motion(3, 1.0, 30.0).to_y_up()[: len(given)].to_z_up(default_body().joints[0])
    arrays = to_arrays(given) | {"up_axis": "z", "vertices": given.vertices @ up.T}
    back, stated = from_arrays(arrays | {"poses": motion.poses, "transl": motion.transl}, "vest", "vest.npz")
    assert stated
    np.testing.assert_allclose(back.vertices, given.vertices, atol=1e-12)
    np.testing.assert_allclose(back.transl, given.transl, atol=1e-9)
    require_plausible(back)


def _broken(**changes) -> Measurement:
    return replace(swinging(), **changes)


def _shuffled() -> Measurement:
    order = np.random.default_rng(1).permutation(20)
    given = swinging()
    return replace(given, vertices=given.vertices[order], pinned_positions=given.pinned_positions[order])


def _exchanged() -> Measurement:
    order = np.arange(20)
    order[[14, 15]] = [15, 14]
    return replace(swinging(), vertices=swinging().vertices[order])


def _relabelled() -> Measurement:
    order = np.random.default_rng(2).permutation(36)
    return replace(swinging(), vertices=swinging().vertices[:, order], pinned=None, pinned_positions=None)


def _flat() -> np.ndarray:
    return swinging().rest_vertices[swinging().faces][..., :2]


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: _broken(vertices=1000 * swinging().vertices), r"are these millimetres \(multiply by 0.001\)\?"),
        (
            lambda: _broken(rest_vertices=100 * swinging().rest_vertices),
            "rest_vertices look like centimetres beside frames in metres: multiply them by 0.01",
        ),
        (lambda: _broken(fps=1 / 30), "give 30"),
        (_shuffled, "look shuffled"),
        (_exchanged, "frames 14 and 15 look exchanged"),
        (_relabelled, "not in the same vertex order"),
        (lambda: _broken(pinned=np.array([0, 35])), "pinned vertices were measured"),
        (lambda: _broken(fps=3000.0), "frames per second"),
        (lambda: _broken(material=1000 * _flat()), "times as long in material as in rest_vertices"),
        (lambda: _broken(material=_flat()[::-1].copy()[:, ::-1] * np.linspace(0.2, 2, 50)[:, None, None]), "material"),
        (
            lambda: _broken(vertices=np.repeat(swinging().vertices[::2], 2, 0), noise_mm=1.0),
            "frames 0 and 1 are the same",
        ),
        (lambda: _broken(vertices=np.repeat(swinging().vertices[::2], 2, 0)), "moves before and after"),
    ],
)
def test_wrong_units_order_and_mesh_are_told(make, says):
    require_plausible(swinging())
    with pytest.raises(CaphyError, match=says):
        require_plausible(make())


def test_cloth_that_rests_before_it_moves_may_stand_still():
    """Without noise, as simulated: ten frames at rest, then the swing."""
    given = swinging()
    assert given.vertices is not None
    still = np.concatenate([np.repeat(given.vertices[:1], 10, 0), given.vertices[:-10]])
    require_plausible(replace(given, vertices=still, pinned_positions=None, pinned=None))


def test_wrong_axes_are_told():
    given = dressed()
    require_plausible(given)
    up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    with pytest.raises(CaphyError, match="the cloth has z up and the poses y up"):
        require_plausible(replace(given, vertices=given.vertices @ up.T))
    sheet = swinging()
    turned = replace(sheet, vertices=sheet.vertices @ up.T, pinned_positions=sheet.pinned_positions @ up.T)
    require_plausible(turned, axes_stated=True)
    with pytest.raises(CaphyError, match="z seems to be up; state up_axis = 'z'"):
        require_plausible(turned, axes_stated=False)


def test_cloth_of_another_place_is_told():
    given = dressed()
    with pytest.raises(CaphyError, match="m from the joints of its body"):
        require_plausible(replace(given, transl=given.transl + np.array([3.0, 0, 0])))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"vertices": None}, "either registered 'vertices'"),
        ({"pinned_positions": None}, "pinned needs pinned_positions"),
        ({"faces": None}, "need 'faces'"),
        ({"pinned_positions": np.zeros((40, 2, 3))}, r"60 fps\?\), resample"),
        ({"faces": swinging().faces + 1}, "counted from 1"),
        ({"rest_vertices": grid(5)[0]}, "same topology"),
        ({"vertices": np.full((20, 36, 3), np.nan)}, "no frame shows anything"),
        ({"vertices": np.zeros((0, 36, 3)), "pinned_positions": np.zeros((0, 2, 3))}, "holds no frames"),
        ({"fps": np.nan}, "fps must be positive"),
        ({"noise": np.ones(7)}, "noise must have shape"),
        ({"noise": np.full(36, 1e-3), "noise_mm": 1.0}, "either 'noise', of each point"),
        ({"pinned": np.array([0, 0])}, "once"),
        ({"pinned": np.arange(36) < 2}, "pinned must be indices, got a mask; give numpy.flatnonzero of it"),
        ({"poses": np.zeros((20, 55, 3))}, "poses needs transl"),
    ],
)
def test_keys_that_do_not_fit_are_told(changes, says):
    with pytest.raises(CaphyError, match=says) as caught:
        _broken(**changes)
    assert "sheet.npz" in str(caught.value)


def test_pickles_and_unknown_keys_are_refused(tmp_path):
    np.savez(tmp_path / "p.npz", fps=30.0, vertices=np.array([{}], dtype=object))
    with pytest.raises(CaphyError, match="plain arrays"):
        read_measurement(tmp_path / "p.npz")
    np.savez(tmp_path / "u.npz", fps=30.0, vertex=np.zeros((2, 3, 3)))
    with pytest.raises(CaphyError, match="keys nobody reads: vertex"):
        read_measurement(tmp_path / "u.npz")
    with pytest.raises(CaphyError, match="no such measurement"):
        read_measurement(tmp_path / "none.npz")
    with pytest.raises(CaphyError, match=r"needs a measurement\.toml"):
        read_measurement(tmp_path)


def test_periodic_still_and_noisy_motion_is_in_order():
    """What a check for shuffled frames might wrongly refuse."""
    given = swinging()
    random = np.random.default_rng(0)
    still = np.repeat(given.vertices[:1], 20, axis=0) + random.normal(0, 0.003, given.vertices.shape)
    fast = given.vertices.copy()
    angle = 1.2 * np.sin(2 * np.pi * 3.0 * np.arange(20) / 30)  # three swings a second, ten frames each
    fast[..., 1], fast[..., 2] = _turned(given.rest_vertices, angle)
    for vertices in (still, fast + random.normal(0, 0.002, fast.shape)):
        require_plausible(replace(given, vertices=vertices, pinned=None, pinned_positions=None))


def test_a_folder_takes_another_s_place_whole(tmp_path, monkeypatch):
    """Where the new one cannot be put there, the old one stands as it did."""
    write_measurement(dressed(8), tmp_path / "vest")
    replaced, before = os.replace, sorted(path.name for path in (tmp_path / "vest").iterdir())

    def fails(one, other):
        if Path(other) == tmp_path / "vest" and ".old" not in str(one):
            raise OSError("no")
        replaced(one, other)

    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(CaphyError, match=r"cannot be written \(no\)"):
        write_measurement(dressed(6), tmp_path / "vest")
    assert sorted(path.name for path in (tmp_path / "vest").iterdir()) == before
    assert len(read_measurement(tmp_path / "vest")) == 8
    monkeypatch.undo()
    write_measurement(dressed(6), tmp_path / "vest")
    assert len(read_measurement(tmp_path / "vest")) == 6 and [path.name for path in tmp_path.iterdir()] == ["vest"]
