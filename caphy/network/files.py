"""A trained garment network as one safetensors file: arrays, and in its header what cannot be an array."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from caphy.errors import CaphyError
from caphy.io.places import new_file
from caphy.network.garment_network import GarmentNetwork

FORMAT = "caphy-network-1"


def save_network(network: GarmentNetwork, path: Path) -> None:
    """Write a network atomically, on the CPU and in float32."""
    header = {
        "format": FORMAT,
        "fps": network.fps,
        "driving": network.driving,
        "layers": network.gru.num_layers,
        "width": network.gru.hidden_size,
    }
    write_tensors(path, {k: v.float().cpu() for k, v in network.state_dict().items()}, header)


def load_network(path: Path) -> GarmentNetwork:
    """Read what :func:`save_network` wrote.

    Raises
        CaphyError: if the file is missing, damaged or not a network.
    """
    tensors, header = read_tensors(path, FORMAT, "a garment network; 'caphy train' writes one")
    try:
        network = GarmentNetwork(
            *(tensors[name].numpy() for name in ("template", "weights", "joints")),
            fps=header["fps"],
            driving=header["driving"],
            layers=header["layers"],
            width=header["width"],
        )
        network.load_state_dict(tensors)
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise CaphyError(f"{path}: its arrays do not fit together as a garment network: {error}") from error
    return network.eval()


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, object]) -> None:
    """Write tensors and a JSON header as safetensors, so that a reader, or a power cut, never sees half a file."""
    content = save({k: v.contiguous() for k, v in tensors.items()}, {"caphy": json.dumps(header)})
    with new_file(path) as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def read_tensors(path: Path, form: str, what: str) -> tuple[dict[str, Tensor], dict]:
    """Tensors and header of a file of format ``form``; ``what`` says in errors what it must be.

    Raises
        CaphyError: if the file is missing, damaged or of another format.
    """
    if not path.is_file():
        raise CaphyError(f"{path}: there is no such file; it must be {what}")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("caphy", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, ValueError, OSError) as error:
        raise CaphyError(f"{path}: damaged, or not {what} ({error})") from error
    if header.get("format") != form:
        raise CaphyError(f"{path}: must be {what}, of format {form!r}, got {header.get('format')!r}")
    if not all(torch.isfinite(tensor).all() for tensor in tensors.values() if tensor.is_floating_point()):
        raise CaphyError(f"{path}: holds values that are not finite; take an earlier copy or train again")
    return tensors, header
