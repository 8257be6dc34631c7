"""Pictures with time stamps, from a file or a camera."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from caphy.errors import CaphyError

_OFTEN = 1 / 240
"""Time stamps closer than this are not believed [s]."""
_LONG = 1.0
"""Nor are steps so long in a file, whose stamps may be broken [s]; a camera's are our own clock's."""


@dataclass(frozen=True, eq=False)
class Picture:
    """time: [s] since the first. pixels: (H, W, 3) uint8 BGR, upright."""

    time: float
    pixels: np.ndarray

    @property
    def rgb(self) -> np.ndarray:
        """The same with red first (H, W, 3)."""
        return cv2.cvtColor(self.pixels, cv2.COLOR_BGR2RGB)


class Video:
    """A video file, or a camera by its number.

    Pictures come upright (the rotation that phones store is applied) and with the times the file states, so a frame
    rate that varies is no matter; pauses of a second or more are left out. ``notes`` says what was odd, in words.

    Raises CaphyError where nothing can be read at all.
    """

    def __init__(self, source: str | Path) -> None:
        self.source = str(source)
        self.is_camera = self.source.isdigit()
        if not self.is_camera and not Path(self.source).is_file():
            raise CaphyError(f"{self.source}: there is no such video; give a file, or a camera's number such as 0")
        self._capture = cv2.VideoCapture(int(self.source)) if self.is_camera else cv2.VideoCapture(self.source)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        self.notes: list[str] = []
        first = self._read() if self._capture.isOpened() else None
        if first is None:
            if self.is_camera:
                raise CaphyError(f"{self.source}: this camera gives no picture; is it there, and free?")
            raise CaphyError(
                f"{self.source}: opencv finds no picture in this file; is it a video, and whole? ffmpeg -i shows what "
                "is in it"
            )
        self._first: np.ndarray | None = first
        self.size = first.shape[1], first.shape[0]
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = float(fps) if 1 <= fps <= 240 else 30.0
        if self.fps != fps and not self.is_camera:
            self.notes.append(f"the file states no sensible frame rate ({fps:g}); 30 is taken where times are missing")
        self._stated = 0 if self.is_camera else int(max(0.0, self._capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        self.read = 0
        self._stopped = False

    def stop(self) -> None:
        """The picture that is being read is the last; may be called from a signal's handler."""
        self._stopped = True

    def __iter__(self) -> Iterator[Picture]:
        """Every picture that can be read, times rising."""
        started, repaired = time.monotonic(), 0
        pixels, self._first = self._first, None
        last, left_out = -np.inf, 0.0
        while pixels is not None:
            stated = self._stamp(started)
            stamp = next((stated - out for out in (left_out, 0.0) if self._follows(stated - out, last)), None)
            if stamp is None:
                stamp, repaired = last + 1 / self.fps, repaired + (not self.is_camera)
                left_out = max(0.0, stated - stamp) if stated - left_out > last else left_out
            else:
                left_out = stated - stamp
            last = stamp
            self.read += 1
            yield Picture(stamp, pixels)
            pixels = None if self._stopped else self._read()
        self._capture.release()
        if repaired:
            self.notes.append(
                f"{repaired} time stamps are missing, do not rise or jump by {_LONG:g} s or more; 1/{self.fps:g} s was "
                "taken for each"
            )
        if self.read < self._stated - 1 and not self._stopped:
            self.notes.append(
                f"the file states {self._stated} pictures and breaks off after {self.read} ({last:.2f} s); "
                "all before that was used"
            )

    def _stamp(self, started: float) -> float:
        if self.is_camera:
            return time.monotonic() - started
        stated = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        return stated if np.isfinite(stated) else 0.0

    def _follows(self, stamp: float, last: float) -> bool:
        """Whether a time stamp is believed after another, minus infinity before the first."""
        return last + _OFTEN < stamp < (np.inf if self.is_camera or last == -np.inf else last + _LONG)

    def _read(self) -> np.ndarray | None:
        try:
            found, pixels = self._capture.read()
        except cv2.error:
            return None
        return pixels if found and pixels is not None and pixels.ndim == 3 else None


class Cuts:
    """Notices that a picture shows another scene than the one before."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._usual = 4.0

    def between(self, pixels: np.ndarray) -> bool:
        """Whether there was a cut just before this picture (H, W, 3)."""
        step = max(1, min(pixels.shape[:2]) // 128)  # every so many pixels are enough, and ten times as fast
        small = cv2.resize(pixels[::step, ::step], (48, 32), interpolation=cv2.INTER_AREA).astype(np.float32)
        small = cv2.GaussianBlur(small, (0, 0), 1.5)
        last, self._last = self._last, small
        if last is None or last.shape != small.shape:
            return False
        change = float(np.abs(small - last).mean())
        is_cut = change > 18 and change > 6 * self._usual
        if not is_cut:
            self._usual += 0.1 * (max(change, 1.0) - self._usual)
        return is_cut
