"""What a GPU does every time again with other numbers: recorded once for each shape, and played from then on."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable
from weakref import WeakSet

import torch
from torch import Tensor

WARM = 2
"""Calls of one shape that are worked through before it is recorded: shapes that hardly return are not."""

_living: dict[torch.device, WeakSet[torch.cuda.CUDAGraph]] = {}
"""Recordings that are still there: they share their room, which goes with the last of them."""


class Recorded:
    """A function of tensors that answers with tensors; none is differentiated.

    Python asks a GPU for one small operation after another, each of which takes it longer to ask for than the GPU to
    do: of a training's 1,900 operations a step, 7 ms were work and 24 ms waiting. A recording (a CUDA graph) is asked
    for once. What a recording cannot hold, such as work whose size hangs on numbers that the GPU has still to find, is
    worked through every time, as everything is on a CPU.
    """

    def __init__(self, work: Callable[..., tuple[Tensor, ...]]) -> None:
        self._work = work
        self._calls: dict[tuple, int] = {}
        self._plays: dict[tuple, Callable[..., tuple[Tensor, ...]]] = {}

    def __call__(self, *given: Tensor) -> tuple[Tensor, ...]:
        """The work's answer to the tensors ``given``, without gradient."""
        with torch.no_grad():
            if given[0].device.type != "cuda":
                return self._work(*given)
            kind = tuple((x.shape, x.dtype) for x in given)
            if (play := self._plays.get(kind)) is not None:
                return play(*given)
            self._calls[kind] = self._calls.get(kind, 0) + 1
            if self._calls[kind] == WARM and _waits(self._work, given):
                self._plays[kind] = self._work
            elif self._calls[kind] > WARM:
                self._plays[kind] = _recording(self._work, given)
            return self._work(*given)


def _waits(work: Callable[..., tuple[Tensor, ...]], given: tuple[Tensor, ...]) -> bool:
    """Whether the work waits for the GPU, as no recording may: one that failed for it would spoil later ones."""
    mode = torch.cuda.get_sync_debug_mode()
    try:
        with warnings.catch_warnings(action="ignore"):  # that this mode is a prototype
            torch.cuda.set_sync_debug_mode("error")
        work(*given)
    except RuntimeError:
        return True
    finally:
        torch.cuda.set_sync_debug_mode(mode)
    return False


def _recording(work: Callable[..., tuple[Tensor, ...]], given: tuple[Tensor, ...]) -> Callable[..., tuple[Tensor, ...]]:
    """How to play the work on tensors of these shapes."""
    buffers = [x.detach().clone(memory_format=torch.contiguous_format) for x in given]
    graph, device = torch.cuda.CUDAGraph(), given[0].device
    collects = gc.isenabled()
    gc.collect()  # before it is asked who lives: a room is gone with the last who does
    gc.disable()  # a recording that is let go of while another is made would spoil it
    living = _living.setdefault(device, WeakSet())
    other = next(iter(living), None)
    try:
        # Other threads, such as those of several processes' talk, may use the GPU meanwhile
        with torch.cuda.graph(graph, pool=other and other.pool(), capture_error_mode="thread_local"):
            answers = work(*buffers)
    finally:
        if collects:
            gc.enable()
    living.add(graph)

    def play(*given: Tensor) -> tuple[Tensor, ...]:
        for buffer, x in zip(buffers, given, strict=True):
            buffer.copy_(x)
        graph.replay()
        return tuple(answer.clone() for answer in answers)  # all recordings share their room

    return play
