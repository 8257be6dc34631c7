"""What holds for the options of a training, told by every command that ends in one before any work is done."""

from __future__ import annotations

from caphy.errors import CaphyError


def require_positive(options: object, *names: str) -> None:
    """Raise CaphyError unless the named options, where they are given, are positive and finite."""
    for name in names:
        value = getattr(options, name)
        if value is not None and not 0 < value < float("inf"):
            raise CaphyError(f"--{name.replace('_', '-')} must be positive and finite, got {value}")


def require_device(device: str, process: int = 0) -> None:
    """Raise CaphyError unless the process of that number, from 0, can train on a device."""
    if device == "cpu":
        return

    import torch

    if not torch.cuda.is_available():
        raise CaphyError(f"--device {device}: torch finds no CUDA device here; use --device cpu")
    if process >= torch.cuda.device_count():
        raise CaphyError(f"each process needs a GPU of its own: start {torch.cuda.device_count()}, not {process + 1}")
