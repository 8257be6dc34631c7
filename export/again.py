"""A bundle's garments as today's graphs, without the trainings they came from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.errors import CaphyError
from caphy.io.blend_shapes import blend_shapes
from caphy.io.bundle import AvatarBundle, BundledGarment
from caphy.io.onnx_wire import read_graph
from caphy.network.from_graph import network_of
from export.garment_graph import garment_graph
from export.head import Head
from export.parity import Parity, check_parity


def exported_again(bundle: AvatarBundle) -> tuple[AvatarBundle, dict[str, Parity]]:
    """The bundle with each garment's graph made anew from the weights that the old one holds, and how near they are.

    The GRU's weights and the head's two factors are taken over bit by bit, so the answers differ by rounding only.
    Raises CaphyError where a graph is not one that ``caphy export`` writes, or the new one does not answer as it did.
    """
    found, parities, metrics = [], {}, dict(bundle.metrics)
    for garment in bundle.garments:
        network = network_of(garment, bundle.joints, bundle.fps)
        head = head_of(garment)
        content = garment_graph(network, head, garment.name).SerializeToString()
        parities[garment.name] = check_parity(content, network)
        metrics[garment.name] = {**metrics.get(garment.name, {}), **parities[garment.name].metrics()}
        found.append(replace(garment, onnx=content))
    return replace(bundle, garments=tuple(found), metrics=metrics), parities


def head_of(garment: BundledGarment) -> Head:
    """The head that a garment's graph holds."""
    shapes = blend_shapes(garment)
    graph = read_graph(garment.onnx)
    reduce = [
        graph.constants[node.inputs[1]]
        for node in graph.nodes
        if shapes.tensor in node.outputs and node.kind == "MatMul" and node.inputs[1] in graph.constants
    ]
    if not reduce:
        raise CaphyError(f"garment {garment.name!r}: its graph is not one that 'caphy export' writes; train it again")
    expand = shapes.targets.reshape(len(shapes.targets), -1).T
    bias = (shapes.base - garment.mesh.vertices).ravel()
    return Head(expand, reduce[0].T.astype(np.float64), bias)
