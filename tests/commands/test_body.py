"""``caphy body`` as a user types it."""

import cv2
import numpy as np

from caphy.body.bundled import default_body, default_body_path
from caphy.cli import main


def test_info(capsys):
    assert main(["body", "info"]) == 0
    printed = capsys.readouterr().out
    assert f"{len(default_body().v_template)}, " in printed and "at most 4" in printed


def test_info_of_a_file_that_is_no_body(tmp_path, capsys):
    np.savez(tmp_path / "other.npz", v_template=np.zeros((3, 3)))
    assert main(["body", "info", "--body", str(tmp_path / "other.npz")]) == 2
    error = capsys.readouterr().err
    assert "other.npz" in error and "'weights' is missing" in error and "Traceback" not in error


def test_render(tmp_path):
    out = tmp_path / "body.png"
    assert main(["body", "render", "--body", str(default_body_path()), "--out", str(out), "--size", "64"]) == 0
    assert cv2.imread(str(out)).shape[1] == 4 * 64


def test_a_picture_of_no_size_is_refused(tmp_path, capsys):
    assert main(["body", "render", "--size", "0", "--out", str(tmp_path / "a.png")]) == 2
    assert "--size must be at least 16, got 0" in capsys.readouterr().err
