"""What a training plays: streams on their way through motions, and what the network remembers of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from caphy.errors import CaphyError
from caphy.network.garment_network import GarmentNetwork
from caphy.training.motions import Motions
from caphy.training.objective import Past
from caphy.training.streams import Windows


class Loss(Protocol):
    """What is asked of predicted frames: see :class:`caphy.training.objective.Objective`."""

    def judge(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Tensor, Tensor, Past]:
        """Positions (B, K, V, 3) [m] and loss (B, K) [J] of scored frames, and the streams' past after them."""
        ...


class Played(Protocol):
    """Which frames streams play: see :class:`caphy.training.streams.Streams`."""

    place: np.ndarray

    def advance(self) -> Windows:
        """The next window of every stream."""
        ...

    def restore(self, place: np.ndarray) -> None:
        """Continue from a saved :attr:`place` (B, 2)."""
        ...


class Track:
    """B streams through some motions under one loss; this process plays those of ``own``."""

    def __init__(
        self, motions: Motions, streams: Played, loss: Loss, network: GarmentNetwork, own: slice, last: bool = False
    ) -> None:
        """With ``last`` offsets are made of the last frame of each window only, for losses that score no other."""
        self.motions, self.streams, self.loss, self.own, self.last = motions, streams, loss, own, last
        share = own.stop - own.start
        self.hidden = network.template.new_zeros(network.gru.num_layers, share, network.gru.hidden_size)
        still = network.template.expand(share, -1, -1)
        self.past = Past(still, still)

    def advance(self, model: Callable[..., tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
        """Positions (B, K, V, 3) [m] and loss (B, K) [J] of the next window of each own stream.

        Both carry the gradient towards the model; where it predicts what is not finite, the loss is not either.
        """
        windows = self.streams.advance()[self.own]
        fresh = torch.as_tensor(windows.fresh, device=self.hidden.device)[None, :, None]
        features = windows.features(self.motions).to(self.hidden)
        offsets, hidden = model(features, torch.where(fresh, 0, self.hidden), self.last)
        if not torch.isfinite(offsets.detach().sum()):
            return offsets, offsets.sum((2, 3))  # nearest points cannot be looked up
        x, loss, self.past = self.loss.judge(self.motions, windows, offsets, self.past)
        self.hidden = hidden.detach()
        return x, loss

    def state(self) -> dict[str, Tensor]:
        """Where all streams stand, those of other processes included."""
        return {
            "place": torch.from_numpy(self.streams.place.copy()),
            "hidden": _gathered(self.hidden.transpose(0, 1)),
            "before": _gathered(self.past.before),
            "previous": _gathered(self.past.previous),
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a saved :meth:`state`.

        Raises:
            CaphyError: it is of another number of streams.
        """
        have, want = len(state["place"]), len(self.streams.place)
        if have != want:
            raise CaphyError(f"was trained with {have} streams, not {want}")
        device = self.hidden.device
        self.streams.restore(state["place"].numpy())
        self.hidden = state["hidden"][self.own].transpose(0, 1).contiguous().to(device)
        self.past = Past(state["before"][self.own].to(device), state["previous"][self.own].to(device))


def _gathered(share: Tensor) -> Tensor:
    if not dist.is_initialized() or dist.get_world_size() == 1:
        return share
    parts = [torch.empty_like(share, memory_format=torch.contiguous_format) for _ in range(dist.get_world_size())]
    dist.all_gather(parts, share.contiguous())
    return torch.cat(parts)
