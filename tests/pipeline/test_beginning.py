"""Where the trainings of ``caphy fit`` begin: as the default avatar's garment, unless it wears nothing like theirs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from small_world import tube

import caphy.commands.fit_stages as stages

BODY = Path(stages.__file__).parents[1] / "data" / "body_medium.npz"


@pytest.mark.parametrize(("shift", "begun"), [(0.0, ["--transfer", "default"]), (0.6, [])])
def test_a_garment_like_none_is_trained_from_nothing(shift, begun, tmp_path, monkeypatch, capsys):
    shutil.copy(BODY, tmp_path / "subject_body.npz")
    garment = replace(tube(), vertices=tube().vertices + np.array([0, 0, shift]))
    garment.save(tmp_path / "lower.npz")
    told = []
    monkeypatch.setattr(stages, "_train_one", lambda *given: told.append(given))
    monkeypatch.setattr(stages, "kinds", lambda run: ["lower"])
    stages._train(SimpleNamespace(run=tmp_path, fabric="gray-interlock"))
    ((_, kind, folder, _, physics),) = told
    assert (kind, folder, physics) == ("lower", tmp_path / "train" / "lower", ["--fabric", "gray-interlock", *begun])
    assert ("trained from nothing" in capsys.readouterr().out) == (not begun)
