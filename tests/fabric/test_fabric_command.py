"""``caphy fabric`` on a small run's folder: what it writes, and what it refuses."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks._panel import Stills, frame, panel, turns
from caphy.cli import main
from caphy.commands.fabric import _training
from caphy.effects.model import Model
from caphy.effects.presets import fabric_model, snug_model
from caphy.errors import CaphyError
from caphy.fabric.curves import STRAINS, bending, figures, tension
from caphy.garment.template import write_npz
from caphy.register.points import FOLDER, ScanPoints
from caphy.register.subject import SUBJECT_BODY, body_arrays

SIDE = 6


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run whose upper garment is a panel, with four scans, one of them without cloth."""
    folder = tmp_path_factory.mktemp("run")
    write_npz(folder / SUBJECT_BODY, body_arrays(frame()))
    panel(SIDE).save(folder / "upper.npz")
    stills = Stills(fabric_model("white-swim-solid"), SIDE, turns(4, 5), 5)
    nothing = np.zeros((0, 3), np.float32)
    names = []
    for worn in stills.scans(panel(SIDE), 0.0005, spacing=0.015):
        still = worn.still
        points = still.points.astype(np.float32)
        ScanPoints(still.name, nothing, points, nothing, still.pose, still.transl).save(folder / FOLDER)
        names.append(still.name)
    ScanPoints("bare", nothing, nothing, nothing, still.pose, still.transl).save(folder / FOLDER)
    (folder / "split.json").write_text(json.dumps({"train": [*names, "bare"], "held_out": []}))
    return folder


def test_it_writes_a_model_to_train_with_a_record_and_a_page(run, capsys):
    start = ["--fabric", "tango-red-jet-set", "--upper-density", "0.204"]
    assert main(["fabric", str(run), *start, "--rounds", "2", "--mesh-corrections", "0"]) == 0
    told = capsys.readouterr().out
    assert "left out: bare" in told
    assert f"next: caphy train {run / 'upper.npz'}" in told and f"--model {run / 'fabric_upper.json'}" in told
    model = Model.load(run / "fabric_upper.json")
    assert model == Model.load(run / "fabric.json")  # of a single garment the record is a model as well
    assert model.density == 0.204
    document = json.loads((run / "fabric.json").read_text())["garments"]["upper"]
    told_of = [name for name, row in document["stiffness"].items() if row["interval"] is not None]
    fitted = f"{' and '.join(told_of)} fitted to scans at rest" if told_of else "scans at rest determined nothing"
    assert model.history[-1].note == fitted
    assert document["left_out"] == {"bare": "shows only 0 points of the upper garment"}
    assert document["scans"] == 4 and len(document["rounds"]) == 2
    assert len(document["numbers"]) == 39
    assert set(document["stiffness"]) == {"strain_measured", "bending_measured"}
    for row in document["stiffness"].values():
        assert row["interval"] is None or row["interval"][0] < row["over_the_start"] < row["interval"][1]
    page = (run / "fabric.html").read_text()
    assert page.count("<svg") == 4 and "NaN" not in page and "nan" not in page


def test_what_comes_next_goes_on_from_the_run_s_training_on_its_motions(tmp_path):
    """Its folder is taken once ``caphy fit`` has been there."""
    assert _training(tmp_path, "upper").endswith(f"-o {tmp_path / 'fabric' / 'upper'}")
    for folder in ("train", "fabric"):
        (tmp_path / folder / "upper").mkdir(parents=True)
        (tmp_path / folder / "upper" / "options.json").write_text(json.dumps({"poses": ["../../motions"]}))
        (tmp_path / folder / "upper" / "network.safetensors").touch()
    told = _training(tmp_path, "upper")
    assert told.startswith(f"caphy train {tmp_path / 'upper.npz'} {tmp_path / 'motions'} --scans {tmp_path}")
    assert told.endswith(f"--init {tmp_path / 'train' / 'upper'} -o {tmp_path / 'again' / 'upper'}")


def test_one_garment_at_a_time_is_told_as_both(run, tmp_path, monkeypatch, capsys):
    """Of the other garment what is known stays, as long as its model is there."""
    folder = Path(shutil.copytree(run, tmp_path / "run"))
    panel(SIDE).save(folder / "lower.npz")
    for name in ("fabric.json", "fabric_upper.json"):
        (folder / name).unlink(missing_ok=True)

    def fit(options, base, subject, points, kind, kept):
        found = {"stiffness": {}, "scans": 3, "rounds": [], "settled": True, "model": json.loads(base.to_json())}
        return found | {"objective": options.objective}, base, base

    def fitted(*options: str) -> dict[str, str]:
        assert main(["fabric", str(folder), *options]) == 0
        told = json.loads((folder / "fabric.json").read_text())
        return {kind: found["objective"] for kind, found in told["garments"].items()}

    monkeypatch.setattr("caphy.commands.fabric._fit", fit)
    assert fitted("--garments", "upper") == {"upper": "response"}
    capsys.readouterr()
    assert fitted("--garments", "lower", "--objective", "force") == {"upper": "response", "lower": "force"}
    assert "upper.npz" not in capsys.readouterr().out  # nothing new to train it under
    assert "effects" not in json.loads((folder / "fabric.json").read_text())  # two garments are no single model
    (folder / "fabric_upper.json").unlink()
    assert fitted("--garments", "lower") == {"lower": "response"}
    (folder / "lower.npz").unlink()
    assert fitted() == {"upper": "response"}  # the lower one was asked for, and is not worn
    (folder / "fabric.json").write_text("{}")
    panel(SIDE).save(folder / "lower.npz")
    assert fitted("--garments", "lower") == {"lower": "response"}
    assert "what it said of the upper garment is lost; do it again" in capsys.readouterr().out


def test_a_garment_that_cannot_be_fitted_again_leaves_no_older_fabric(run, tmp_path, monkeypatch):
    """Its model would lie beside a record that does not tell of it; what failed is told until it is done again."""
    folder = Path(shutil.copytree(run, tmp_path / "run"))
    panel(SIDE).save(folder / "lower.npz")
    fits, fails = [], set()

    def fit(options, base, subject, points, kind, kept):
        fits.append(kind)
        if kind in fails:
            raise CaphyError("three scans are needed")
        found = {"stiffness": {}, "scans": 3, "rounds": [], "settled": True, "model": json.loads(base.to_json())}
        return found, base, base

    def fitted(code: int, *options: str) -> tuple[list[str], dict[str, str]]:
        assert main(["fabric", str(folder), *options]) == code
        told = json.loads((folder / "fabric.json").read_text())
        assert sorted(told["garments"]) == sorted(path.stem[7:] for path in folder.glob("fabric_*.json"))
        return sorted(told["garments"]), told["failed"]

    monkeypatch.setattr("caphy.commands.fabric._fit", fit)
    assert fitted(0) == (["lower", "upper"], {})
    fails.add("lower")
    assert fitted(1) == (["upper"], {"lower": "three scans are needed"})
    fits.clear()
    assert fitted(0, "--garments", "upper", "upper") == (["upper"], {"lower": "three scans are needed"})
    assert fits == ["upper"]
    fails.clear()
    assert fitted(0, "--garments", "lower") == (["lower", "upper"], {})


@pytest.mark.parametrize(("along", "sign"), [("weft", 1), ("warp", -1)])
def test_curves_show_all_that_acts_in_the_plane_and_in_folds(along, sign):
    """By hand: fibres k G, stiffening k G^3 with G the Green strain, and as many more uN m in all directions."""
    plain = snug_model()
    model = plain.with_effect("weft_warp_stiffness", weft=20.0, warp=5.0)
    model = model.with_effect("strain_stiffening", stiffness=2000.0)
    green = STRAINS + STRAINS**2 / 2
    added = (1 + STRAINS) * ((20.0 if along == "weft" else 5.0) * green + 2000.0 * green**3)
    np.testing.assert_allclose(tension(model, along) - tension(plain, along), added, atol=1e-5)
    stiffness = plain.effects["bending"][f"stiffness_{along}"]
    model = plain.with_effect("extra_bending", stiffness=3e-5).with_effect("bending_anisotropy", difference=1e-5)
    np.testing.assert_allclose(bending(model, along), stiffness + 3e-5 + sign * 1e-5)
    shown = figures({"start": plain, "found": model.with_effect("natural_curvature", weft=5.0, warp=5.0)})
    assert ["without natural_curvature" in figure for figure in shown] == [False, False, True, True]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--upper-density", "0"], "kg/m"),
        (["--rounds", "0"], "at least 1"),
        (["--fabric", "sackcloth"], "sackcloth"),
        (["--model", "nowhere.json"], "nowhere.json"),
    ],
)
def test_bad_options_are_refused(run, capsys, options, told):
    assert main(["fabric", str(run), *options]) == 2
    assert told in capsys.readouterr().err
    assert not (run / "fabric_lower.json").exists()


def test_alternations_that_cannot_be_are_refused_before_any_round(run, tmp_path, capsys, monkeypatch):
    """Rounds take hours; RUN/fabric of 'caphy fit' holds other trainings."""
    monkeypatch.setattr("caphy.fabric.rounds.fit_fabric", None)
    shutil.copytree(run, tmp_path / "run")
    trained, other = tmp_path / "run" / "train" / "upper", tmp_path / "run" / "fabric" / "upper"
    arguments = ["fabric", str(tmp_path / "run"), "--alternations", "1"]
    assert main(arguments) == 2
    assert "--alternations trains on what 'caphy train' wrote there" in capsys.readouterr().err
    for folder in (trained, other):
        folder.mkdir(parents=True)
        for name in ("options.json", "run.json", "checkpoint.safetensors"):
            (folder / name).write_text("{}")
    assert main(arguments) == 2
    assert f"{other}: holds a training that was not begun so" in capsys.readouterr().err


def test_a_folder_that_is_no_run_is_refused(tmp_path, capsys):
    assert main(["fabric", str(tmp_path)]) == 2
    assert "caphy register" in capsys.readouterr().err
