"""``caphy garment``, as a user types it."""

from __future__ import annotations

from caphy.cli import main
from caphy.garment.template import Garment


def test_make_info_check_render(tmp_path, capsys):
    npz, png = tmp_path / "shorts.npz", tmp_path / "shorts.png"
    assert main(["garment", "make", "shorts", "--leg", "0.2", "--edge-length", "0.035", "-o", str(npz)]) == 0
    garment = Garment.load(npz)
    assert garment.provenance["leg"] == "0.2" and garment.name == "shorts"
    assert main(["garment", "info", str(npz)]) == 0
    assert "leg_left" in capsys.readouterr().out
    assert main(["garment", "render", str(npz), "-o", str(png)]) == 0
    assert png.stat().st_size > 5000


def test_what_the_user_can_put_right_has_status_two_and_no_traceback(tmp_path, capsys):
    assert main(["garment", "make", "tshirt", "--sleeve", "3", "-o", str(tmp_path / "x.npz")]) == 2
    assert "sleeve must lie between" in capsys.readouterr().err
    assert main(["garment", "check", str(tmp_path / "none.obj")]) == 2
    assert "no such file" in capsys.readouterr().err
