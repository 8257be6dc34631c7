"""USD, PC2 and OBJ against the service's vertices, read by programs and loops that caphy did not write."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom, UsdValidation

from caphy.cli import main
from caphy.errors import CaphyError
from caphy.io.bundle import write_bundle
from caphy.io.places import write_bytes
from caphy.io.poses import write_poses
from export.motion import dressed_motion
from export.obj import write_obj_sequence
from export.pc2 import write_pc2
from export.usd import write_usd


@pytest.fixture(scope="module")
def dressed(bundle, motion):
    return dressed_motion(bundle, motion[:6])


def test_vertices_are_the_services(dressed, served):
    for name, vertices in served.items():
        np.testing.assert_allclose(dressed.vertices[name], vertices[:6], atol=2e-6)


def test_motions_come_at_the_avatars_rate_and_in_world_coordinates(bundle, motion):
    assert len(dressed_motion(bundle, replace(motion[:9], fps=60.0))) == 5
    with pytest.raises(CaphyError, match="camera"):
        dressed_motion(bundle, replace(motion[:2], frame="camera"))


def test_a_motion_of_another_body_stands_where_it_stood(bundle, motion, dressed):
    """A translation refers to where the pelvis of its own body rests, 35 cm lower in SMPL-X than here."""
    foreign = motion.about(np.array([0.003, -0.351, 0.012]))
    np.testing.assert_allclose(dressed_motion(bundle, foreign[:6]).transl, dressed.transl, atol=1e-6)


def test_usd_holds_every_frame(dressed, served, tmp_path):
    stage = Usd.Stage.Open(str(write_usd(dressed, tmp_path / "walk.usdc")))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (30, 0, 5)
    body = dressed.bundle.body.posed(dressed.bundle.transforms(dressed.poses, dressed.transl))
    for name, expected in {"body": body, **served}.items():
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/avatar/{name}"))
        for frame in (0, 3, 5):
            points = np.array(mesh.GetPointsAttr().Get(frame))
            np.testing.assert_allclose(points, expected[frame], atol=2e-6)
            low, high = np.array(mesh.GetExtentAttr().Get(frame))
            np.testing.assert_allclose([low, high], [points.min(axis=0), points.max(axis=0)], atol=1e-7)
        rest = dressed.bundle.body if name == "body" else dressed.bundle.garment(name).mesh
        np.testing.assert_array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), rest.faces)
        np.testing.assert_array_equal(mesh.GetPointsAttr().Get(), mesh.GetPointsAttr().Get(0))  # at no time: the first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["walk.usdc"]


def test_usd_passes_pixars_validators(dressed, tmp_path):
    stage = Usd.Stage.Open(str(write_usd(dressed, tmp_path / "walk.usda")))
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [str(error.GetMessage()) for error in context.Validate(stage)] == []


def test_usd_names_end_as_usd_names_do(dressed, tmp_path):
    with pytest.raises(CaphyError, match=r"\.usdc"):
        write_usd(dressed, tmp_path / "walk.abc")


def test_usd_that_cannot_be_written_is_told_in_words(dressed, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(CaphyError, match=r"walk\.usdc: cannot be written, since .*file is a file"):
        write_usd(dressed, tmp_path / "file" / "walk.usdc")
    monkeypatch.setattr("export.usd.writable_file", lambda path: path)  # as where the disk is full by then
    with pytest.raises(CaphyError, match=r"walk\.usdc: cannot be written \(Unable to open [^']*\); choose another"):
        write_usd(dressed, Path("/proc/walk.usdc"))


def test_pc2_is_laid_out_as_blender_reads_it(dressed, served, tmp_path):
    write_pc2(dressed, tmp_path)
    content = (tmp_path / "tshirt.pc2").read_bytes()
    assert content[:12] == b"POINTCACHE2\0"
    version, count, start, rate, samples = struct.unpack_from("<iiffi", content, 12)
    assert (version, count, start, rate, samples) == (1, served["tshirt"].shape[1], 0.0, 1.0, 6)
    assert len(content) == 32 + 12 * count * samples
    third = [struct.unpack_from("<fff", content, 32 + 12 * (3 * count + v)) for v in range(0, count, 50)]
    np.testing.assert_allclose(third, served["tshirt"][3][::50], atol=2e-6)
    mesh = trimesh.load(tmp_path / "tshirt.obj", process=False)
    np.testing.assert_allclose(mesh.vertices, served["tshirt"][0], atol=2e-6)
    np.testing.assert_array_equal(mesh.faces, dressed.bundle.garment("tshirt").mesh.faces)


def test_pc2_does_not_replace_a_mesh_of_ones_own(dressed, tmp_path):
    (tmp_path / "tshirt.obj").write_text("mine")
    with pytest.raises(CaphyError, match=r"tshirt\.obj: has no point cache, and would be replaced"):
        write_pc2(dressed, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["tshirt.obj"]
    (tmp_path / "tshirt.obj").unlink()
    write_pc2(dressed, tmp_path)
    write_pc2(dressed, tmp_path)


def test_obj_sequence(dressed, served, tmp_path):
    paths = write_obj_sequence(dressed, tmp_path)
    assert len(paths) == 3 * 6
    mesh = trimesh.load(tmp_path / "trousers_0004.obj", process=False)
    np.testing.assert_allclose(mesh.vertices, served["trousers"][4], atol=2e-6)
    np.testing.assert_array_equal(mesh.faces, dressed.bundle.garment("trousers").mesh.faces)


def test_frames_of_another_motion_are_not_mixed_in(dressed, bundle, motion, tmp_path):
    write_obj_sequence(dressed, tmp_path)
    write_obj_sequence(dressed, tmp_path)
    with pytest.raises(CaphyError, match=r"holds 9 frames of another motion \(body_0003.obj\)"):
        write_obj_sequence(dressed_motion(bundle, motion[:3]), tmp_path)


def test_frames_of_a_motion_that_was_stopped_go(bundle, motion, tmp_path, monkeypatch):
    """Half a motion looks like a motion; what else lies there stays."""
    dressed, left = dressed_motion(bundle, motion[:3]), [5]
    (tmp_path / "notes.txt").write_text("mine")

    def stopped(*written) -> None:
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt
        write_bytes(*written)

    monkeypatch.setattr("export.obj.write_bytes", stopped)
    with pytest.raises(KeyboardInterrupt):
        write_obj_sequence(dressed, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("form", "out", "found"),
    [("glb", "walk.glb", 1), ("usd", "walk.USDC", 1), ("pc2", "caches", 6), ("obj", "frames", 9)],
)
def test_the_command_writes_every_format(bundle, motion, tmp_path, capsys, form, out, found):
    write_bundle(bundle, tmp_path / "shell")
    write_poses(motion[:3], tmp_path / "walk.npz")
    arguments = ["--format", form, "--poses", str(tmp_path / "walk.npz"), "-o", str(tmp_path / "out" / out)]
    assert main(["export", str(tmp_path / "shell"), *arguments]) == 0, capsys.readouterr().err
    assert "3 frames" in capsys.readouterr().out
    assert len([path for path in (tmp_path / "out").rglob("*") if path.is_file()]) == found


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--format", "usd", "-o", "a.usdc"], "--poses"),
        (["--format", "glb", "-o", "a.gltf"], ".glb"),
        (["--format", "glb", "-o", "a.glb", "--within-mm", "-1"], "--within-mm"),
        (["--format", "glb", "-o", "a.glb", "--within-mm", "inf"], "--within-mm must be finite"),
        (["--format", "glb", "--poses", "w.npz", "-o", "a.glb", "--within-mm", "5"], "--within-mm is for the avatar"),
        (["-o", "again", "--within-mm", "5"], "--within-mm is for the avatar"),
        (["--format", "usd", "--poses", "w.npz", "-o", "a.abc"], ".usdc or .usda"),
        (["another", "--format", "glb", "-o", "a.glb"], "one avatar bundle"),
        (["-o", "again", "--licence", "mine"], "--licence belongs to the export of trainings"),
        (["--format", "glb", "-o", "a.glb", "--motions", "m"], "--motions belongs to the export of trainings"),
    ],
)
def test_what_the_command_refuses(bundle, tmp_path, capsys, monkeypatch, arguments, word):
    monkeypatch.chdir(tmp_path)
    write_bundle(bundle, tmp_path / "shell")
    assert main(["export", "shell", *arguments]) == 2
    assert word in capsys.readouterr().err
