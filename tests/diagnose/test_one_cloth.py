"""All that a diagnosis is given must be of one cloth, and nothing may prove itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.diagnose.checks import check_cloth, require_one_cloth
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement
from caphy.measure.scene import Scene


def sheet(frames: int = 9, seed: int = 0) -> Measurement:
    flat, faces = square(5)
    moved = flat + 0.05 * np.random.default_rng(seed).normal(size=(frames, 1, 3))
    return Measurement(f"sheet {seed}", 30.0, vertices=moved, faces=faces, rest_vertices=flat)


def square(count: int) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.linspace(0, 0.4, count), np.linspace(0, 0.4, count))
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + count + 1, corner + count
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], -1), faces


def test_one_cloth_in_three_parts():
    require_one_cloth(diagnosed=[sheet(seed=1)], base=[sheet(seed=2)], held_out=[sheet(seed=3)])
    shrunk = sheet(seed=2)
    require_one_cloth(diagnosed=[sheet(seed=1)], base=[replace(shrunk, rest_vertices=0.97 * shrunk.rest_vertices)])


def test_other_cloth_is_told():
    other = sheet(seed=2)
    with pytest.raises(CaphyError, match=r"sheet 2: must be of the cloth of sheet 1, but its edges at rest are 0\.7"):
        require_one_cloth(diagnosed=[sheet(seed=1)], base=[replace(other, rest_vertices=0.7 * other.rest_vertices)])
    with pytest.raises(CaphyError, match="has other faces"):
        require_one_cloth(diagnosed=[sheet(seed=1)], base=[replace(other, faces=other.faces[::-1])])


def test_nothing_counts_twice():
    with pytest.raises(CaphyError, match="sheet 1: holds the same frames as sheet 1; one motion given twice"):
        require_one_cloth(diagnosed=[sheet(seed=1), sheet(seed=2), sheet(seed=1)])


def test_nothing_proves_itself():
    with pytest.raises(CaphyError, match="frames as sheet 1, one as the held-out and one as the diagnosed"):
        require_one_cloth(diagnosed=[sheet(seed=1)], base=[], held_out=[sheet(seed=1)])


def test_a_part_of_a_motion_is_no_other_motion():
    whole, other = sheet(40, seed=1), sheet(40, seed=2)
    part = replace(whole, vertices=whole.vertices[20:])
    with pytest.raises(CaphyError, match="holds 20 of the frames of sheet 1, one as the held-out"):
        require_one_cloth(diagnosed=[whole], held_out=[part])
    with pytest.raises(CaphyError, match="one motion given twice"):
        require_one_cloth(diagnosed=[part, whole])
    began_alike = replace(other, vertices=np.concatenate([whole.vertices[:5], other.vertices]))
    require_one_cloth(diagnosed=[whole], held_out=[began_alike])


@pytest.mark.parametrize("faces", [[[0, 1, 1]], [[0, 1, 6]], [[0, 6, 1]]])
def test_meshes_that_are_no_cloth_are_told_with_their_file(faces):
    given = sheet()
    broken = replace(given, faces=np.concatenate([given.faces, faces]), source="bad.npz")
    with pytest.raises(CaphyError, match=r"bad\.npz: faces must be an oriented manifold"):
        Scene.of(broken)


def carried(along: np.ndarray) -> Measurement:
    """The sheet in frames (T,) at places along x [m], held by one corner."""
    moved = square(5)[0] + along[:, None, None] * [1.0, 0, 0]
    return replace(sheet(), vertices=moved, pinned=[0], pinned_positions=moved[:, :1])


def test_what_visibility_hides_is_looked_at_by_none():
    one = carried(np.linspace(0, 2, 40))
    hidden = np.random.default_rng(0).random(one.vertices.shape[:2]) < 0.15
    for written in (np.nan, 0.0, -9999.0):
        filled = np.where(hidden[..., None], written, one.vertices)
        check_cloth(Scene.of(replace(one, vertices=filled, visibility=~hidden)))


def test_the_order_of_frames_is_that_of_what_was_seen():
    steady = np.linspace(0, 2, 40)
    shuffled = carried(np.random.default_rng(0).permutation(steady))
    with pytest.raises(CaphyError, match="put the frames in order of time"):
        check_cloth(Scene.of(shuffled))
    seen = np.tile(np.arange(25) < 10, (40, 1))  # a minority; the rest is written in order
    half = np.where(seen[..., None], shuffled.vertices, carried(steady).vertices)
    with pytest.raises(CaphyError, match="put the frames in order of time"):
        check_cloth(Scene.of(replace(shuffled, vertices=half, visibility=seen)))
