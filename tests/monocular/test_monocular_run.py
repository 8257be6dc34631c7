"""The client from a video to a dressed one, with a detector that knows where the person is."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from people import into_camera, landmark_places, seen

from caphy.conditioning import Conditioning, Did, Frame
from caphy.io.bundle import AvatarBundle
from caphy.io.poses import PoseSequence, read_poses
from service.clients.monocular import __main__ as command
from service.clients.monocular.dressing import Dressing, RequestWardrobe, StreamWardrobe
from service.clients.monocular.estimator import Estimate, Estimator
from service.clients.monocular.landmarks import Landmarks
from service.clients.monocular.overlay import Overlay
from service.clients.monocular.video import Picture

SIZE = (640, 360)
COUNT = 40


@pytest.fixture(scope="module")
def service() -> Iterator[str]:
    command = [sys.executable, "-m", "caphy.cli", "serve", "--host", "127.0.0.1", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield next(match[0] for line in process.stdout or () if (match := re.search(r"http://\S+:\d+", line)))
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=120)


class KnownPerson:
    """A detector of one person who moves as a motion says; nobody is seen in the pictures of ``hidden``."""

    def __init__(self, bundle: AvatarBundle, motion: PoseSequence, hidden: range = range(0)) -> None:
        self._places = into_camera(landmark_places(bundle, motion.poses, motion.transl))
        self._hidden, self._next, self._random = hidden, 0, np.random.default_rng(0)

    def __call__(self, picture: np.ndarray) -> Landmarks | None:
        self._next += 1
        if self._next - 1 in self._hidden:
            return None
        found = seen(self._places[self._next - 1], self._random, 2.0, 0.02)
        return Landmarks(found.pixels / 2, found.world, found.visibility)  # these pictures are half as wide

    def close(self) -> None:
        pass


class NoCounter:
    """Counts one person in every picture."""

    def __call__(self, picture: np.ndarray) -> int:
        return 1

    def close(self) -> None:
        pass


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "grey.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, SIZE)
    for _ in range(COUNT):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 120, np.uint8))
    writer.release()
    return path


def _pictures(path: Path) -> list[np.ndarray]:
    capture, pictures = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        pictures.append(read[1])
    return pictures


def _main(monkeypatch: pytest.MonkeyPatch, detector: object, *arguments: str) -> int:
    monkeypatch.setattr(command, "MediapipeDetector", lambda: detector)
    monkeypatch.setattr(command, "PeopleCounter", NoCounter)
    return command.main([*arguments, "--focal", "500"])


def test_one_command_dresses_a_video(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    video: Path,
    bundle: AvatarBundle,
    motion: PoseSequence,
    service: str,
) -> None:
    out, poses = tmp_path / "dressed.mp4", tmp_path / "poses.npz"
    detector = KnownPerson(bundle, motion)
    status = _main(monkeypatch, detector, str(video), "-o", str(out), "--poses", str(poses), "--service", service)
    said = capsys.readouterr().out
    assert status == 0, said
    assert f"{COUNT} pictures, {COUNT} frames dressed over stream" in said
    pictures = _pictures(out)
    assert len(pictures) == COUNT
    # clothes are where the person is: blue trousers below, shirt above, on what was grey everywhere
    places = into_camera(landmark_places(bundle, motion.poses, motion.transl))[20]
    pixels = (500 * places[:, :2] / places[:, 2:] + np.array(SIZE) / 2).astype(int)
    coloured = np.ptp(pictures[20].astype(int), axis=2) > 25
    rows, columns = np.nonzero(coloured)
    assert coloured.sum() > 2000
    assert abs(columns.mean() - pixels[:, 0].mean()) < 25
    assert pixels[0, 1] < rows.min()
    assert rows.max() < pixels[:, 1].max() + 10
    written = read_poses(poses)
    assert len(written) == COUNT
    assert not list(tmp_path.glob(".*"))
    difference = np.linalg.norm(written.poses[5:, :22] - motion.poses[5:COUNT, :22], axis=-1)
    assert np.degrees(np.median(difference)) < 12


def test_nobody_is_said_and_the_video_is_kept(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    video: Path,
    bundle: AvatarBundle,
    motion: PoseSequence,
    service: str,
) -> None:
    out = tmp_path / "nobody.mp4"
    detector = KnownPerson(bundle, motion, hidden=range(COUNT))
    assert _main(monkeypatch, detector, str(video), "-o", str(out), "--service", service) == 1
    assert f"nobody was found in {COUNT} pictures" in capsys.readouterr().err
    assert len(_pictures(out)) == COUNT


@pytest.mark.parametrize("option", ["--out", "--poses", "--record"])
def test_what_cannot_be_written_is_said_before_the_video_is_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, video: Path, option: str
) -> None:
    """Not after an hour; and the video itself is not written over while it is read."""
    before = video.read_bytes()
    for place, words in ((str(video), "is read, and would be" if option == "--out" else "must end in"),
                         (str(tmp_path / "dance"), "must end in")):  # fmt: skip
        assert _main(monkeypatch, None, str(video), option, place, "--service", "http://127.0.0.1:9") == 1
        assert words in capsys.readouterr().err
    assert video.read_bytes() == before


def test_a_service_that_is_not_there_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], video: Path
) -> None:
    assert _main(monkeypatch, None, str(video), "--service", "http://127.0.0.1:9") == 1
    assert "caphy serve" in capsys.readouterr().err


def _estimates(bundle: AvatarBundle, motion: PoseSequence, hidden: range = range(0)) -> list[Estimate]:
    estimator = Estimator(bundle.joints, KnownPerson(bundle, motion, hidden), 500.0, SIZE)
    grey = np.full((SIZE[1], SIZE[0], 3), 120, np.uint8)
    found = []
    for t in range(len(motion)):
        picture = Picture(t / 30, grey)
        found.append(estimator.estimate(picture, *estimator.detect(picture)))
    return found


def test_stream_and_requests_dress_alike_and_a_gap_is_calm(
    bundle: AvatarBundle, motion: PoseSequence, service: str
) -> None:
    """Over both ways to the service; somebody lost for half a second holds still and nothing flies."""
    estimates = _estimates(bundle, motion, hidden=range(30, 45))
    worn = []
    for wardrobe in (StreamWardrobe(service, "default", 30.0), RequestWardrobe(service, "default", 30.0)):
        dressing = Dressing(wardrobe, Conditioning())
        frames = [frame for estimate in estimates for frame in dressing.push(estimate)] + dressing.flush()
        wardrobe.close()
        worn.append(np.stack([dressed.garments["tshirt"] for dressed in frames]))
    assert worn[0].shape[0] == len(motion)
    np.testing.assert_allclose(worn[0], worn[1], atol=2e-4)
    assert np.isfinite(worn[0]).all()
    speed = np.linalg.norm(np.diff(worn[0], axis=0), axis=-1) * 30
    assert speed[3:].max() < 8  # hands of the motion itself reach 3 m/s


@pytest.mark.parametrize("kind", [StreamWardrobe, RequestWardrobe])
def test_after_a_reset_garments_begin_anew(kind: type, motion: PoseSequence, service: str) -> None:
    frames = [
        Frame(t / 30, motion.poses[t], motion.transl[t], Did.RESET if t == 10 else Did.NOTHING) for t in range(20)
    ]
    worn = []
    for part in (frames, frames[10:]):
        wardrobe = kind(service, "default", 30.0)
        worn.append(np.stack([garments["tshirt"] for garments in wardrobe.wear(part)]))
        wardrobe.close()
    np.testing.assert_allclose(worn[0][10:], worn[1], atol=1e-6)


def test_the_world_turns_without_a_jump_when_up_is_found_late(bundle: AvatarBundle, motion: PoseSequence) -> None:
    estimator = Estimator(bundle.joints, KnownPerson(bundle, motion), 500.0, SIZE)
    grey = np.full((SIZE[1], SIZE[0], 3), 120, np.uint8)
    places, ups = [], []
    for t in range(60):
        picture = Picture(t / 30, grey)
        if t == 30:
            estimator.gravity._goal = np.array([0.0, -np.cos(0.3), -np.sin(0.3)])
            estimator.gravity.by_lines = True
        estimate = estimator.estimate(picture, *estimator.detect(picture))
        assert estimate.transl is not None
        places.append(estimate.transl)
        ups.append(estimate.turn[1])
    assert np.degrees(np.arccos(ups[-1] @ ups[29])) > 10
    risen = (places[-1] - places[29])[1] - (motion.transl[59] - motion.transl[29])[1]
    assert abs(risen) < 0.3  # turned about the camera, 4 m away, it would be 1.2 m


def test_forearms_before_the_shirt_stay_bare(bundle: AvatarBundle) -> None:
    """Both hands held before the belly: the picture is seen there, not the shirt."""
    poses, transl = np.zeros((55, 3)), np.array([0.0, 0.0, -3.0])
    poses[16], poses[17] = [0.0, 0.0, -1.1], [0.0, 0.0, 1.1]
    poses[18], poses[19] = [0.0, -1.9, 0.0], [0.0, 1.9, 0.0]
    garments = {g.name: g.mesh.posed(bundle.transforms(poses[None], transl[None]))[0] for g in bundle.garments}
    turn = np.diag([1.0, -1.0, -1.0])  # a level camera at the origin that looks along -z
    overlay = Overlay(bundle, 500.0, SIZE)
    white = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    drawn = overlay.draw(white, poses, transl, garments, turn, np.zeros(3))
    joints = bundle.transforms(poses[None], transl[None])[0]
    forearms = 0.6 * bundle.joints[[18, 19]] + 0.4 * bundle.joints[[20, 21]]
    chest = bundle.joints[9] + [0.0, 0.0, 0.1]

    def pixel(point: np.ndarray, joint: int) -> tuple[int, int]:
        x, y, z = (joints[joint, :, :3] @ point + joints[joint, :, 3]) @ turn
        return int(500 * y / z + SIZE[1] / 2), int(500 * x / z + SIZE[0] / 2)

    assert (drawn[pixel(chest, 9)] < 250).any()
    for point, joint in zip(forearms, (18, 19), strict=True):
        assert (drawn[pixel(point, joint)] == 255).all()


def test_ctrl_c_ends_a_camera_and_what_it_gave_is_written() -> None:
    """Nothing else ends one; the second time it ends the program."""
    stopped: list[bool] = []
    camera = SimpleNamespace(is_camera=True, stop=lambda: stopped.append(True))
    before = signal.getsignal(signal.SIGINT)
    with command._ended_by_ctrl_c(camera):  # pyright: ignore[reportArgumentType]
        signal.raise_signal(signal.SIGINT)
        assert stopped == [True]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == before


def test_no_time_at_all_is_refused_before_anything_is_written(video: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "dressed.mp4"
    out.write_bytes(b"of before")
    assert command.main([str(video), "-o", str(out), "--seconds", "-1"]) == 1
    assert "--seconds must be positive, got -1" in capsys.readouterr().err
    assert out.read_bytes() == b"of before"
