"""``caphy garment``, as a user types it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from caphy.body.bundled import default_body
from caphy.cli import main
from caphy.effects.presets import snug_model
from caphy.garment.template import Garment
from caphy.garment.topology import boundary_edges
from caphy.io.poses import write_poses
from caphy.io.procedural import procedural_motion


def test_make_info_check_render(tmp_path, capsys):
    npz, png = tmp_path / "shorts.npz", tmp_path / "shorts.png"
    assert main(["garment", "make", "shorts", "--leg", "0.2", "--edge-length", "0.035", "-o", str(npz)]) == 0
    garment = Garment.load(npz)
    assert garment.provenance["leg"] == "0.2" and garment.name == "shorts"
    assert main(["garment", "info", str(npz)]) == 0
    assert "leg_left" in capsys.readouterr().out
    assert main(["garment", "render", str(npz), "-o", str(png)]) == 0
    assert png.stat().st_size > 5000


def test_bodies_that_come_along_have_names(tmp_path, capsys):
    made = {name: tmp_path / f"{name}.npz" for name in ("none", "medium", "fine")}
    for name, path in made.items():
        words = [] if name == "none" else ["--body", name]
        assert main(["garment", "make", "shorts", "--edge-length", "0.05", *words, "-o", str(path)]) == 0
    none, medium, fine = (Garment.load(path) for path in made.values())
    np.testing.assert_array_equal(none.vertices, medium.vertices)
    assert none.vertices.shape != fine.vertices.shape or not np.allclose(none.vertices, fine.vertices)
    mesh, mine = tmp_path / "mine.obj", tmp_path / "mine.npz"
    trimesh.Trimesh(fine.vertices, fine.faces, process=False).export(mesh)
    assert main(["garment", "check", str(mesh), "--body", "fine"]) == 0
    assert main(["garment", "from-mesh", str(mesh), "--body", "fine", "-o", str(mine)]) == 0
    assert Garment.load(mine).apart(default_body("fine").joints) < 1e-6
    assert main(["garment", "render", str(mine), "--body", "medium", "-o", str(tmp_path / "mine.png")]) == 0
    assert main(["garment", "check", str(mesh), "--body", "finest"]) == 2
    assert "finest: there is no such body model file" in capsys.readouterr().err


def test_what_the_user_can_put_right_has_status_two_and_no_traceback(tmp_path, capsys):
    assert main(["garment", "make", "tshirt", "--sleeve", "3", "-o", str(tmp_path / "x.npz")]) == 2
    assert "sleeve must lie between" in capsys.readouterr().err
    for option, value in (("--ease", "-0.1"), ("--ease", "3"), ("--layer-thickness", "-1"), ("--neck-depth", "1")):
        assert main(["garment", "make", "tshirt", option, value, "-o", str(tmp_path / "x.npz")]) == 2
        assert f"{option[2:].replace('-', '_')} must lie between" in capsys.readouterr().err
    assert main(["garment", "check", str(tmp_path / "none.obj")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_what_export_would_refuse_is_refused_at_once(tmp_path, capsys):
    """Before 45 minutes of training."""
    made = tmp_path / "shorts.npz"
    assert main(["garment", "make", "shorts", "--edge-length", "0.04", "-o", str(made)]) == 0
    garment = Garment.load(made)
    mesh = tmp_path / "My Shorts.obj"
    trimesh.Trimesh(garment.vertices, garment.faces, process=False).export(mesh)
    command = ["garment", "from-mesh", str(mesh), "-o", str(tmp_path / "mine.npz")]
    for more, says in (
        ([], "letters, digits, - and _, 39 at most, and not body, got 'My Shorts'; give one with --name"),
        (["--name", "mine", "--layer-thickness", "5"], "layer thickness must lie between 0 and 0.1 m, got 5 m"),
        (["--name", "mine", "--layer-thickness", "-1"], "got -1 m"),
    ):
        assert main([*command, *more]) == 2
        assert says in capsys.readouterr().err
    assert main([*command, "--name", "mine"]) == 0
    replace(garment, name="My Shorts").save(made)
    assert main(["train", str(made), "-o", str(tmp_path / "run"), "--made-up", "1", "--steps", "1"]) == 2
    assert "make it again with 'caphy garment from-mesh --name'" in capsys.readouterr().err
    assert main(["garment", "info", str(mesh)]) == 2
    assert "it is no npz" in capsys.readouterr().err


def test_nothing_that_is_read_is_replaced(tmp_path, capsys):
    made = tmp_path / "shorts.npz"
    assert main(["garment", "make", "shorts", "--edge-length", "0.04", "-o", str(made)]) == 0
    garment, mesh = Garment.load(made), tmp_path / "mine.obj"
    trimesh.Trimesh(garment.vertices, garment.faces, process=False).export(mesh)
    text, poses = mesh.read_bytes(), tmp_path / "walk.npz"
    write_poses(procedural_motion(0, 0.2), poses)
    (tmp_path / "linked.npz").symlink_to(made)
    before = made.read_bytes(), poses.read_bytes()
    for command, says in (
        (["garment", "from-mesh", str(mesh), "-o", str(mesh)], "must end in .npz"),
        (["simulate", str(made), str(poses), "-o", str(made)], "is read, and would be replaced"),
        (["simulate", str(made), str(poses), "-o", str(poses)], "is read, and would be replaced"),
        (["simulate", str(made), str(poses), "-o", str(tmp_path / "linked.npz")], "is read, and would be replaced"),
        (["simulate", str(made), str(poses), "--render", str(poses)], "must end in .png"),
        (["garment", "render", str(made), "-o", str(made)], "must end in .png"),
    ):
        assert main(command) == 2
        assert says in capsys.readouterr().err
    assert mesh.read_bytes() == text and (made.read_bytes(), poses.read_bytes()) == before


def test_poses_of_a_camera_are_not_simulated(tmp_path, capsys):
    made, filmed = tmp_path / "shorts.npz", tmp_path / "filmed.npz"
    assert main(["garment", "make", "shorts", "--edge-length", "0.04", "-o", str(made)]) == 0
    write_poses(replace(procedural_motion(0, 0.2), frame="camera"), filmed)
    assert main(["simulate", str(made), str(filmed), "-o", str(tmp_path / "o.npz")]) == 2
    assert "these poses are in a camera's frame" in capsys.readouterr().err


def test_a_garment_is_simulated_on_the_body_that_it_was_made_on(tmp_path, capsys):
    """On another one it would start 15 mm too tight, or too loose."""
    made, poses = tmp_path / "shorts.npz", tmp_path / "walk.npz"
    assert main(["garment", "make", "shorts", "--edge-length", "0.05", "--betas", "1.5", "-o", str(made)]) == 0
    write_poses(procedural_motion(0, 0.1), poses)
    simulated = ["simulate", str(made), str(poses), "-o", str(tmp_path / "o.npz")]
    assert main(simulated) == 0
    assert "shorts: made on another body, whose joints lie up to 114 mm" in capsys.readouterr().out
    assert main([*simulated, "--betas", "1.5"]) == 0
    assert "another body" not in capsys.readouterr().out


def test_cloth_that_is_lighter_than_nothing_is_neither_simulated_nor_trained(tmp_path, capsys):
    """Five kilogrammes per square metre and metre of height, of cloth of 0.2 kg/m^2."""
    made, poses, model = tmp_path / "shorts.npz", tmp_path / "walk.npz", tmp_path / "model.json"
    assert main(["garment", "make", "shorts", "--edge-length", "0.05", "-o", str(made)]) == 0
    write_poses(procedural_motion(0, 0.1), poses)
    model.write_text(snug_model().with_effect("mass_gradient", gradient=5.0).to_json())
    for command, out in (("simulate", tmp_path / "o.npz"), ("train", tmp_path / "run")):
        assert main([command, str(made), str(poses), "-o", str(out), "--model", str(model)]) == 2
        assert "the mass of every vertex must be positive, but vertex" in (err := capsys.readouterr().err)
        assert "by mass_gradient; change" in err and not out.exists()


def test_numbers_of_a_mesh_that_mean_nothing_are_refused(tmp_path, capsys):
    mesh = tmp_path / "mine.obj"
    trimesh.creation.cylinder(0.3, 0.5).export(mesh)
    for more, says in (
        (["--panel-scale", "0"], "--panel-scale must be positive and finite, got 0"),
        (["--panel-scale", "nan"], "--panel-scale must be positive and finite, got nan"),
        (["--offset", "nan", "0", "0"], "--offset must be three finite numbers"),
    ):
        assert main(["garment", "check", str(mesh), *more]) == 2
        assert says in capsys.readouterr().err


def test_check_refuses_what_could_not_be_worn(tmp_path, capsys):
    made = tmp_path / "shorts.npz"
    assert main(["garment", "make", "shorts", "--edge-length", "0.04", "-o", str(made)]) == 0
    garment = Garment.load(made)
    a, b = boundary_edges(garment.faces)[0].tolist()  # a hem's edge gets a face that is a line
    beside = [*garment.vertices.tolist(), garment.vertices[[a, b]].mean(axis=0).tolist()]
    meshes = {
        "good": (garment.vertices, garment.faces),
        "turned": (garment.vertices, garment.faces[:, ::-1]),
        "far": (garment.vertices + np.array([0, 0, 1.5]), garment.faces),
        "thin": (garment.vertices * [0.3, 1, 0.3], garment.faces),
        "line": (beside, [*garment.faces.tolist(), [b, a, len(garment.vertices)]]),
    }
    said = {}
    for name, (vertices, faces) in meshes.items():
        trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / f"{name}.obj")
        status = main(["garment", "check", str(tmp_path / f"{name}.obj")])
        captured = capsys.readouterr()
        said[name] = (status, captured.out + captured.err)
    assert said["good"][0] == 0 and "can be made a garment" in said["good"][1]
    assert "moves with left_hip" in said["good"][1] or "moves with right_hip" in said["good"][1]
    assert said["turned"][0] == 2 and "flip normals" in said["turned"][1]
    assert said["far"][0] == 2 and "must lie on the body" in said["far"][1]
    assert said["thin"][0] == 2 and "must lie outside the body" in said["thin"][1]
    assert said["line"][0] == 2 and "every face needs an area, but 1 of 822" in said["line"][1], said["line"]
    (tmp_path / "edge.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n")
    assert main(["garment", "check", str(tmp_path / "edge.obj")]) == 2
    assert "a face needs three corners" in capsys.readouterr().err
