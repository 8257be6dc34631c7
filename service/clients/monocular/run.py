"""A video from its first picture to its last: estimated, dressed, drawn, written."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from caphy.conditioning import Frame
from service.clients.monocular.dressing import Dressed, Dressing
from service.clients.monocular.estimator import Estimate, Estimator
from service.clients.monocular.landmarks import Landmarks
from service.clients.monocular.overlay import Overlay
from service.clients.monocular.video import Picture, Video

_AHEAD = 3
"""Pictures that are being looked at while older ones are dressed."""
_COUNT_EVERY = 15
"""Pictures between two counts of the people."""
_UNSEEN = 0.5
"""Clothes of somebody unseen for longer are not drawn [s]."""
_RECENT = 60
"""Dressed frames that are kept for the pictures that wait."""


@dataclass
class Record:
    """What came of a video.

    estimates: as the pictures gave them. seen: what the detector saw. frames: conditioned, at the avatar's rate; their
    garments are gone, which would be 6 GB an hour.
    """

    estimates: list[Estimate] = field(default_factory=list)
    seen: list[Landmarks | None] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    people: list[int] = field(default_factory=list)
    """How many were counted, now and then."""
    seconds: float = 0.0
    """From the first picture to the last one written [s]."""
    processor: float = 0.0
    """Of the processor, all threads, meanwhile [s]."""


Shown = Callable[[np.ndarray, float], None]
"""Takes a finished picture (H, W, 3) uint8 BGR and its time [s]."""


def run(
    video: Video,
    estimator: Estimator,
    dressing: Dressing,
    overlay: Overlay | None,
    show: Shown,
    count_people: Callable[[np.ndarray], int] | None = None,
    seconds: float = np.inf,
) -> Record:
    """Every picture of ``video`` up to ``seconds``, dressed and shown in their order.

    A picture is shown when the frame of its own time is complete, so clothes and body fit together; that is the
    conditioning's latency later. Detection runs in a thread of its own, beside everything else.
    """
    record, waiting, recent = Record(), deque[tuple[Picture, bool]](), deque[Dressed](maxlen=_RECENT)
    started, processor = time.perf_counter(), time.process_time()
    last_seen = -np.inf
    for picture, seen, is_cut in _detected(video, estimator, seconds):
        if count_people is not None and len(record.estimates) % _COUNT_EVERY == 0:
            record.people.append(count_people(picture.rgb))
        estimate = estimator.estimate(picture, seen, is_cut)
        record.estimates.append(estimate)
        record.seen.append(seen)
        last_seen = picture.time if estimate.poses is not None else last_seen
        waiting.append((picture, picture.time - last_seen < _UNSEEN))
        fresh = dressing.push(estimate)
        record.frames += [dressed.frame for dressed in fresh]
        recent += fresh
        _show(waiting, recent, overlay, show, is_last=False)
    fresh = dressing.flush()
    record.frames += [dressed.frame for dressed in fresh]
    recent += fresh
    _show(waiting, recent, overlay, show, is_last=True)
    record.seconds, record.processor = time.perf_counter() - started, time.process_time() - processor
    return record


def _detected(video: Video, estimator: Estimator, seconds: float) -> Iterator[tuple[Picture, Landmarks | None, bool]]:
    """Pictures with what was seen in them; the next few are already being looked at."""
    with ThreadPoolExecutor(1) as pool:
        ahead = deque()
        for picture in video:
            if picture.time > seconds:
                break
            ahead.append((picture, pool.submit(estimator.detect, picture)))
            if len(ahead) > (1 if video.is_camera else _AHEAD):
                yield _result(ahead)
        while ahead:
            yield _result(ahead)


def _result(ahead: deque) -> tuple[Picture, Landmarks | None, bool]:
    picture, found = ahead.popleft()
    return picture, *found.result()


def _show(
    waiting: deque[tuple[Picture, bool]], recent: deque[Dressed], overlay: Overlay | None, show: Shown, is_last: bool
) -> None:
    """Show the pictures whose time the frames have reached."""
    while waiting and (is_last or (recent and waiting[0][0].time <= recent[-1].frame.time) or _is_unknown(waiting)):
        picture, is_seen = waiting.popleft()
        dressed = _nearest(recent, picture.time) if is_seen else None
        if dressed is None or overlay is None:
            show(picture.pixels, picture.time)
        else:
            frame, then = dressed.frame, dressed.estimate
            drawn = overlay.draw(picture.pixels, frame.poses, frame.transl, dressed.garments, then.turn, then.origin)
            show(drawn, picture.time)


def _is_unknown(waiting: deque[tuple[Picture, bool]]) -> bool:
    """Whether the oldest picture waits in vain: nobody was seen in it, and time has gone on."""
    return not waiting[0][1] and waiting[-1][0].time - waiting[0][0].time > 0.2


def _nearest(recent: deque[Dressed], moment: float) -> Dressed | None:
    """The frame nearest to a moment; none before the first."""
    best = min(recent, key=lambda dressed: abs(dressed.frame.time - moment), default=None)
    return best if best is not None and abs(best.frame.time - moment) < 0.2 else None
