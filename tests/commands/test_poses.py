"""``caphy poses`` from the outside."""

import subprocess
import sys

import numpy as np
import pytest

from caphy.cli import main
from caphy.io.poses import PoseSequence, read_poses, write_poses
from caphy.io.procedural import procedural_motion


@pytest.fixture
def clip(tmp_path):
    path = tmp_path / "walk.npz"
    write_poses(procedural_motion(1, 2.0, 30.0), path)
    return path


def test_info_prints_the_facts_and_the_assumptions(clip, capsys):
    assert main(["poses", "info", str(clip)]) == 0
    out = capsys.readouterr().out
    head, row, *rest = out.splitlines()
    assert head.split()[:4] == ["file", "frames", "fps", "seconds"]
    assert row.split()[:4] == ["walk.npz", "61", "30", "2.00"]
    assert "world, y up" in row
    assert any("made by formula" in line for line in rest)


def test_info_says_what_it_can_of_the_others(clip, tmp_path, capsys):
    (tmp_path / "bad.npz").write_bytes(b"nothing")
    assert main(["poses", "info", str(tmp_path / "bad.npz"), str(clip)]) == 2
    said = capsys.readouterr()
    assert said.out.splitlines()[1].split()[:2] == ["walk.npz", "61"] and "bad.npz" in said.err


def test_info_names_jumps(tmp_path, capsys):
    poses = np.zeros((4, 55, 3))
    poses[2:, 18, 1] = 2.5
    write_poses(PoseSequence(poses, np.zeros((4, 3)), 30.0), tmp_path / "j.npz")
    assert main(["poses", "info", str(tmp_path / "j.npz")]) == 0
    assert "frame 2: left_elbow moves at 75 rad/s" in capsys.readouterr().out


def test_convert_resamples_and_turns(clip, tmp_path, capsys):
    assert main(["poses", "convert", str(clip), "--out", str(tmp_path / "o"), "--resample", "60", "--z-up"]) == 0
    assert "121 frames at 60 fps" in capsys.readouterr().out
    back = read_poses(tmp_path / "o" / "walk.npz")  # reading turns y up again
    np.testing.assert_allclose(back.transl[::2], read_poses(clip).transl, atol=1e-9)
    with np.load(tmp_path / "o" / "walk.npz") as file:
        assert '"up_axis": "z"' in str(file["header"])


def test_convert_does_not_overwrite_its_source(clip, capsys):
    before = clip.read_bytes()
    assert main(["poses", "convert", str(clip), "--out", str(clip.parent)]) == 2
    assert "is read, and would be replaced" in capsys.readouterr().err
    assert clip.read_bytes() == before


def test_render_writes_a_picture(clip, tmp_path):
    import cv2

    out = tmp_path / "sheet.png"
    assert main(["poses", "render", str(clip), "--out", str(out), "--frames", "3", "--size", "96"]) == 0
    image = cv2.imread(str(out))
    assert image.shape[1] == 3 * 96
    assert image[:96].std() > 10  # there is something to see


def test_render_overwrites_no_motion_and_writes_no_picture_under_another_name(clip, tmp_path, capsys):
    before = clip.read_bytes()
    named = clip.rename(clip.with_suffix(".png"))
    assert main(["poses", "render", str(named), "--out", str(named)]) == 2
    assert f"{named}: is read, and would be replaced" in capsys.readouterr().err
    named.rename(clip)
    assert main(["poses", "render", str(clip), "--out", str(clip)]) == 2
    assert "must end in .png" in capsys.readouterr().err
    assert clip.read_bytes() == before
    for name in ("sheet.jpg", "sheet", "other.npz"):
        assert main(["poses", "render", str(clip), "--out", str(tmp_path / name)]) == 2
        assert "must end in .png" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [clip]


@pytest.mark.parametrize("rate", ["0", "nan", "1e9", "-30"])
def test_rates_that_none_can_be_resampled_to_are_refused_by_their_name(clip, tmp_path, capsys, rate):
    assert main(["poses", "convert", str(clip), "--out", str(tmp_path / "o"), f"--resample={rate}"]) == 2
    said = capsys.readouterr().err
    assert "got" in said and "--resample RATE" in said and "--fps" not in said


def test_errors_are_one_line_and_status_two(tmp_path, capsys):
    assert main(["poses", "info", str(tmp_path / "none.bvh")]) == 2
    assert capsys.readouterr().err.strip() == f"caphy poses: {tmp_path / 'none.bvh'}: no such file"


def test_reading_poses_needs_neither_torch_nor_scipy():
    code = (
        "import sys; import caphy.io.poses, caphy.io.poses.cmu, caphy.io.procedural, caphy.io.pickles, "
        "caphy.io.poses.wham, caphy.io.poses.gvhmr, caphy.io.poses.smplerx; "
        "caphy.io.procedural.procedural_motion(0, 1.0); "
        "print([m for m in ('torch', 'scipy', 'joblib') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_what_cannot_be_read_leaves_no_folder(tmp_path, capsys):
    for words in (["poses", "condition"], ["poses", "convert"], ["demo"]):
        assert main([*words, str(tmp_path / "nope.bvh"), "--out", str(tmp_path / "new")]) == 2
        assert "no such file" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (["--azimuth", "nan"], "--azimuth must be finite"),
        (["--frames", "200", "--size", "4000"], "fewer --frames or a smaller --size"),
    ],
)
def test_pictures_that_are_none_or_too_large_are_refused(clip, tmp_path, capsys, asked, says):
    assert main(["poses", "render", str(clip), *asked, "--out", str(tmp_path / "a.png")]) == 2
    assert says in capsys.readouterr().err


def test_a_folder_of_motions_is_no_motion(clip, capsys):
    for rate in ([], ["--fps", "30"]):
        assert main(["poses", "info", str(clip.parent), *rate]) == 2
        assert "is a folder, and only one with a file FRAME_PERSON.npz for each frame" in capsys.readouterr().err
    clip.rename(clip.with_name("02_01.npz"))
    assert main(["poses", "info", str(clip.parent), "--fps", "30"]) == 2
    assert "name the motions in it one by one" in capsys.readouterr().err
