"""``caphy register`` on a folder of scans, one of them spoilt."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from dressed_scans import GARMENTS, disturbed, subject, visible

from caphy.body.bundled import default_body
from caphy.body.model import BodyModel
from caphy.body.surface import Surface
from caphy.challenge.sheets import users_square
from caphy.cli import main
from caphy.commands.register import _garment, _hung, _shown, _targets, _tell_of_layers
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.garment.families import Tshirt
from caphy.garment.landmarks import Landmarks
from caphy.garment.meshing import too_sharp
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion
from caphy.kept import Kept
from caphy.register.articulation import Figure
from caphy.register.cloud import Cloud
from caphy.register.layers import MOST
from caphy.register.linear_style import choose_linear
from caphy.register.result import read_fit
from caphy.register.starts import plain_poses
from caphy.register.template import Choice, dressed_body
from caphy.report.render import vertex_normals
from caphy.scan.scan import Scan
from caphy.scan.scan_set import write_scan_set


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two meshes of what is visible of a dressed person, and one without labels."""
    folder = tmp_path_factory.mktemp("scans")
    person, motion, rng = subject(5), procedural_motion(2, 6.0, 2.0), np.random.default_rng(0)
    poses, scans = motion.poses[[3, 8, 8]], []
    for i, pose in enumerate(poses):
        skin = person.naked(pose[None], np.array([[0.0, 1.0, 0.0]]))[0]
        transforms = person.body.transforms(pose[None], person.betas)[0]
        meshes = [(skin, person.body.faces)]
        for garment in person.garments:
            blend = np.tensordot(garment.weights, transforms, axes=1)
            vertices = np.einsum("vij,vj->vi", blend[..., :3], garment.vertices) + blend[..., 3] + [0.0, 1.0, 0.0]
            meshes.append((vertices, garment.faces))
        starts = np.cumsum([0, *(len(v) for v, _ in meshes)])
        vertices = np.concatenate([v for v, _ in meshes])
        faces = np.concatenate([f + s for (_, f), s in zip(meshes, starts[:-1], strict=True)])
        labels = np.repeat(np.arange(3), np.diff(starts)).astype(np.uint8)
        seen = visible(vertices, vertex_normals(vertices, faces), meshes)
        faces = faces[seen[faces].all(axis=1)]
        scans.append(Scan(f"scan{i}", vertices, faces, labels=None if i == 2 else labels))
    starts = np.stack([disturbed(pose, 15.0, rng) for pose in poses])
    sequence = PoseSequence(starts, np.tile([0.0, 1.0, 0.0], (3, 1)), 1.0, pelvis=person.body.joints[0])
    write_scan_set(folder, scans, "somebody", sequence)
    return folder


def test_body_and_garment_are_found_and_the_spoilt_scan_is_named(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("caphy.register.fit.ROUNDS", 11)
    run = tmp_path / "run"
    assert main(["register", "body", str(folder), "-o", str(run), "--pictures", "1"]) == 0
    told = capsys.readouterr().out
    assert "2 of 3 scans fitted" in told and "scan2.ply: has no labels" in told
    document = json.loads((run / "body.json").read_text())
    assert list(document["scans"]) == ["scan0", "scan1"] and list(document["left_out"]) == ["scan2"]
    assert document["scans"]["scan0"]["skin_mean"] < 0.005
    assert read_fit(run / "body.npz", default_body()).vertices(0).shape == default_body().v_template.shape
    assert (run / "body.png").stat().st_size > 10_000

    garment = Garment.load(GARMENTS / "trousers.npz")
    basis = tmp_path / "My basis.npz"
    np.savez(
        basis, mean=garment.vertices, components=0.02 * garment.vertices[None] * [1.0, 0.0, 1.0], faces=garment.faces
    )
    monkeypatch.setattr("caphy.register.linear_style.choose_linear", partial(choose_linear, count=5))
    command = ["register", "garments", str(folder), "-o", str(run), "--garments", "lower", "--lower-basis", str(basis)]
    assert main(command) == 0
    assert Garment.load(run / "lower.npz").name == "lower"  # whatever the file of its basis is called
    assert json.loads((run / "garments.json").read_text())["lower"]["looked_at"] == 5

    # Stopped amid the second garment, it goes on with what was found.
    done = []

    def choose(figure, targets, kind, progress) -> Choice:
        done.append("chosen")
        return Choice(Tshirt(sleeve=0.31, length=0.6), 0.01, 7, (("tshirt", 0.01),))

    def hung(*_) -> np.ndarray:
        done.append("hung")
        return garment.vertices

    def hung_style(style, figure, targets, sheets, model, progress, hang) -> Tshirt:
        assert replace(style, layer_thickness=0.0) == Tshirt(sleeve=0.31, length=0.6)
        placement = targets[0].placed.placement
        assert (hang(garment, None, figure.body, placement, model) == garment.vertices).all()
        done.append("stopped" if "stopped" not in done else "eases")
        if done[-1] == "stopped":
            raise KeyboardInterrupt
        return replace(style, ease=0.05, length=0.55)

    monkeypatch.setattr("caphy.register.template.choose", choose)
    monkeypatch.setattr("caphy.register.template.distance", lambda style, *_: style.ease * style.length)
    monkeypatch.setattr("caphy.register.hanging.hung", hung)
    monkeypatch.setattr("caphy.register.hanging.hung_style", hung_style)
    both = [*command[:6], "lower", "upper", *command[7:]]
    assert main(both) == 130
    monkeypatch.setattr("caphy.register.linear_style.choose_linear", None)
    assert main(both) == 0
    assert done == ["chosen", "hung", "stopped", "eases"]
    told = json.loads((run / "garments.json").read_text())
    assert (told["lower"]["looked_at"], told["upper"]["looked_at"]) == (5, 7)
    assert (told["upper"]["families"], told["upper"]["distance"]) == ({"tshirt": 0.01}, 0.05 * 0.55)  # as it was hung
    assert not (run / "garments-unfinished").exists()

    # The scans show the shirt outside the trousers, so it keeps off the body by what those take.
    upper, lower = (Garment.load(run / f"{kind}.npz") for kind in ("upper", "lower"))
    body = dressed_body(read_fit(run / "body.npz", default_body()).figure)
    covered = lower.vertices[lower.vertices[:, 1] > upper.vertices[:, 1].min()]
    height = Surface.of(body.faces, body.v_template).nearest(covered, body.v_template).distance
    below = upper.vertices[:, 1] < Landmarks.of(body).crotch + 0.1
    assert below.sum() > 50 and (upper.layer_thickness[below] > min(np.median(height), MOST) - 1e-6).all()
    assert told["upper"]["layer_thickness"] == pytest.approx(upper.layer_thickness.max())


def test_templates_are_chosen_by_the_scans_that_show_them(tmp_path, capsys, monkeypatch):
    """A scan of many may lack one garment: only where all lack it there is nothing to choose by."""
    points = np.random.default_rng(0).random((90, 3))
    both, upper = np.repeat([0, 1, 2], 30), np.repeat([0, 1, 1], 30)
    names, labels = ("scan0", "scan1", "scan2"), (both, upper, both)
    clouds = [Cloud(name, points, points, label) for name, label in zip(names, labels, strict=True)]

    class Scans(list):
        """Clouds in place of scans."""

    scans = Scans(clouds)
    scans.names = names
    seen = []

    def choose(figure, targets, kind, progress) -> Choice:
        seen.extend(target.scan.name for target in targets)
        return Choice(Tshirt(), 0.01, 7, ())

    monkeypatch.setattr("caphy.register.cloud.Cloud.of", lambda scan: scan)
    monkeypatch.setattr("caphy.register.template.choose", choose)
    monkeypatch.setattr("caphy.register.template.distance", lambda *_: 0.01)
    monkeypatch.setattr("caphy.commands.register._hung", lambda *_: (Tshirt(), users_square(5)))
    (tmp_path / "body.npz").write_bytes(b"fit")
    command = SimpleNamespace(output=tmp_path, body="medium", upper_basis=None, lower_basis=None)
    fit = SimpleNamespace(names=names, placements=plain_poses()[:3], figure=SimpleNamespace(placed=lambda _: None))
    told = _garment(command, fit, range(3), scans, "lower", Model(0.2), Kept())
    assert sorted(seen) == ["scan0", "scan2"] and sorted(told["scans"]) == ["scan0", "scan2"]
    assert "left out: scan1: has no points labelled lower" in capsys.readouterr().out
    scans[:] = [clouds[1]] * 3
    with pytest.raises(CaphyError, match=r"no scan shows the lower garment:\n.*has no points labelled lower"):
        _garment(command, fit, range(3), scans, "lower", Model(0.2), Kept())


def test_a_garment_that_finds_no_room_beneath_another_is_told(tmp_path, capsys):
    """Chosen one by one, the shirt before the trousers that it hangs over."""
    cloud = SimpleNamespace(labels=np.array([0, 1, 2]))
    alone = SimpleNamespace(output=tmp_path, garments=("upper",))
    _tell_of_layers(alone, "upper", [SimpleNamespace(labels=np.array([0, 1]))])
    assert capsys.readouterr().out == ""
    _tell_of_layers(alone, "upper", [cloud])
    assert "leaves no room" in capsys.readouterr().out
    (tmp_path / "upper.npz").write_bytes(b"")
    _tell_of_layers(SimpleNamespace(output=tmp_path, garments=("lower",)), "lower", [cloud])
    assert "upper.npz was chosen before" in capsys.readouterr().out
    (tmp_path / "lower.npz").write_bytes(b"")
    _tell_of_layers(SimpleNamespace(output=tmp_path, garments=("lower", "upper")), "lower", [cloud])
    _tell_of_layers(alone, "upper", [cloud])
    assert capsys.readouterr().out == ""


def test_one_garment_at_a_time_is_told_as_both(tmp_path, monkeypatch):
    """Of the other garment what is known stays, as long as its template is there."""
    nobody = SimpleNamespace(names=[], placements=[])
    monkeypatch.setattr("caphy.register.result.read_fit", lambda *_: nobody)
    monkeypatch.setattr("caphy.scan.scan_set.ScanSet.read", lambda *_: nobody)
    failing, times = [], iter(range(9))

    def garment(command, fit, shown, scans, kind, model, kept) -> dict:
        if kind in failing:
            raise CaphyError("no scan shows it")
        (tmp_path / f"{kind}.npz").write_bytes(b"template")
        return {"time": next(times)}

    def chosen(*kinds: str) -> dict[str, int]:
        main(["register", "garments", str(tmp_path), "-o", str(tmp_path), "--garments", *kinds])
        return {kind: told["time"] for kind, told in json.loads((tmp_path / "garments.json").read_text()).items()}

    monkeypatch.setattr("caphy.commands.register._garment", garment)
    assert chosen("upper") == {"upper": 0}
    assert list(chosen("lower").items()) == [("lower", 1), ("upper", 0)]  # in the order of both at once
    failing.append("upper")
    assert chosen("upper", "lower") == {"upper": 0, "lower": 2}  # the lower one that is there now
    (tmp_path / "upper.npz").unlink()
    assert chosen("lower") == {"lower": 3}


def test_a_scan_that_can_no_longer_be_used_is_named_and_the_rest_chooses(capsys, monkeypatch):
    """Its labels may have changed since the body was found."""
    points, names = np.random.default_rng(0).random((90, 3)), ("scan0", "scan1")

    class Scans(list):
        """Clouds in place of scans."""

    def of(scan: Cloud) -> Cloud:
        if scan.name == "scan0":
            raise CaphyError("scan0.ply: has no labels")
        return scan

    scans = Scans([Cloud(name, points, points, np.repeat([0, 1, 2], 30)) for name in names])
    scans.names = names
    monkeypatch.setattr("caphy.register.cloud.Cloud.of", of)
    fit = SimpleNamespace(names=names, placements=plain_poses()[:2], figure=SimpleNamespace(placed=lambda _: None))
    assert _targets(fit, range(2), scans, "lower")[0] == [1]
    assert "left out: scan0.ply: has no labels" in capsys.readouterr().out
    with pytest.raises(CaphyError, match=r"no scan shows the lower garment:\nscan0\.ply: has no labels"):
        _targets(fit, [0], scans, "lower")


def test_templates_are_not_chosen_by_what_is_held_out(tmp_path, capsys):
    """Where nothing is held out yet, it is said that all choose."""
    assert _shown(tmp_path, ("a", "b", "c")) == [0, 1, 2]
    assert "note: " in (told := capsys.readouterr().out) and "caphy register points" in told
    (tmp_path / "split.json").write_text(json.dumps({"train": ["b", "d"], "held_out": ["a"]}))
    assert _shown(tmp_path, ("a", "b", "c")) == [1] and not capsys.readouterr().out
    with pytest.raises(CaphyError, match=r"split\.json: names none of the scans of the body fit to train on"):
        _shown(tmp_path, ("a", "c"))


def test_nothing_to_fit_is_an_error_in_words(folder, tmp_path, capsys):
    assert main(["register", "body", str(folder / "none"), "-o", str(tmp_path)]) == 2
    assert "scans.toml" in capsys.readouterr().err
    assert main(["register", "garments", str(folder), "-o", str(tmp_path)]) == 2
    assert "body.npz" in capsys.readouterr().err


@pytest.mark.parametrize("spoilt", ["its eases", "every"])
def test_eases_that_no_mesh_can_be_cut_with_are_not_kept(spoilt, capsys, monkeypatch):
    """They are left for the style's own; that has edges as long as it can be cut with, else it is refused."""
    told, hung = Tshirt(), Tshirt(ease=0.01)

    def make(family: Tshirt, body: BodyModel) -> Garment:
        if family.ease == hung.ease or family.edge_length > 0.0201 or spoilt == "every":
            raise too_sharp(family.edge_length)
        return users_square(5)

    monkeypatch.setattr("caphy.register.hanging.hung_style", lambda *_: hung)
    monkeypatch.setattr("caphy.register.girth.Sheet.of", lambda *_: None)
    monkeypatch.setattr("caphy.garment.families.make", make)
    choice, model, target = Choice(told, 0.01, 300, ()), Model(0.2), SimpleNamespace(kind="upper")
    figure = Figure.of(default_body())
    if spoilt == "every":
        with pytest.raises(CaphyError, match=r"too sharply for edges of 20\.5 mm"):
            _hung(choice, figure, [target], [], model, None, Kept())
        return
    style, garment = _hung(choice, figure, [target], [], model, None, Kept())
    assert replace(style, edge_length=told.edge_length) == told and 0.019 < style.edge_length < 0.0201
    assert garment.name == users_square(5).name
    assert "the upper garment is cut without being hung: the cut turns" in capsys.readouterr().out
