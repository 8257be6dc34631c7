"""Saving, loading, and what a damaged garment file is told."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.garment.topology import hinges


@pytest.fixture
def garment(strip):
    vertices, faces = strip
    weights = np.zeros((len(vertices), 55))
    weights[:, [0, 3]] = 0.5
    return Garment(
        name="strip",
        vertices=vertices,
        faces=faces.astype(np.int32),
        material=vertices[faces][..., :2],
        weights=weights,
        regions=np.where(vertices[:, 1] > 0, "upper", "lower"),
        layer_thickness=np.full(len(vertices), 0.002),
        attached=(vertices[:, 1] > 0.39).astype(float),
        provenance={"family": "none"},
    )


def test_a_file_brings_back_every_field(garment, tmp_path):
    garment.save(tmp_path / "a" / "strip.npz")
    again = Garment.load(tmp_path / "a" / "strip.npz")
    for field in dataclasses.fields(Garment):
        want, got = getattr(garment, field.name), getattr(again, field.name)
        if isinstance(want, np.ndarray) and want.dtype.kind == "f":
            np.testing.assert_allclose(got, want, atol=1e-7)
            assert got.dtype == np.float64
        else:
            assert np.array_equal(got, want) if isinstance(want, np.ndarray) else got == want
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["strip.npz"]  # no temporary file stays behind


def test_the_body_that_it_was_made_on_is_kept_with_it(garment, tmp_path):
    joints = np.random.default_rng(0).normal(size=(55, 3))
    assert garment.apart(joints) == 0.0  # nobody knows
    dataclasses.replace(garment, joints=joints).save(tmp_path / "strip.npz")
    again = Garment.load(tmp_path / "strip.npz")
    assert again.apart(joints) < 1e-6 and again.apart(joints + np.array([0, 0.3, 0.4])) == pytest.approx(0.5)
    with pytest.raises(CaphyError, match=r"joints must have shape \(55, 3\), got \(24, 3\)"):
        dataclasses.replace(garment, joints=joints[:24])


def test_files_that_are_no_cloth_are_refused(garment, tmp_path):
    """Written by other programs: they ended in tracebacks, or lay where no body carries them."""
    turned = garment.faces.copy()
    turned[5] = turned[5][::-1]
    third_side = hinges(garment.faces)[0, [1, 0]]
    third = np.concatenate([garment.faces, [[*third_side, 0]]]).astype(np.int32)
    material = np.concatenate([garment.material, garment.material[:1]])
    kept = (garment.faces != 0).all(axis=1)
    many = np.array([f"r{i}" for i in range(len(garment.vertices))])
    for changed, says in (
        ({"faces": turned}, "wound in opposite senses"),
        ({"faces": third, "material": material}, "more than two faces"),
        ({"faces": garment.faces[kept], "material": garment.material[kept]}, "vertices in no face"),
        ({"weights": 0.5 * garment.weights}, "weights must sum to 1 for each vertex, got 0.5 for vertex"),
        ({"regions": np.arange(len(garment.vertices))}, "regions must be up to 256 names"),
    ):
        dataclasses.replace(garment, **changed).save(tmp_path / "other.npz")
        with pytest.raises(CaphyError, match=rf"other\.npz: .*{says}.*make it again"):
            Garment.load(tmp_path / "other.npz")
    dataclasses.replace(garment, regions=many).save(tmp_path / "other.npz")
    Garment.load(tmp_path / "other.npz")


def test_masses_and_regions(garment):
    assert garment.masses(0.2).sum() == pytest.approx(0.2 * 0.4 * 0.8)
    assert len(garment.region("upper")) + len(garment.region("lower")) == len(garment.vertices)
    assert len(garment.boundary_loops) == 1 and len(garment.hinges) == 3 * 64 // 2 - 24 // 2


def test_a_failed_write_leaves_the_old_file(garment, tmp_path, monkeypatch):
    garment.save(tmp_path / "strip.npz")
    before = (tmp_path / "strip.npz").read_bytes()

    def fail(*_args, **_kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(CaphyError, match=r"cannot be written \(disk full\); free space"):
        garment.save(tmp_path / "strip.npz")
    assert (tmp_path / "strip.npz").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_pickles_are_refused(tmp_path):
    np.savez(tmp_path / "evil.npz", vertices=np.array([{"a": 1}], dtype=object))
    with pytest.raises(CaphyError, match="npz of plain arrays"):
        Garment.load(tmp_path / "evil.npz")


def test_other_files_are_named_for_what_they_lack(tmp_path):
    np.savez(tmp_path / "other.npz", vertices=np.zeros((3, 3)))
    with pytest.raises(CaphyError, match=r"garment npz of format .*without .*'faces'"):
        Garment.load(tmp_path / "other.npz")
    with pytest.raises(CaphyError, match="no such file"):
        Garment.load(tmp_path / "missing.npz")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("weights", np.zeros((45, 24)), r"weights must have shape \(45, 55\), got \(45, 24\)"),
        ("vertices", np.full((45, 3), np.nan), "vertices must be finite"),
        ("faces", np.full((64, 3), 45, np.int32), "faces must index its 45 vertices"),
    ],
)
def test_fields_that_do_not_fit_are_refused(garment, field, value, message):
    with pytest.raises(CaphyError, match=message):
        dataclasses.replace(garment, **{field: value})
