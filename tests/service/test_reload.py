"""New avatar versions while the service runs; broken bundles, which change nothing."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import struct
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from test_app import BINARY, FRAMES, body_of

from caphy.errors import CaphyError
from caphy.io import bundle as bundles
from caphy.io.bundle import AvatarBundle, write_bundle
from service.app import create_app
from service.avatars import load_avatar
from service.library import Library
from service.metrics import Metrics
from service.protocol import decode_response
from service.settings import Settings


@pytest.fixture
def folder(avatars, tmp_path) -> Path:
    shutil.copytree(avatars / "shell", tmp_path / "shell")
    return tmp_path


@pytest.fixture
def library(folder) -> Library:
    loaded = Library(folder, 8, Metrics())
    loaded.load()
    return loaded


def taller(bundle: AvatarBundle) -> AvatarBundle:
    """The avatar with its garments exchanged: other vertices, the same names."""
    first, second = bundle.garments
    garments = (replace(second, name=first.name), replace(first, name=second.name))
    return replace(bundle, garments=garments)


def rewrite(folder: Path, name: str, content: bytes) -> None:
    """Exchange a file of a bundle and its hash: damage that no checksum shows."""
    (folder / name).write_bytes(content)
    manifest = json.loads((folder / "avatar.json").read_bytes())
    manifest["files"][name] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    (folder / "avatar.json").write_text(json.dumps(manifest))


def test_a_new_version_is_served_without_a_restart(folder, bundle, motion):
    with TestClient(create_app(Settings(avatars=folder, reload_seconds=0.05))) as client:
        before = client.get("/avatars").json()[0]
        write_bundle(taller(bundle), folder / "shell")
        after, looks = before, 0
        while after["version"] == before["version"] and looks < 1000:  # not seconds: machines stand still at times
            time.sleep(0.02)
            after, looks = client.get("/avatars").json()[0], looks + 1
        assert after["version"] != before["version"]
        counts = {g["name"]: g["vertices"] for g in after["garments"]}
        assert counts != {g["name"]: g["vertices"] for g in before["garments"]}
        answer = decode_response(client.post(FRAMES, content=body_of(motion[:2]), headers=BINARY).content)
        assert {name: v.shape[1] for name, v in answer.vertices.items()} == counts


def test_an_added_avatar_is_served_and_a_removed_one_is_not(folder, library):
    shutil.copytree(folder / "shell", folder / "other")
    library.look()
    assert list(library.avatars) == ["shell", "other"]
    shutil.rmtree(folder / "shell")
    library.look()
    assert list(library.avatars) == ["shell", "other"]  # it may be on its way from one version to the next
    library.look()
    assert list(library.avatars) == ["other"]


def test_what_is_served_outlives_its_folder(folder, library):
    shutil.rmtree(folder / "shell")
    for _ in range(3):
        library.look()
    assert list(library.avatars) == ["shell"]
    assert library.avatars["shell"].engines["tshirt"].vertex_count > 0


def test_nothing_is_loaded_twice(library, monkeypatch):
    monkeypatch.setattr("service.library.load_avatar", lambda *_: pytest.fail("loaded again"))
    library.look()


def graph(folder: Path) -> bytes:
    return (folder / "tshirt.onnx").read_bytes()


def bomb() -> bytes:
    """A megabyte that unpacks to a gigabyte."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("joints.npy", "w") as entry:
        np.lib.format.write_array_header_1_0(entry, {"descr": "<f8", "fortran_order": False, "shape": (1 << 27,)})
        for _ in range(1 << 10):
            entry.write(bytes(1 << 20))
    return stream.getvalue()


def liar() -> bytes:
    """An array whose header promises terabytes that are not there."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive, archive.open("joints.npy", "w") as entry:
        np.lib.format.write_array_header_1_0(entry, {"descr": "<f8", "fortran_order": False, "shape": (1 << 46,)})
    return stream.getvalue()


def pickled() -> bytes:
    stream = io.BytesIO()
    np.savez(stream, joints=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return stream.getvalue()


def damage_packing(folder: Path) -> bytes:
    """A valid archive whose packed bytes are not."""
    content = bytearray((folder / "arrays.npz").read_bytes())
    middle = len(content) // 3
    content[middle : middle + 64] = bytes(64)
    return bytes(content)


def huge_dimension(folder: Path) -> bytes:
    """The graph with its longest run of numbers cut out: protobuf still reads, or does not."""
    content = graph(folder)
    return content[:2000] + struct.pack("<q", -1) * 8 + content[2064:]


DAMAGE: dict[str, Callable[[Path], None]] = {
    "an empty graph": lambda f: rewrite(f, "tshirt.onnx", b""),
    "half a graph": lambda f: rewrite(f, "tshirt.onnx", graph(f)[: len(graph(f)) // 2]),
    "another graph": lambda f: rewrite(f, "tshirt.onnx", (f / "trousers.onnx").read_bytes()),
    "a graph of noise": lambda f: rewrite(f, "tshirt.onnx", np.random.default_rng(0).bytes(5000)),
    "a graph with a wound": lambda f: rewrite(f, "tshirt.onnx", huge_dimension(f)),
    "a zip bomb": lambda f: rewrite(f, "arrays.npz", bomb()),
    "an array that lies": lambda f: rewrite(f, "arrays.npz", liar()),
    "pickled arrays": lambda f: rewrite(f, "arrays.npz", pickled()),
    "arrays that do not unpack": lambda f: rewrite(f, "arrays.npz", damage_packing(f)),
    "no archive": lambda f: rewrite(f, "arrays.npz", b"PK nonsense"),
    "exchanged bytes": lambda f: (f / "tshirt.onnx").write_bytes(graph(f)[:-1] + b"x"),
    "a missing file": lambda f: (f / "trousers.onnx").unlink(),
    "no JSON": lambda f: (f / "avatar.json").write_text("{"),
    "deep JSON": lambda f: (f / "avatar.json").write_text("[" * 100_000),
    "a list as manifest": lambda f: (f / "avatar.json").write_text("[]"),
    "bytes as manifest": lambda f: (f / "avatar.json").write_bytes(b"\xff\xfe\0"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_broken_bundles_are_refused_and_the_old_one_serves_on(folder, library, caplog, kind):
    serving = library.avatars["shell"]
    DAMAGE[kind](folder / "shell")
    library.look()
    assert library.avatars["shell"] is serving
    assert b'caphy_avatar_loads_total{avatar="shell",outcome="refused"} 1.0' in library._metrics.exposition()
    (refusal,) = [record for record in caplog.records if "avatar refused" in record.getMessage()]
    assert f"version {serving.version} serves on" in refusal.getMessage()
    assert str(folder) in refusal.getMessage()  # says where
    library.look()
    assert caplog.text.count("avatar refused") == 1  # once, not at every look
    with pytest.raises(CaphyError, match=r"export|copy|must"):
        Library(folder, 8, Metrics()).load()


def test_a_repaired_bundle_is_served_again(folder, library, avatars):
    content = graph(folder / "shell")
    (folder / "shell" / "tshirt.onnx").write_bytes(b"half of it")
    library.look()
    first = library.avatars["shell"]
    (folder / "shell" / "tshirt.onnx").write_bytes(content)
    library.look()
    assert library.avatars["shell"] is not first
    assert library.avatars["shell"].version == first.version


def test_one_broken_bundle_does_not_keep_the_others_from_starting(folder, bundle):
    write_bundle(bundle, folder / "broken")
    (folder / "broken" / "tshirt.onnx").write_bytes(b"")
    loaded = Library(folder, 8, Metrics())
    loaded.load()
    assert list(loaded.avatars) == ["shell"]


def test_what_nobody_foresaw_is_a_refusal_too(folder, library, monkeypatch):
    monkeypatch.setattr("service.library.load_avatar", lambda *_: 1 / 0)
    (folder / "shell" / "note.txt").write_text("touched")
    library.look()
    assert list(library.avatars) == ["shell"]
    with pytest.raises(CaphyError, match=r"cannot be loaded.*ZeroDivisionError"):
        Library(folder, 8, Metrics()).load()


def test_files_of_a_bundle_are_bounded(folder, library, monkeypatch):
    monkeypatch.setattr(bundles, "MOST_BYTES", 1 << 16)
    with pytest.raises(CaphyError, match="may have 0 MiB"):
        bundles.read_bundle(folder / "shell")


def test_a_good_avatar_is_not_withdrawn_for_a_broken_one(folder, library):
    """The only other folder is no avatar: better the one before than none."""
    (folder / "shell").rename(folder / "shell.away")
    (folder / "shell.away" / "avatar.json").rename(folder / "shell.away" / "avatar.bak")
    (folder / "bad").mkdir()
    (folder / "bad" / "avatar.json").write_text("{}")
    for _ in range(4):
        library.look()
    assert list(library.avatars) == ["shell"]


def test_a_folder_whose_name_no_address_can_hold_is_refused(folder, library):
    """Answers, metrics and logs would all fail on it."""
    shutil.copytree(folder / "shell", Path(os.fsdecode(os.fsencode(folder) + b"/caf\xe9")))
    library.look()
    assert list(library.avatars) == ["shell"]
    assert b'caphy_avatar_loads_total{avatar="caf' in library._metrics.exposition()
    with pytest.raises(CaphyError, match="folder's name must be UTF-8"):
        load_avatar(next(path for path in folder.iterdir() if path.name.startswith("caf")), 8)
