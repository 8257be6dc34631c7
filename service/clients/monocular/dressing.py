"""From poses as they come to clothes: conditioned to the avatar's rate, dressed by the service."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from caphy.conditioning import Conditioner, Conditioning, Did, Frame
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from service.client import Client
from service.clients.monocular.estimator import Estimate
from service.clients.stream import StreamClient, StreamRefused

PATIENCE = 60.0
"""How long the service may take for an answer [s]: a busy machine is no error."""


@dataclass(frozen=True, eq=False)
class Dressed:
    """A conditioned frame, the garments' vertices (V, 3) [m] by name, and the picture's estimate of that moment."""

    frame: Frame
    garments: dict[str, np.ndarray]
    estimate: Estimate


class Wardrobe(Protocol):
    """Something that dresses frame after frame. name: over what."""

    @property
    def name(self) -> str: ...

    def wear(self, frames: list[Frame]) -> list[dict[str, np.ndarray]]:
        """Garments' vertices (V, 3) [m] by name, for each frame."""
        ...

    def close(self) -> None:
        """Let the service go."""
        ...


class StreamWardrobe:
    """Dresses over the service's WebSocket: one message and one answer for the frames of each picture."""

    name = "stream"

    def __init__(self, url: str, avatar: str, fps: float, key: str | None = None) -> None:
        self._stream = StreamClient(url, avatar, fps=fps, key=key)

    def wear(self, frames: list[Frame]) -> list[dict[str, np.ndarray]]:
        """See :class:`Wardrobe`."""
        worn: list[dict[str, np.ndarray]] = []
        for part in _parts(frames):
            if Did.RESET in part[0].did:
                self._stream.reset()
            for start in range(0, len(part), self._most):
                worn += self._worn(part[start : start + self._most])
        return worn

    def _worn(self, part: list[Frame]) -> list[dict[str, np.ndarray]]:
        self._stream.send(np.stack([frame.poses for frame in part]), np.stack([frame.transl for frame in part]))
        vertices = self._stream.receive(PATIENCE).meshes.vertices
        return [{name: garment[t] for name, garment in vertices.items()} for t in range(len(part))]

    @property
    def _most(self) -> int:
        return self._stream.welcome.max_frames

    def close(self) -> None:
        """See :class:`Wardrobe`."""
        self._stream.close()


class RequestWardrobe:
    """Dresses over HTTP, a request for the frames of each picture: where no WebSocket gets through."""

    name = "requests"

    def __init__(self, url: str, avatar: str, fps: float, key: str | None = None) -> None:
        self._client, self._avatar, self._fps = Client(url, key=key), avatar, fps
        self._states: dict[str, np.ndarray] | None = None

    def wear(self, frames: list[Frame]) -> list[dict[str, np.ndarray]]:
        """See :class:`Wardrobe`."""
        worn: list[dict[str, np.ndarray]] = []
        for part in _parts(frames):
            if Did.RESET in part[0].did:
                self._states = None
            poses, transl = np.stack([f.poses for f in part]), np.stack([f.transl for f in part])
            pelvis = self._client.pelvis(self._avatar)  # translations are the avatar's already
            motion = PoseSequence(poses, transl, self._fps, source="monocular", pelvis=pelvis)
            answer = self._client.run(self._avatar, motion, states=self._states)
            self._states = dict(answer.states)
            worn += [{name: v[t] for name, v in answer.vertices.items()} for t in range(len(part))]
        return worn

    def close(self) -> None:
        """See :class:`Wardrobe`."""
        self._client.close()


def _parts(frames: list[Frame]) -> Iterator[list[Frame]]:
    """Runs of frames that continue each other."""
    starts = [i for i, frame in enumerate(frames) if i == 0 or Did.RESET in frame.did]
    for start, end in zip(starts, [*starts, len(frames)][1:], strict=True):
        yield frames[start:end]


def open_wardrobe(url: str, avatar: str, fps: float, key: str | None = None) -> StreamWardrobe | RequestWardrobe:
    """A stream, or requests where the service can be reached but a WebSocket cannot be opened."""
    try:
        return StreamWardrobe(url, avatar, fps, key)
    except StreamRefused:
        raise
    except CaphyError:
        wardrobe = RequestWardrobe(url, avatar, fps, key)
        Client(url, key=key).avatars()  # raises where the service is not there either
        return wardrobe


class Dressing:
    """Estimates in, dressed frames out, ``settings.latency`` later."""

    def __init__(self, wardrobe: Wardrobe, settings: Conditioning) -> None:
        self.conditioner = Conditioner(settings)
        self._wardrobe = wardrobe
        self._estimates: list[Estimate] = []

    def push(self, estimate: Estimate) -> list[Dressed]:
        """The frames that an estimate completes."""
        self._estimates.append(estimate)
        return self._dressed(self.conditioner.push(estimate.time, estimate.poses, estimate.transl, estimate.confidence))

    def flush(self) -> list[Dressed]:
        """The frames up to the last estimate."""
        return self._dressed(self.conditioner.flush())

    def _dressed(self, frames: list[Frame]) -> list[Dressed]:
        worn = self._wardrobe.wear(frames)
        return [Dressed(f, garments, self._of(f.time)) for f, garments in zip(frames, worn, strict=True)]

    def _of(self, time: float) -> Estimate:
        while len(self._estimates) > 1 and self._estimates[1].time <= time + 1e-6:
            self._estimates.pop(0)
        return self._estimates[0]
