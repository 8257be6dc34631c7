"""Videos as people have them: made with opencv, then damaged."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from caphy.errors import CaphyError
from service.clients.monocular import video as module
from service.clients.monocular.video import Cuts, Video


def write(path: Path, fps: float = 30.0, count: int = 24, size: tuple[int, int] = (160, 96)) -> Path:
    """A video whose left half is bright, and noisy enough that pictures take some bytes."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    random = np.random.default_rng(0)
    for _ in range(count):
        picture = random.integers(0, 60, (size[1], size[0], 3)).astype(np.uint8)
        picture[:, : size[0] // 2] += 150
        writer.write(picture)
    writer.release()
    return path


@pytest.mark.parametrize("fps", [10.0, 30.0, 59.94])
def test_times_are_those_of_the_file(tmp_path: Path, fps: float) -> None:
    video = Video(write(tmp_path / "clip.mp4", fps, 12))
    times = [picture.time for picture in video]
    np.testing.assert_allclose(times, np.arange(12) / fps, atol=2e-3)
    assert video.size == (160, 96)
    assert not video.notes


def test_a_portrait_video_of_a_phone_stands_upright(tmp_path: Path) -> None:
    """Phones write the sensor's picture, and a turn by a quarter in the header of the track (ISO 14496-12, tkhd)."""
    path = write(tmp_path / "phone.mp4")
    content = bytearray(path.read_bytes())
    place = content.index(b"tkhd") + 4 + 40
    one = 1 << 16
    content[place : place + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 96 * one, 0, 1 << 30)
    path.write_bytes(content)
    video = Video(path)
    pictures = list(video)
    assert video.size == (96, 160)
    assert pictures[0].pixels.shape == (160, 96, 3)
    assert pictures[0].pixels[:80].mean() > pictures[0].pixels[80:].mean() + 80  # what was left is above


def test_a_file_that_breaks_off_keeps_what_came_before(tmp_path: Path) -> None:
    path = write(tmp_path / "whole.mp4", count=60, size=(320, 192))
    content = path.read_bytes()
    data, index = content.index(b"mdat"), content.index(b"moov")
    assert data < index
    broken = bytearray(content)
    broken[(data + index) // 2 : index - 4] = bytes(index - 4 - (data + index) // 2)
    path.write_bytes(broken)
    video = Video(path)
    read = list(video)
    assert 20 < len(read) <= 60
    if len(read) < 59:
        assert "breaks off" in video.notes[-1]
        assert str(len(read)) in video.notes[-1]


class _Capture:
    """An opencv capture of a file whose times are what a test says."""

    def __init__(self, times: list[float], stated: int) -> None:
        self._times, self._stated, self._next = times, stated, 0

    def __call__(self, *_: object) -> _Capture:
        return self

    def isOpened(self) -> bool:
        return True

    def set(self, *_: object) -> bool:
        return True

    def get(self, what: int) -> float:
        if what == cv2.CAP_PROP_POS_MSEC:
            return 1e3 * self._times[self._next - 1]
        return {cv2.CAP_PROP_FPS: 20.0, cv2.CAP_PROP_FRAME_COUNT: self._stated}.get(what, 0.0)

    def read(self) -> tuple[bool, np.ndarray | None]:
        if self._next == len(self._times):
            return False, None
        self._next += 1
        return True, np.zeros((8, 8, 3), np.uint8)

    def release(self) -> None:
        pass


def _captured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, times: list[float], stated: int) -> Video:
    path = tmp_path / "x.mp4"
    path.write_bytes(b"x")
    monkeypatch.setattr(module.cv2, "VideoCapture", _Capture(times, stated))
    return Video(path)


def test_a_rate_that_varies_is_taken_as_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    times = [0.0, 0.033, 0.1, 0.12, 0.4, 0.41]
    video = _captured(monkeypatch, tmp_path, times, 6)
    np.testing.assert_allclose([picture.time for picture in video], times)
    assert not video.notes


def test_times_that_do_not_rise_are_repaired_and_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    video = _captured(monkeypatch, tmp_path, [0.0, 0.05, 0.05, 0.0, 0.2], 9)
    times = [picture.time for picture in video]
    np.testing.assert_allclose(times, [0.0, 0.05, 0.1, 0.15, 0.2])
    assert "2 time stamps" in video.notes[0]
    assert "breaks off after 5" in video.notes[1]


def test_after_a_pause_times_go_on_as_the_file_has_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The pause is left out; what comes after it is not played at another rate."""
    video = _captured(monkeypatch, tmp_path, [0.0, 0.05, 2.5, 2.6, 2.7, 2.9], 6)
    np.testing.assert_allclose([picture.time for picture in video], [0.0, 0.05, 0.1, 0.2, 0.3, 0.5])
    assert "1 time stamps are missing, do not rise or jump" in video.notes[0]


def test_pictures_that_come_in_pairs_are_not_slowed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The second of each pair is moved on, and no other with it."""
    video = _captured(monkeypatch, tmp_path, [0.0, 0.001, 0.1, 0.101, 0.2, 0.201, 0.3], 7)
    np.testing.assert_allclose([picture.time for picture in video], [0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3])


def test_one_broken_time_stamp_costs_no_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    video = _captured(monkeypatch, tmp_path, [0.0, 0.1, 9.0, 0.3, np.nan, 0.42], 6)
    np.testing.assert_allclose([picture.time for picture in video], [0.0, 0.1, 0.15, 0.3, 0.35, 0.42])
    assert "2 time stamps" in video.notes[0]


def test_a_slow_camera_has_the_times_of_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 10.0, 10.1, 12.0, 12.1])
    monkeypatch.setattr(module.cv2, "VideoCapture", _Capture([0.0] * 4, 0))
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    video = Video("0")
    np.testing.assert_allclose([picture.time for picture in video], [0.0, 0.1, 2.0, 2.1])
    assert not video.notes


def test_a_stopped_video_ends_with_the_picture_at_hand(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    video = _captured(monkeypatch, tmp_path, [0.0, 0.1, 0.2, 0.3], 4)
    for picture in video:
        if picture.time > 0.05:
            video.stop()
    assert video.read == 2
    assert not video.notes


@pytest.mark.parametrize("content", [b"", b"no video at all\n" * 100])
def test_what_is_no_video_is_said(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "notes.mp4"
    path.write_bytes(content)
    with pytest.raises(CaphyError, match=r"notes\.mp4: opencv finds no picture"):
        Video(path)
    with pytest.raises(CaphyError, match="there is no such video"):
        Video(tmp_path / "missing.mp4")


def test_cuts_are_noticed_and_motion_is_not() -> None:
    random = np.random.default_rng(0)
    rooms = [cv2.resize(random.integers(0, 255, (9, 16, 3)).astype(np.uint8), (320, 180)) for _ in range(2)]
    cuts = Cuts()
    found = []
    for t in range(40):
        picture = rooms[t // 20].copy()
        cv2.circle(picture, (40 + 6 * t, 90), 30, (250, 250, 250), -1)  # somebody walks through
        found.append(cuts.between(picture))
    assert np.flatnonzero(found).tolist() == [20]
