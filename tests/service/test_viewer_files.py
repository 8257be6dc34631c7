"""Pose files that are uploaded: what is read, and everything a stranger may send."""

from __future__ import annotations

import importlib.util
import io
import json
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_app import refused

from caphy.io.poses import read_poses, write_poses
from service.protocol import MEDIA_TYPE, decode_request, decode_response

POSES = "/avatars/shell/poses"


def cmu_skeleton():
    """The module with hand-made CMU files, of the readers' own tests."""
    path = Path(__file__).parents[1] / "io" / "cmu_skeleton.py"
    spec = importlib.util.spec_from_file_location("cmu_skeleton", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def npz(**arrays) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def amass(frames: int = 40, fps: float = 120.0, **changes) -> bytes:
    """A file as AMASS has them: z up, SMPL-H, a body that leans and walks along x."""
    rng = np.random.default_rng(5)
    poses = rng.normal(scale=0.05, size=(1, 156)) * np.linspace(0, 1, frames)[:, None]
    poses[:, 0] += np.pi / 2
    trans = np.stack([np.linspace(0, 0.4, frames), np.zeros(frames), np.full(frames, 0.9)], axis=-1)
    arrays = {"poses": poses, "trans": trans, "betas": np.zeros(16), "gender": "neutral", "mocap_framerate": fps}
    return npz(**{**arrays, **changes})


def send(http, name: str, content: bytes, **query):
    return http.post(POSES, params={"name": name, **query}, content=content, headers={"content-type": MEDIA_TYPE})


def test_the_made_up_motion_is_a_request_that_is_answered(http, bundle):
    answer = http.get(POSES)
    request = decode_request(answer.content)
    assert len(request.poses) == 601
    assert request.fps == bundle.fps
    assert "procedural" in json.loads(answer.headers["caphy-source"])
    meshes = http.post("/avatars/shell/frames", content=answer.content, headers={"content-type": MEDIA_TYPE})
    assert len(decode_response(meshes.content).vertices["tshirt"]) == 601


def test_amass_files_come_upright_at_the_avatars_rate(http, tmp_path):
    answer = send(http, "walk.npz", amass())
    request = decode_request(answer.content)
    (tmp_path / "walk.npz").write_bytes(amass())
    expected = read_poses(tmp_path / "walk.npz").resample(30.0)
    np.testing.assert_allclose(request.poses, expected.poses, atol=1e-6)
    step = request.transl - request.transl[0]
    np.testing.assert_allclose(step[:, [0, 2]], (expected.transl - expected.transl[0])[:, [0, 2]], atol=1e-5)
    assert json.loads(answer.headers["caphy-source"]) == "walk.npz"
    assert any("z was up in the file" in note for note in json.loads(answer.headers["caphy-notes"]))


def test_feet_stand_on_the_floor(http, bundle):
    request = decode_request(send(http, "walk.npz", amass()).content)
    posed = bundle.body.posed(bundle.transforms(request.poses, request.transl))
    assert np.abs(posed[..., 1].min(axis=1)).max() < 0.03


def test_bvh_files_are_read_as_the_reader_reads_them(http, tmp_path):
    skeleton = cmu_skeleton()
    text = skeleton.bvh_text(skeleton.random_angles(np.random.default_rng(0), 60), skeleton.root_path(60))
    (tmp_path / "walk.bvh").write_text(text)
    request = decode_request(send(http, "Walk.BVH", text.encode()).content)
    expected = read_poses(tmp_path / "walk.bvh").resample(30.0)
    np.testing.assert_allclose(request.poses, expected.poses, atol=1e-6)


def test_caphys_own_files_and_a_rate_that_is_given(http, motion, tmp_path):
    write_poses(motion, tmp_path / "own.npz")
    request = decode_request(send(http, "own.npz", (tmp_path / "own.npz").read_bytes()).content)
    np.testing.assert_allclose(request.poses, motion.poses, atol=1e-6)
    without = npz(poses=np.zeros((10, 165)) + np.eye(1, 165) * 1e-3, trans=np.zeros((10, 3)))
    refused(send(http, "plain.npz", without), 422, "plain.npz", "frame rate")
    assert len(decode_request(send(http, "plain.npz", without, fps=15).content).poses) == 19


def test_nothing_is_unpickled(http, tmp_path):
    """A file of Python objects could run code when it is read."""
    mark = tmp_path / "ran"

    class Bomb:
        def __reduce__(self):
            return (open, (str(mark), "w"))

    objects = np.array([Bomb()], dtype=object)
    for name, content in {
        "walk.npz": npz(poses=objects, trans=np.zeros((1, 3)), mocap_framerate=30.0),
        "all.npz": pickle.dumps(Bomb()),
        "single.npz": _npy(objects),
    }.items():
        refused(send(http, name, content), 422, name if name == "walk.npz" else "npz")
    for name in ("walk.pkl", "hmr4d_results.pt", "walk", "walk.npz.pkl", "../../walk.pkl"):
        refused(send(http, name, pickle.dumps(Bomb())), 415, ".npz", "caphy poses convert")
    assert not mark.exists()


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def test_archives_that_unpack_to_too_much(http):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("poses.npy", "w") as member:
        for _ in range(150):
            member.write(bytes(1 << 20))
    assert len(stream.getvalue()) < 1 << 20
    refused(send(http, "bomb.npz", stream.getvalue()), 413, "unpack")


def frames_of_zeros(frames: int, kind: str = "i1", **changes) -> bytes:
    """A small file of many frames, at 10 kHz so that they take less than 300 s."""
    stream = io.BytesIO()
    arrays = {"poses": np.zeros((frames, 165), kind), "trans": np.zeros((frames, 3), kind), "mocap_frame_rate": 1e4}
    np.savez_compressed(stream, **{**arrays, **changes})
    return stream.getvalue()


def test_small_files_of_many_frames_are_refused_by_their_headers(http, monkeypatch):
    skeleton = cmu_skeleton()
    bvh = skeleton.bvh_text(skeleton.random_angles(np.random.default_rng(0), 3), skeleton.root_path(3)).encode()
    parts = {"root_orient": np.zeros((1, 70_000, 3), "i1"), "pose_body": np.zeros((70_000, 63), "i1")}
    hidden = io.BytesIO(frames_of_zeros(3))
    with zipfile.ZipFile(hidden, "a") as archive, zipfile.ZipFile(io.BytesIO(frames_of_zeros(40_000))) as more:
        archive.writestr("trans", more.read("trans.npy"))
    monkeypatch.setattr("service.viewer.pose_files.read_poses", lambda *_, **__: 1 / 0)
    for name, content, word in (
        ("a.npz", frames_of_zeros(90_000), "90000"),
        ("a.npz", frames_of_zeros(70_000, poses=np.zeros(3), **parts), "70000"),
        ("a.npz", hidden.getvalue(), "40000"),
        ("a.npz", frames_of_zeros(3, betas=np.zeros(17_000_000, "i1")), "unpack"),
        ("A.BVH", bvh.replace(b"Frames: 3", b"Frames:\t1e6"), "1000000"),
        ("a.bvh", bvh.replace(b"Frames: 3", b"Frames: 30000").replace(b"ROOT", b"JOINT " * 100 + b"ROOT"), "unpack"),
    ):
        assert len(content) < 1 << 17
        refused(send(http, name, content), 413, name, word)


def test_what_fails_after_reading_is_the_files_fault_too(http, monkeypatch):
    def too_little_memory(*_):
        raise MemoryError

    monkeypatch.setattr("service.viewer.pose_files.placed_on", too_little_memory)
    refused(send(http, "a.npz", amass()), 422, "a.npz", "MemoryError")


def test_headers_that_promise_more_than_there_is(http):
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (20000, 156), }"
    npy = b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little") + header.ljust(117).encode() + b"\n"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("poses.npy", npy)
    refused(send(http, "liar.npz", stream.getvalue()), 422, "npz")


def archive_of(**members: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "status", "word"),
    [
        ("a.npz", b"", 422, "npz"),
        ("a.npz", amass()[:300], 422, "npz"),
        ("a.npz", archive_of(poses=b"no array", trans=b"", mocap_framerate=b"30"), 422, "no array"),
        ("a.npz", archive_of(header=b"caphy-poses"), 422, "a.npz"),
        ("a.bvh", b"HIERARCHY", 422, "a.bvh"),
        ("a.bvh", b"\xff\xfe\x00", 422, "text"),
        ("a.npz", npz(poses=np.full((3, 156), np.nan), trans=np.zeros((3, 3)), mocap_framerate=30.0), 422, "finite"),
        ("a.npz", amass(frames=700, fps=2.0), 413, "300 s"),
        ("a.npz", npz(header=np.array('{"schema": "caphy-poses", "x":' + "[" * 100_000)), 422, "a.npz"),
        ("x" * 300 + ".npz", amass(), 422, "name"),
    ],
)
def test_what_cannot_be_used_is_refused_in_words(http, name, content, status, word):
    response = send(http, name, content)
    refused(response, status, word)
    assert "/tmp" not in response.text


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """No temporary directory, as in a container that is read-only, and no memory for files but what the test makes."""

    def none():
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr("tempfile.gettempdir", none)
    monkeypatch.setattr("service.viewer.pose_files.MEMORY", str(tmp_path / "memory"), raising=False)
    return tmp_path / "memory"


def test_files_are_read_where_only_memory_can_be_written(http, nowhere):
    nowhere.mkdir()
    assert send(http, "walk.npz", amass()).status_code == 200
    assert list(nowhere.iterdir()) == []


def test_where_nothing_can_be_written_it_is_said(http, nowhere):
    refused(send(http, "walk.npz", amass()), 503, "TMPDIR")


def test_a_full_disk_is_left_for_memory(http, nowhere, monkeypatch, tmp_path):
    nowhere.mkdir()
    disk = tmp_path / "disk"
    disk.mkdir()
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(disk))
    write = Path.write_bytes

    def full(path, content):
        if disk in path.parents:
            raise OSError(28, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    assert send(http, "walk.npz", amass()).status_code == 200
    assert list(disk.iterdir()) == list(nowhere.iterdir()) == []


def test_cameras_do_not_know_which_way_is_down(http, motion, tmp_path):
    write_poses(replace(motion, frame="camera"), tmp_path / "seen.npz")
    refused(send(http, "seen.npz", (tmp_path / "seen.npz").read_bytes()), 422, "camera")


def test_large_files_and_unknown_avatars(http):
    refused(send(http, "a.npz", bytes((8 << 20) + 1)), 413, "bytes")
    refused(http.post("/avatars/none/poses?name=a.npz", content=amass()), 404, "shell")


def test_mutated_files_never_break_the_service(http):
    skeleton = cmu_skeleton()
    bvh = skeleton.bvh_text(skeleton.random_angles(np.random.default_rng(1), 3), skeleton.root_path(3)).encode()
    rng = np.random.default_rng(7)
    for name, whole in (("a.npz", amass(frames=3)), ("a.bvh", bvh)):
        for _ in range(150):
            content = bytearray(whole)
            for place in rng.integers(0, len(content), rng.integers(1, 9)):
                content[place] = rng.integers(0, 256)
            if rng.random() < 0.3:
                content = content[: rng.integers(0, len(content))]
            response = send(http, name, bytes(content))
            assert response.status_code in (200, 413, 422), response.text[:200]
            if response.status_code == 200:
                assert np.isfinite(decode_request(response.content).poses).all()
    assert http.get("/ready").status_code == 200
