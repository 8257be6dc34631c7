"""``caphy fit`` from a small rig's scans, some of them bad, to an avatar; killed in the middle it ends the same."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from quick_fit import OPTIONS, hurry
from small_session import small_session

from caphy.cli import main
from caphy.commands import fit_stages
from caphy.commands.fit_scans import cloth_shares, left_out, segment_scans
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.evaluate.dressed import Subject
from caphy.io.bundle import read_bundle
from caphy.io.poses.canonical import write_poses
from caphy.io.procedural import procedural_motion
from caphy.network.files import load_network
from caphy.scan.scan_set import ScanSet, write_scan_set

GOOD = ("scan_000", "scan_001", "scan_002", "scan_003")
REASONS = {
    "empty": "its labels are empty.*caphy segment",
    "flipped": "face inward.*flip its normals",
    "millimetres": 'try unit = "mm"',
    "naked": "shows no clothes",
    "nan": r"nan\.ply: vertices must be finite.*Remove them",
    "stranger": "shares only .* of its colours.*another person",
}


def _bad(scan):
    """What can be wrong with a scan."""
    yield replace(scan, name="empty", labels=np.full_like(scan.labels, 255))
    yield replace(scan, name="flipped", faces=scan.faces[:, ::-1].copy())
    yield replace(scan, name="millimetres", vertices=1000 * scan.vertices)
    yield replace(scan, name="naked", labels=np.zeros_like(scan.labels))
    yield replace(scan, name="stranger", colours=np.full_like(scan.colours, (10, 250, 30)))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder with scans, good and bad, and short motions."""
    folder, session = tmp_path_factory.mktemp("fit"), small_session()
    given = ScanSet.read(session / "scans")
    scans = []
    for name in GOOD:
        labels = np.load(session / "truth" / "stills" / f"{name}.npz")["labels"]
        scans.append(given[given.names.index(name)].with_labels(labels))
    scans += list(_bad(scans[2]))
    poisoned = replace(scans[3], name="nan")
    names = sorted([scan.name for scan in scans] + ["nan"])
    order = [given.names.index(name) if name in GOOD else 2 for name in names]
    poses = replace(given.poses, poses=given.poses.poses[order], transl=given.poses.transl[order])
    write_scan_set(folder / "scans", [*scans, poisoned], "somebody", poses)
    _poison(folder / "scans" / "nan.ply", len(poisoned.vertices))
    (folder / "motions").mkdir()
    for seed in (0, 1):
        write_poses(procedural_motion(seed, 1.0, 30.0), folder / "motions" / f"{seed}.npz")
    return folder


def _poison(path: Path, count: int) -> None:
    """Make the first vertex of a binary PLY not a number."""
    content = bytearray(path.read_bytes())
    start = content.index(b"end_header\n") + len(b"end_header\n")
    assert f"element vertex {count}".encode() in content[:start]
    content[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(content)


@pytest.fixture(scope="module")
def finished(world):
    """The folder of a run that was not disturbed, and its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        hurry(patch.setattr)
        status = main(
            ["fit", str(world / "scans"), "-o", str(world / "run"), "--poses", str(world / "motions"), *OPTIONS]
        )
    return world / "run", status


def test_it_ends_with_an_avatar_and_a_page(finished):
    run, status = finished
    assert status == 0
    bundle = read_bundle(run / "avatar")
    assert sorted(garment.name for garment in bundle.garments) == ["shorts", "tshirt"]
    page = (run / "report.html").read_text()
    assert "4 of 10 scans became an avatar that wears" in page
    assert page.count("data:image/png;base64,") >= 4
    assert not re.search(r'(?:src|href)="(?!data:)', page)  # nothing from elsewhere


def test_the_fabric_that_was_found_is_trained_with(finished):
    run, _ = finished
    start, found = (Model.load(run / folder / "upper" / "model.json") for folder in ("train", "collided"))
    ratio = found.effects["bending_measured"]["bending"] / start.effects["bending_measured"]["bending"]
    assert ratio == pytest.approx(0.5)
    assert "0.40 to 0.60" in (run / "report.html").read_text()


def test_every_bad_scan_is_named_with_a_remedy_and_the_rest_goes_on(finished):
    run, _ = finished
    reasons = left_out(run)
    assert sorted(reasons) == sorted(REASONS)
    page = (run / "report.html").read_text()
    for name, reason in REASONS.items():
        assert re.search(reason, reasons[name], re.DOTALL), reasons[name]
        assert f'<th scope="row">{name}</th>' in page
    assert sorted(json.loads((run / "body.json").read_text())["scans"]) == list(GOOD)


def test_only_held_out_scans_are_evaluated(finished):
    run, _ = finished
    split = json.loads((run / "split.json").read_text())
    evaluation = json.loads((run / "evaluation.json").read_text())
    assert list(evaluation["scans"]) == split["held_out"] and not set(split["held_out"]) & set(split["train"])
    chosen_by = [found["scans"] for found in json.loads((run / "garments.json").read_text()).values()]
    assert len(chosen_by) == 2 and all(set(scans) == set(split["train"]) for scans in chosen_by)
    rows = {row["name"]: row for row in evaluation["rows"]}
    template = rows["skinned template"]["all"]
    assert 0 < template["mean_mm"]["mean"] <= template["clothes_chamfer_mm"]["mean"] < 30
    assert rows["SNUG"]["missing"] and not rows["SNUG"]["all"]
    assert rows["ours"]["all"] and rows["ours without optimised physics"]["all"]
    assert rows["avatar"]["all"] == rows["ours"]["all"] and list(rows["avatar"]["scans"]) == [str(run / "collided")]
    assert (run / "evaluation" / f"{split['held_out'][0]}.png").stat().st_size > 10_000


def test_run_again_nothing_is_done_again(finished, world, capsys):
    run, _ = finished
    stamps = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}
    again = ["fit", str(world / "scans"), "-o", str(run), "--poses", str(world / "motions"), *OPTIONS]
    assert main(again) == 0
    told = capsys.readouterr().out
    assert told.count("done before") == told.count("] ") and "caphy serve --avatars" in told
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()} == stamps


def test_killed_in_training_it_ends_the_same(finished, world):
    run, _ = finished
    broken = world / "broken"
    shutil.copytree(run, broken)
    for name in ("train", "fabric", "refine", "collide", "export", "evaluate", "report"):
        (broken / "stages" / f"{name}.json").unlink()
    for name in ("train", "fabric", "collided", "avatar", "evaluation"):
        shutil.rmtree(broken / name)
    for name in ("fabric.json", "evaluation.json", "evaluation.txt", "report.html"):
        (broken / name).unlink()
    script = [sys.executable, str(Path(__file__).with_name("quick_fit.py")), str(world / "scans"), "-o", str(broken)]
    command = [*script, "--poses", str(world / "motions")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            reached, deadline = broken / "train" / "lower" / "network.safetensors", time.monotonic() + 600
            while not reached.exists() and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.01)
        finally:
            process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert reached.exists() and not (broken / "avatar").exists()
    with pytest.MonkeyPatch.context() as patch:
        hurry(patch.setattr)
        assert main(["fit", str(world / "scans"), "-o", str(broken), "--poses", str(world / "motions"), *OPTIONS]) == 0
    for kind in ("upper", "lower"):
        one, two = (load_network(folder / "collided" / kind / "network.safetensors") for folder in (run, broken))
        for name, value in one.state_dict().items():
            assert np.array_equal(value.numpy(), two.state_dict()[name].numpy()), name
    one, two = (json.loads((folder / "evaluation.json").read_text()) for folder in (run, broken))
    assert one["rows"][-1]["all"] == two["rows"][-1]["all"]


def test_where_collisions_fail_the_avatar_is_made_of_what_was_before_them(finished, tmp_path, monkeypatch):
    """Epochs before the failure have left networks, which are no result."""
    run, _ = finished
    for name in ("fabric", "collided"):
        shutil.copytree(run / name, tmp_path / name)
    shutil.copy(run / "segment.json", tmp_path)
    assert [folder.parent.name for folder in fit_stages.final(tmp_path)] == ["collided", "collided"]

    def fail(name, *_words):
        raise CaphyError(f"caphy {name}: step 3: not finite")

    monkeypatch.setattr(fit_stages, "_command", fail)
    given = dict.fromkeys(field.name for field in fields(fit_stages.Plan))
    with pytest.raises(CaphyError, match="not finite"):
        fit_stages._collide(fit_stages.Plan(**{**given, "run": tmp_path, "collision_epochs": 1, "seed": 0}))
    assert [folder.parent.name for folder in fit_stages.final(tmp_path)] == ["fabric", "fabric"]
    assert (tmp_path / "collided" / "checkpoint.safetensors").is_file()


def test_a_scan_that_turns_out_to_show_no_clothes_is_left_out(finished, world, tmp_path):
    """Colours are believed first; that a scan shows no clothes is known only once it is segmented."""
    run, _ = finished
    for name in ("scans", "labels"):
        shutil.copytree(run / name, tmp_path / name)
    labels = tmp_path / "labels" / "scan_001.npy"
    np.save(labels, np.zeros_like(np.load(labels)))
    segment_scans(tmp_path, None, "schp-atr")
    found = json.loads((tmp_path / "segment.json").read_text())
    assert list(found["left_out"]) == ["scan_001"] and "shows no clothes" in found["left_out"]["scan_001"]
    assert found["kinds"] == ["upper", "lower"] and not labels.exists()
    scan = ScanSet.read(tmp_path / "scans", tmp_path / "labels")[0]
    assert min(cloth_shares(scan).values()) > 0.05


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--minutes", "0"), "--minutes must be positive"),
        (("--fabric", "chainmail"), "no measured fabric 'chainmail'"),
        (("--poses", "nowhere"), "nowhere: there is no such file or folder"),
        (("--body", "mine.npz"), "needs its licence in words"),
        (("--body", "mine.npz", "--licence", "mine"), "there is no such body model file"),
        (("--parser", "color"), "--parser must be colour, labels, or the file of an ONNX human parser"),
        (("--layout", "nonsense"), "neither a known label layout"),
        (("--layout", "schp-lip"), "give that with --parser"),
        (("--vgg", __file__), "holds no weights that can be read"),
    ],
)
def test_bad_options_are_refused_before_anything_is_done(world, tmp_path, capsys, arguments, message):
    assert main(["fit", str(world / "scans"), "-o", str(tmp_path / "run"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_run_within_the_scans_is_refused(world, capsys):
    assert main(["fit", str(world / "scans"), "-o", str(world / "scans" / "run")]) == 2
    assert "must not lie within the folder of the scans" in capsys.readouterr().err


def test_motions_that_hold_the_run_are_refused(world, tmp_path, capsys):
    """Its own files would be taken for motions, and be others at every start."""
    run = tmp_path / "run"
    assert main(["fit", str(world / "scans"), "-o", str(run), "--poses", str(tmp_path), *OPTIONS]) == 2
    assert "must not hold the folder of the run" in capsys.readouterr().err and not run.exists()


def test_scans_where_the_run_puts_its_own_are_refused_and_kept(world, tmp_path, capsys):
    shutil.copytree(world / "scans", tmp_path / "scans")
    before = sorted(path.name for path in (tmp_path / "scans").iterdir())
    assert main(["fit", str(tmp_path / "scans"), "-o", str(tmp_path), *OPTIONS]) == 2
    assert "give another folder" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "scans").iterdir()) == before


def test_a_whole_set_in_the_wrong_unit_is_told_which_would_fit(world, tmp_path, capsys):
    (tmp_path / "scans").mkdir()
    shutil.copy(world / "scans" / "millimetres.ply", tmp_path / "scans")
    (tmp_path / "scans" / "scans.toml").write_text('unit = "m"\nup_axis = "y"\n')
    assert main(["fit", str(tmp_path / "scans"), "-o", str(tmp_path / "run")]) == 2
    told = capsys.readouterr().err
    assert 'try unit = "mm"' in told and "millimetres" in told and "stage check" in told
    assert os.listdir(tmp_path / "run") == ["stages"]


def test_an_avatar_is_a_row_like_the_networks_it_was_made_of(finished, tmp_path, capsys):
    run, _ = finished
    for name in ("upper.npz", "lower.npz", "subject_body.npz", "split.json"):
        shutil.copy(run / name, tmp_path)
    shutil.copytree(run / "points", tmp_path / "points")
    (scan,) = json.loads((run / "split.json").read_text())["held_out"]
    (tmp_path / "classes.json").write_text(json.dumps({scan: "standing"}))
    rows = [word for row in ("collided", "avatar") for word in ("--row", f"{row}={run / row}")]
    labels, classes = run / "labels", tmp_path / "classes.json"
    command = ["evaluate", str(run / "scans"), "-o", str(tmp_path), "--labels", str(labels), "--classes", str(classes)]
    assert main([*command, *rows, "--pictures", "0"]) == 0
    assert "standing (1;" in capsys.readouterr().out
    document = json.loads((tmp_path / "evaluation.json").read_text())
    one, two = (row["all"] for row in document["rows"] if row["name"] in ("collided", "avatar"))
    assert one["clothes_chamfer_mm"]["mean"] == pytest.approx(two["clothes_chamfer_mm"]["mean"], abs=0.1)
    assert one["clothes_chamfer_mm"]["mean"] != document["rows"][0]["all"]["clothes_chamfer_mm"]["mean"]


def test_networks_of_another_subject_are_refused(finished, tmp_path):
    run, _ = finished
    for kind, other in (("upper", "lower"), ("lower", "upper")):
        shutil.copytree(run / "collided" / other, tmp_path / kind)
    with pytest.raises(CaphyError, match="was trained on another template"):
        Subject.read(run).wearing(tmp_path)


def test_weights_that_are_not_there_are_refused(finished, capsys):
    run, _ = finished
    given = ["evaluate", str(run / "scans"), "-o", str(run), "--labels", str(run / "labels")]
    assert main([*given, "--vgg", "none.pth"]) == 2
    assert "none.pth: there is no such file" in capsys.readouterr().err
    assert main([*given[:2], "-o", str(run / "scans"), "--labels", str(run / "labels")]) == 2
    assert "split.json" in capsys.readouterr().err
