"""What a training would refuse, ``caphy fit`` refuses before it looks at a scan."""

from __future__ import annotations

import pytest
import torch

from caphy.cli import main


@pytest.mark.parametrize(
    ("options", "gpus", "told"),
    [
        (["--minutes", "inf"], 0, "--minutes must be positive and finite, got inf"),
        (["--minutes", "nan"], 0, "--minutes must be positive and finite, got nan"),
        (["--steps", "0"], 0, "--steps must be positive and finite, got 0"),
        (["--collision-epochs", "-1"], 0, "--collision-epochs must be positive and finite, got -1"),
        (["--device", "cuda"], 0, "torch finds no CUDA device here; use --device cpu"),
        (["--device", "cuda", "--processes", "4"], 2, "each process needs a GPU of its own: start 2, not 4"),
        (["--device", "cuda", "--processes", "2"], 2, "scans.toml"),
        (["--processes", "2"], 0, "scans.toml"),
    ],
)
def test_it_is_told_at_once(options, gpus, told, tmp_path, capsys, monkeypatch):
    """Good ones lead to the scans, which are not there."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    assert main(["fit", str(tmp_path / "scans"), "-o", str(tmp_path / "run"), *options]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
