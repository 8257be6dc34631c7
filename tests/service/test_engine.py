"""Engines against onnxruntime called directly, and what they refuse."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from caphy.errors import CaphyError
from service.avatars import load_avatars
from service.engine import GarmentEngine


def test_chunks_do_not_show(bundle, motion):
    garment = bundle.garment("tshirt")
    inputs = {"poses": motion.poses.astype(np.float32), "transl": motion.transl.astype(np.float32)}
    engine = GarmentEngine(garment, chunk=7)
    vertices, state = engine.run(inputs["poses"], inputs["transl"], engine.initial_state())
    session = onnxruntime.InferenceSession(garment.onnx)
    expected = session.run(None, {**inputs, "state": np.zeros(garment.state_size, np.float32)})
    np.testing.assert_allclose(vertices, expected[0], atol=3e-6)
    np.testing.assert_allclose(state, expected[1], atol=1e-4)


def test_damaged_graphs_are_refused(bundle):
    garment = bundle.garment("tshirt")
    for content in (b"", b"nonsense", garment.onnx[: len(garment.onnx) // 2]):
        with pytest.raises(CaphyError, match=r"cannot load|must have"):
            GarmentEngine(replace(garment, onnx=content))


def test_graphs_of_another_interface_are_refused(bundle):
    tshirt, trousers = bundle.garments
    with pytest.raises(CaphyError, match="must have float tensors"):
        GarmentEngine(replace(tshirt, onnx=trousers.onnx))
    with pytest.raises(CaphyError, match="must have float tensors"):
        GarmentEngine(replace(tshirt, state_size=3))


def test_graphs_that_answer_nan_are_refused(bundle):
    garment = bundle.garment("tshirt")
    model = onnx.load_from_string(garment.onnx)
    for constant in model.graph.initializer:
        if constant.data_type == onnx.TensorProto.FLOAT and len(constant.dims) == 1 and constant.dims[0] > 1000:
            constant.raw_data = np.full(constant.dims[0], np.nan, np.float32).tobytes()
    with pytest.raises(CaphyError, match="not finite"):
        GarmentEngine(replace(garment, onnx=model.SerializeToString()))


def test_one_bundle_or_a_folder_of_them_by_the_name_given(avatars, tmp_path, monkeypatch):
    assert list(load_avatars(avatars, 8)) == ["shell"]
    assert list(load_avatars(avatars / "shell", 8)) == ["shell"]
    link = tmp_path / "now"
    link.symlink_to(avatars / "shell")
    assert list(load_avatars(link, 8)) == ["now"]
    monkeypatch.chdir(link)
    assert list(load_avatars(Path(), 8)) == ["shell"]


def test_the_service_imports_neither_torch_nor_what_trains():
    code = (
        "import sys, service.app, service.client, caphy.commands.serve; "
        "bad = {'torch', 'scipy', 'onnx', 'numba', 'export', 'caphy.network', 'caphy.training'} & set(sys.modules); "
        "sys.exit(str(bad) if bad else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
