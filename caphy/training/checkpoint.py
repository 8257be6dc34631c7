"""The whole state of a training in one file, so that what goes on after it is what would have gone on without it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from caphy.errors import CaphyError
from caphy.io.training_folder import CHECKPOINT
from caphy.network.files import read_tensors, write_tensors

FORMAT = "caphy-training-2"


def save_checkpoint(
    folder: Path,
    modules: Mapping[str, nn.Module],
    optimizer: Optimizer,
    streams: Mapping[str, Tensor],
    progress: Mapping[str, object],
) -> None:
    """Write ``checkpoint.safetensors`` atomically: modules, optimizer, torch's random state, streams, progress."""
    tensors = {f"{name}.{key}": value for name, m in modules.items() for key, value in m.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{key}": value for key, value in state.items()}
    tensors |= {f"streams.{key}": value for key, value in streams.items()}
    tensors["random"] = torch.get_rng_state()
    header = {"format": FORMAT, **progress}
    write_tensors(folder / CHECKPOINT, {k: v.detach().cpu().clone() for k, v in tensors.items()}, header)


def load_checkpoint(
    folder: Path, modules: Mapping[str, nn.Module], optimizer: Optimizer
) -> tuple[dict[str, Tensor], dict]:
    """Restore modules, optimizer and random state in place; returns the streams' tensors and the progress.

    Raises
        CaphyError: if the file is missing or damaged, or belongs to another garment or network.
    """
    path = folder / CHECKPOINT
    tensors, header = read_tensors(path, FORMAT, "a training checkpoint; without one, train without --resume")
    try:
        for name, module in modules.items():
            module.load_state_dict(_under(tensors, name))
        saved = optimizer.state_dict()
        for key, value in _under(tensors, "optimizer").items():
            index, field = key.split(".")
            saved["state"].setdefault(int(index), {})[field] = value
        optimizer.load_state_dict(saved)
        torch.set_rng_state(tensors["random"])
    except (KeyError, RuntimeError, ValueError) as error:
        raise CaphyError(
            f"{path}: does not fit this garment and network ({error}); give the garment it was trained on, "
            "or another folder with -o"
        ) from error
    return _under(tensors, "streams"), header


def _under(tensors: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    prefix = f"{name}."
    return {key[len(prefix) :]: value for key, value in tensors.items() if key.startswith(prefix)}
