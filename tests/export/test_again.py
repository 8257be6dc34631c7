"""A bundle exported again answers as it did, from its graphs alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import onnx
import pytest

from caphy.cli import main
from caphy.errors import CaphyError
from caphy.io.bundle import read_bundle, write_bundle
from export.again import exported_again, head_of
from service.engine import GarmentEngine


def test_answers_as_it_did(bundle, motion, served, tmp_path, capsys):
    write_bundle(bundle, tmp_path / "old")
    main(["export", str(tmp_path / "old"), "-o", str(tmp_path / "new")])
    assert "mm from the network" in capsys.readouterr().out
    again = read_bundle(tmp_path / "new")
    assert again.provenance == bundle.provenance and again.licence == bundle.licence
    poses, transl = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    for garment in again.garments:
        engine = GarmentEngine(garment)
        np.testing.assert_allclose(
            engine.run(poses, transl, engine.initial_state())[0], served[garment.name], atol=3e-6
        )
        assert {"head_rank", "parity_with_torch_mm"} <= set(again.metrics[garment.name])


def test_the_head_is_taken_over_bit_by_bit(bundle):
    again, _ = exported_again(bundle)
    for old, new in zip(bundle.garments, again.garments, strict=True):
        np.testing.assert_array_equal(head_of(old).expand, head_of(new).expand)
        np.testing.assert_array_equal(head_of(old).reduce, head_of(new).reduce)
        np.testing.assert_allclose(head_of(old).bias, head_of(new).bias, atol=1e-7)


def test_graphs_of_someone_else_are_refused(bundle):
    garment = bundle.garments[0]
    model = onnx.load_from_string(garment.onnx)
    for node in list(model.graph.node):
        if node.op_type == "GRU":
            model.graph.node.remove(node)
    with pytest.raises(CaphyError, match="caphy export"):
        exported_again(replace(bundle, garments=(replace(garment, onnx=model.SerializeToString()),)))
