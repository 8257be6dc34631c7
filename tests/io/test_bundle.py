"""Bundles survive the disk, and damaged ones are refused in words."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from caphy.conventions import JOINT_PARENTS
from caphy.errors import CaphyError
from caphy.io.bundle import ARRAYS, MANIFEST, AvatarBundle, BundledGarment, SkinnedMesh, read_bundle, write_bundle


def square() -> SkinnedMesh:
    weights = np.zeros((4, 55))
    weights[:, [3, 9, 16, 54]] = [[1, 0, 0, 0], [0.5, 0.5, 0, 0], [0.1, 0.2, 0.3, 0.4], [0, 0, 0, 1]]
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    return SkinnedMesh.from_dense(vertices, np.array([[0, 1, 2], [0, 2, 3]]), weights, np.array(["a", "b", "b", "a"]))


@pytest.fixture
def bundle() -> AvatarBundle:
    return AvatarBundle(
        name="test",
        fps=30.0,
        joints=np.random.default_rng(0).normal(size=(55, 3)),
        parents=np.array(JOINT_PARENTS, np.int32),
        body=square(),
        garments=(BundledGarment("tshirt", square(), b"graph", 16), BundledGarment("skirt", square(), b"other", 20)),
        licence="CC0",
        provenance={"seeds": [1, 2]},
        metrics={"tshirt": {"error": 0.1}},
    )


@pytest.fixture
def folder(bundle, tmp_path) -> Path:
    write_bundle(bundle, tmp_path / "avatar")
    return tmp_path / "avatar"


def edit(folder: Path, change) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    change(manifest)
    (folder / MANIFEST).write_text(json.dumps(manifest))


def test_round_trip(bundle, folder):
    found = read_bundle(folder)
    for name in ("name", "fps", "licence", "provenance", "metrics"):
        assert getattr(found, name) == getattr(bundle, name)
    np.testing.assert_array_equal(found.joints, bundle.joints)
    np.testing.assert_array_equal(found.parents, bundle.parents)
    for mine, theirs in zip(
        (bundle.body, *(g.mesh for g in bundle.garments)), (found.body, *(g.mesh for g in found.garments)), strict=True
    ):
        for name in ("vertices", "faces", "joint_index", "joint_weight", "region"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
        assert mine.region_names == theirs.region_names == ("a", "b")
    assert [(g.name, g.onnx, g.state_size) for g in found.garments] == [
        ("tshirt", b"graph", 16),
        ("skirt", b"other", 20),
    ]


def test_manifest_says_what_there_is(folder):
    manifest = json.loads((folder / MANIFEST).read_text())
    assert manifest["units"]["length"] == "m"
    assert len(manifest["joints"]) == 55
    for name, entry in manifest["files"].items():
        content = (folder / name).read_bytes()
        assert entry == {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    assert set(manifest["files"]) | {MANIFEST} == {path.name for path in folder.iterdir()}


def test_weights_survive_the_sparse_form():
    mesh = square()
    dense = mesh.dense_weights()
    np.testing.assert_allclose(dense[2, [3, 9, 16, 54]], [0.1, 0.2, 0.3, 0.4], atol=1e-7)
    np.testing.assert_allclose(dense.sum(axis=1), 1, atol=1e-6)
    assert np.count_nonzero(dense) == 8


def test_five_influences_are_refused():
    weights = np.zeros((3, 55))
    weights[:, 0] = 1
    weights[1, :5] = 0.2
    with pytest.raises(CaphyError, match="vertex 1 hangs on 5"):
        SkinnedMesh.from_dense(np.zeros((3, 3)), np.array([[0, 1, 2]]), weights)


def test_writing_again_replaces_the_whole_bundle(bundle, folder):
    write_bundle(replace(bundle, name="second", garments=bundle.garments[:1]), folder)
    assert read_bundle(folder).name == "second"
    assert not (folder / "skirt.onnx").exists()
    assert [path.name for path in folder.parent.iterdir()] == ["avatar"]


def test_a_failed_write_leaves_the_old_bundle(bundle, folder, monkeypatch):
    monkeypatch.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(CaphyError, match=r"cannot be written \(disk full\); free space"):
        write_bundle(replace(bundle, name="second"), folder)
    monkeypatch.undo()
    assert read_bundle(folder).name == "test"
    assert [path.name for path in folder.parent.iterdir()] == ["avatar"]


def test_never_writes_over_something_else(bundle, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_text("meow")
    with pytest.raises(CaphyError, match="no avatar bundle"):
        write_bundle(bundle, tmp_path / "photos")
    assert (tmp_path / "photos" / "cat.jpg").exists()


def test_a_link_stays_a_link_and_the_current_folder_is_refused(bundle, folder, tmp_path, monkeypatch):
    (tmp_path / "latest").symlink_to(folder)
    write_bundle(replace(bundle, name="second"), tmp_path / "latest")
    assert (tmp_path / "latest").is_symlink() and read_bundle(folder).name == "second"
    assert {path.name for path in tmp_path.iterdir()} == {folder.name, "latest"}
    monkeypatch.chdir(folder)
    with pytest.raises(CaphyError, match="is or holds the current folder"):
        write_bundle(bundle, ".")
    assert read_bundle(folder).name == "second"


@pytest.mark.parametrize("name", ["tshirt.onnx", ARRAYS])
def test_damaged_and_missing_files(folder, name):
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[:-1] + b"?")
    with pytest.raises(CaphyError, match=f"{name}.*damaged"):
        read_bundle(folder)
    (folder / name).unlink()
    with pytest.raises(CaphyError, match=f"{name}.*cannot be read"):
        read_bundle(folder)


def test_no_bundle_and_no_json(folder, tmp_path):
    with pytest.raises(CaphyError, match="is no avatar bundle"):
        read_bundle(tmp_path / "nowhere")
    (folder / MANIFEST).write_text("{")
    with pytest.raises(CaphyError, match="is not JSON"):
        read_bundle(folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(schema="caphy-avatar-9"), "must be of schema"),
        (lambda m: m["joints"].reverse(), "SMPL-X joints in their order"),
        (lambda m: m.update(fps=-1), "fps must lie between 1 and 1000, got -1"),
        (lambda m: m.update(fps=1e9), "fps must lie between 1 and 1000"),
        (lambda m: m["units"].update(length="mm"), "units must be"),
        (lambda m: m["axes"].update(up="z"), "axes must be"),
        (lambda m: m.update(metrics=5), "metrics must be a dict, got 5"),
        (lambda m: m.update(name=None), "name must be a str"),
        (lambda m: m.update(fps="fast"), "does not follow schema"),
        (lambda m: m.pop("garments"), "does not follow schema"),
        (lambda m: m.update(garments=[]), "must have garments"),
        (lambda m: m["garments"][0].update(name="../x"), "does not follow schema|lower-case"),
        (lambda m: m["garments"][0].update(state_size=-3), "state size"),
        (lambda m: m["garments"][0].update(model="gone.onnx"), "does not follow schema"),
        (lambda m: m["parents"].__setitem__(3, 40), "parents must name"),
        (lambda m: m["files"].__setitem__("../../etc/passwd", {"sha256": "x"}), "must lie in the bundle"),
        (lambda m: m.update(files=[]), "does not follow schema"),
        (lambda m: m["body"].update(regions=["only"]), "region index"),
    ],
)
def test_wrong_manifests(folder, change, words):
    edit(folder, change)
    with pytest.raises(CaphyError, match=words):
        read_bundle(folder)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("faces", np.array([[0, 1, 4]], np.int32), "index its 4 vertices"),
        ("faces", np.zeros((0, 3), np.int32), "empty"),
        ("vertices", np.full((4, 3), np.nan, np.float32), "finite"),
        ("joint_weight", np.full((4, 4), 0.5, np.float32), "sum to one"),
        ("joint_index", np.full((4, 4), 55, np.uint8), "out of range"),
        ("region", np.zeros(3, np.uint8), "shape"),
    ],
)
def test_wrong_meshes_are_not_written(bundle, tmp_path, field, value, words):
    with pytest.raises(CaphyError, match=words):
        write_bundle(replace(bundle, body=replace(bundle.body, **{field: value})), tmp_path / "avatar")
    assert not (tmp_path / "avatar").exists()


def test_pickles_are_never_read(folder):
    with (folder / ARRAYS).open("wb") as stream:
        np.savez(stream, joints=np.array([{"evil": 1}], dtype=object))
    digest = hashlib.sha256((folder / ARRAYS).read_bytes()).hexdigest()
    edit(folder, lambda m: m["files"][ARRAYS].update(sha256=digest))
    with pytest.raises(CaphyError, match="plain arrays"):
        read_bundle(folder)


def test_what_lies_beside_a_bundle_is_not_removed_with_it(bundle, folder, monkeypatch):
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(CaphyError, match=r"holds notes\.txt beside an avatar bundle, and is replaced whole; move that"):
        write_bundle(bundle, folder)
    assert (folder / "notes.txt").read_text() == "mine"
    (folder / "notes.txt").unlink()
    (folder / "inner").mkdir()
    monkeypatch.chdir(folder / "inner")
    with pytest.raises(CaphyError, match="holds the current folder"):
        write_bundle(bundle, "..")
