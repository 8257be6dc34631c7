"""What was not seen, is in another order, or is of another kind is told, and not compared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from test_measurements import grid, swinging

from caphy.errors import CaphyError
from caphy.io.measurements import Measurement, read_measurement, write_measurement
from caphy.io.measurements.archive import to_arrays
from caphy.io.measurements.checks import require_plausible

MIDDLE = 21
"""A vertex of the sheet that nothing holds."""


def _with(place, value: object) -> Measurement:
    vertices = swinging().vertices.copy()
    vertices[place] = value
    return replace(swinging(), vertices=vertices)


def _permuted(frame: int) -> Measurement:
    order = np.random.default_rng(0).permutation(36)
    return _with(frame, swinging().vertices[frame][order])


def _quads(side: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Right triangles whose first corner is not always the right angle's, and their flat rest shapes."""
    rest, faces = grid(side)
    return faces, rest[faces][..., :2]


def _clouds(frames: int = 20, copies: int = 1, seed: int | None = None) -> Measurement:
    sheet, random = swinging(frames), np.random.default_rng(1)
    order = np.arange(frames) if seed is None else np.random.default_rng(seed).permutation(frames)
    seen = np.repeat(sheet.vertices, 2, axis=1)
    clouds = [seen[f] + random.normal(0, 1e-3, (72, 3)) for f in order for _ in range(copies)]
    clouds = [cloud if copy % copies == 0 else clouds[copy - 1] for copy, cloud in enumerate(clouds)]
    points, offsets = np.concatenate(clouds), 72 * np.arange(len(clouds) + 1)
    return Measurement("c", 30.0, points=points, offsets=offsets, faces=sheet.faces, rest_vertices=sheet.rest_vertices)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: _with((slice(None), MIDDLE), 0.0), r"vertex 21 lies at \(0, 0, 0\) in frame 0.*20 such places"),
        (lambda: _with((5, slice(10, None)), 0.0), "in frame 5, away from its neighbours"),
        (lambda: _permuted(7), "in frame 7 some edges are"),
        (lambda: replace(swinging(), noise_mm=500.0), "noise_mm must be in millimetres, got 500"),
        (lambda: _with((5, 3), np.inf), "NaN where they were not seen, got infinity in frame 5, vertex 3"),
        (lambda: replace(swinging(), fps=1 / 30), r"2 or more, got 0.0333333; if that is .* give 30"),
        (lambda: replace(swinging(), fps=1.5), "2 or more, got 1.5$"),
        (lambda: replace(swinging(), material=_quads()[1][np.random.default_rng(0).permutation(50)][:, ::-1]), "% of"),
        (lambda: _clouds(seed=3), "clouds move .* times as far to the next frame"),
        (lambda: _clouds(copies=2), "frames 2 and 3 are the same to the last digit"),
        (lambda: replace(_clouds(copies=2), noise_mm=1.0), r"frames 0 and 1 are the same .* \(20 such pairs\)"),
    ],
    ids=[
        "a zero",
        "zeros in a frame",
        "a frame's order",
        "noise",
        "infinity",
        "seconds a frame",
        "too few frames a second",
        "material's order",
        "clouds' order",
        "repeats",
        "noisy repeats",
    ],
)
def test_what_cannot_be_compared_is_told(make, says):
    require_plausible(swinging())
    require_plausible(_clouds())
    with pytest.raises(CaphyError, match=says):
        require_plausible(make())


def test_clouds_may_stand_still_before_they_move():
    given = _clouds(copies=1)
    points = np.concatenate([np.tile(given.points[:72], (5, 1)), given.points])
    require_plausible(replace(given, points=points, offsets=72 * np.arange(26)))


def test_few_points_tell_nothing_of_the_order():
    """Five of a sheet's places lie elsewhere in each frame; that they are too few is told where they are registered."""
    random, sheet = np.random.default_rng(0), swinging()
    points = np.concatenate([cloth[random.permutation(36)[:5]] for cloth in sheet.vertices])
    require_plausible(replace(_clouds(), points=points, offsets=5 * np.arange(21)))


def test_points_at_the_origin_were_not_seen():
    clouds = _clouds()
    points = clouds.points.copy()
    points[80:85] = 0
    with pytest.raises(CaphyError, match=r"frame 1 has 5 points at \(0, 0, 0\)"):
        require_plausible(replace(clouds, points=points))


def test_cloth_may_lie_at_the_origin():
    """One vertex of a sheet that is simulated without noise is there, among its neighbours."""
    rest, faces = grid(7)
    moved = rest - rest[24] + 0.01 * np.arange(12)[:, None, None]
    require_plausible(Measurement("s", 30.0, vertices=moved, faces=faces, rest_vertices=rest))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"pinned": np.zeros(0, int), "pinned_positions": np.zeros((20, 0, 3))}, "and not all, got 0"),
        ({"pinned": np.arange(36), "pinned_positions": swinging().vertices}, "and not all, got 36"),
        ({"visibility": np.full((20, 36), 0.3)}, "visibility must be true or false"),
        ({"visibility": np.full((20, 36), np.nan)}, "visibility must be true or false"),
    ],
)
def test_keys_that_mean_nothing_are_told(changes, says):
    with pytest.raises(CaphyError, match=says):
        replace(swinging(), **changes)


def _folder(folder: Path, files: range, lines: str = "", pins: bool = True) -> Path:
    """The sheet's frames as PLYs numbered as asked."""
    sheet = swinging()
    folder.mkdir()
    trimesh.Trimesh(sheet.rest_vertices, sheet.faces, process=False).export(folder / "rest.ply")
    for frame, number in enumerate(files):
        trimesh.Trimesh(sheet.vertices[frame], sheet.faces, process=False).export(folder / f"f_{number:04d}.PLY")
    if pins:
        np.savez(folder / "arrays.npz", pinned=sheet.pinned, pinned_positions=sheet.pinned_positions)
        lines += '\narrays = "arrays.npz"'
    (folder / "measurement.toml").write_text("\ufefffps = 30\n" + lines, encoding="utf-8")
    return folder


def test_a_numbered_rest_mesh_is_no_frame(tmp_path):
    folder = _folder(tmp_path / "m", range(20))
    (folder / "rest.ply").rename(folder / "rest_34.ply")
    with (folder / "measurement.toml").open("a") as file:
        file.write('\nrest = "./rest_34.ply"\n')
    read = read_measurement(folder)
    assert len(read) == 20 and read.rest_vertices is not None


def test_arrays_of_a_folder_that_tell_the_frames_again_are_refused(tmp_path):
    folder = _folder(tmp_path / "m", range(3))
    with np.load(folder / "arrays.npz") as known:
        arrays = dict(known)
    for key in ("vertices", "frame_index", "rest_vertices"):
        np.savez(folder / "arrays.npz", **arrays, **{key: np.zeros((3, 4, 3))})
        with pytest.raises(CaphyError, match=rf"arrays.npz: has {key}, which other files of the folder tell"):
            read_measurement(folder)


def test_which_frame_is_the_first_is_asked_where_numbers_do_not_say(tmp_path):
    assert len(read_measurement(_folder(tmp_path / "all", range(3, 23)))) == 20
    with pytest.raises(CaphyError, match=r"numbered from 3 to 19, and pinned_positions has 20 frames.*first_frame = 3"):
        read_measurement(_folder(tmp_path / "late", range(3, 20)))
    read = read_measurement(_folder(tmp_path / "early", range(3, 20), "first_frame = 3"))
    assert read.seen_frames.tolist() == list(range(17))
    assert (read.number(0), read.number(2)) == (3, 5)
    read = read_measurement(_folder(tmp_path / "unseen", range(3, 20), "first_frame = 0"))
    assert read.seen_frames.tolist() == list(range(3, 20))
    with pytest.raises(CaphyError, match="at most 3"):
        read_measurement(_folder(tmp_path / "after", range(3, 20), "first_frame = 4"))


def test_frames_of_another_mesh_are_told(tmp_path):
    folder = _folder(tmp_path / "m", range(20))
    order = np.random.default_rng(0).permutation(36)
    place = np.argsort(order)
    sheet = swinging()
    turned = trimesh.Trimesh(sheet.vertices[4][order], place[sheet.faces], process=False)
    turned.export(folder / "f_0004.PLY")
    with pytest.raises(CaphyError, match=r"f_0004\.PLY: its triangles are not those of the rest mesh"):
        read_measurement(folder)
    other = sheet.faces.copy()  # the same quads, cut along the other diagonal
    other[:25], other[25:] = sheet.faces[:25, [0, 1, 2]], sheet.faces[25:]
    a, c, b = sheet.faces[:25].T
    _, d, _ = sheet.faces[25:].T
    other = np.concatenate([np.stack([a, d, b], -1), np.stack([d, c, b], -1)])
    trimesh.Trimesh(sheet.vertices[4], other, process=False).export(folder / "f_0004.PLY")
    assert len(read_measurement(folder)) == 20


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("frame_count = 'x'", "frame_count must be a whole number"),
        ("frame_count = 14.9", "frame_count must be a whole number"),
        ("frames = 3", "frames must be text"),
        ("frames = '/tmp/*.ply'", "a pattern of names within the folder"),
        ("rest = false", "rest must be text"),
        ("arrays = 3", "arrays must be text"),
        ("poses = 3", "poses must be text"),
        ("registered = 'false'", "registered must be true or false"),
        ("name = ''", "name must be text"),
        ("noise_mm = true", "noise_mm must be a number"),
    ],
)
def test_descriptions_of_the_wrong_kind_are_told(tmp_path, line, says):
    with pytest.raises(CaphyError, match=says):
        read_measurement(_folder(tmp_path / "m", range(20), line, pins=False))


def test_keys_that_nobody_reads_in_a_folder_s_arrays_are_told(tmp_path):
    folder = _folder(tmp_path / "m", range(20))
    np.savez(folder / "arrays.npz", visiblity=np.ones((20, 36)), noise_mm=1.0)
    with pytest.raises(CaphyError, match=r"nobody reads here: noise_mm, visiblity.*belong in measurement\.toml"):
        read_measurement(folder)


def test_times_for_frame_numbers_are_told(tmp_path):
    with pytest.raises(CaphyError, match="20 frames were captured of 19001; are frame_index"):
        read_measurement(_folder(tmp_path / "m", range(0, 20_000, 1000), pins=False))
    arrays = to_arrays(swinging())
    np.savez(tmp_path / "many.npz", **arrays, frame_count=10**12)
    with pytest.raises(CaphyError, match="20 frames were captured of 1000000000000"):
        read_measurement(tmp_path / "many.npz")
    np.savez(tmp_path / "text.npz", **arrays, frame_count="x")
    with pytest.raises(CaphyError, match="frame_count must be one number"):
        read_measurement(tmp_path / "text.npz")
    for fps, got in ((True, "True"), (np.full(20, 30.0), r"an array of shape \(20,\)"), ("60 Hz", "60 Hz")):
        np.savez(tmp_path / "fps.npz", **(arrays | {"fps": fps}))
        with pytest.raises(CaphyError, match=f"fps must be one number, got .*{got}"):
            read_measurement(tmp_path / "fps.npz")


def test_a_frame_count_alone_counts(tmp_path):
    arrays = {name: value for name, value in to_arrays(swinging()).items() if "pinned" not in name}
    np.savez(tmp_path / "m.npz", **arrays, frame_count=25)
    read = read_measurement(tmp_path / "m.npz")
    assert len(read) == 25
    assert read.seen_frames.tolist() == list(range(20))
    np.savez(tmp_path / "few.npz", **arrays, frame_count=10)
    with pytest.raises(CaphyError, match="reaches 19, but there are 10 frames"):
        read_measurement(tmp_path / "few.npz")
    write_measurement(read, tmp_path / "again.npz")
    assert len(read_measurement(tmp_path / "again.npz")) == 25


def test_what_tells_of_poses_that_are_not_there_is_said_to_be_ignored(tmp_path: Path) -> None:
    given = replace(swinging(), betas=np.zeros(10), attached=np.zeros(36))
    notes = read_measurement(write_measurement(given, tmp_path / "sheet.npz")).notes
    assert notes == ("betas, attached tell of a body in poses; there are no poses, so they are ignored",)
    assert read_measurement(write_measurement(swinging(), tmp_path / "plain.npz")).notes == ()
