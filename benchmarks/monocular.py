"""The monocular client on video with known truth: ``make bench-monocular MOCAP=folder-of-CMU-clips``.

Films the bundled body, dressed, in eight real motions by three cameras (benchmarks/monocular_clips.py), runs the
client on each video against a service of its own, and compares with what was filmed. The client sees only the pixels
and the focal length. Films and records are kept in ``--out`` and used again.

Every line is one video. "joints": position after rigid alignment. "arm", "leg": mean angle of shoulder and elbow, hip
and knee against their parents, twist included, and after the stroke of the bones' directions. "up": gravity.
"garment": vertices against those of the true poses, pelvis on pelvis. "jitter": rms acceleration of vertices against
the true ones, of the poses unfiltered and conditioned; "acc true" is the true one's own, which garments that stand
still would score. Unfiltered poses are what each picture says for itself: the same fit to the same landmarks without
the pull of the last picture's posture, which is a filter too. "lag": the shift [ms] at which joints' angles come
nearest, of the unfiltered poses to the truth and of the conditioned poses to the unfiltered; the latency that
conditioning states, 60 ms, comes on top. "cpu ms": processor time of the client for each picture, all threads; it
depends less than "fps" on what else the machine does.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from benchmarks.monocular_clips import CAMERAS, CLIPS, FPS, film, read_clips
from benchmarks.monocular_errors import (
    Motion,
    bone_angles,
    dressed,
    jitter,
    joint_angles,
    joint_error,
    lag,
    vertex_error,
)
from benchmarks.monocular_film import HEIGHT, WIDTH
from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle, read_bundle
from caphy.io.poses.sequence import interpolate
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from service.clients.monocular.kinematics import Kinematics
from service.clients.monocular.landmarks import Landmarks
from service.clients.monocular.skeleton import Skeleton
from service.settings import BUNDLED_AVATARS


@dataclass(frozen=True)
class Arguments:
    """Film, estimate, compare."""

    mocap: Annotated[Path, tyro.conf.Positional]
    """Folder of CMU clips, with bvh/ and bvh_from_expmap/."""
    python: Path = Path(".venv/monocular/bin/python")
    """Python of the client's environment."""
    out: Path = Path("runs/monocular")
    """Folder of films and records."""
    clips: tuple[str, ...] = tuple(CLIPS)
    cameras: tuple[str, ...] = tuple(CAMERAS)
    again: bool = False
    """Run the client again where there is a record already."""


COLUMNS = (
    *("joints mm", "arm deg", "arm bones", "leg deg", "leg bones", "up deg", "garment mm"),
    *("jitter raw", "jitter cond", "ratio", "acc true", "lag est", "lag cond", "fps", "cpu ms"),
)


def main(arguments: Arguments) -> None:
    """Print the table."""
    bundle = read_bundle(BUNDLED_AVATARS / "default")
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    print(f"{'clip, camera':24}" + "".join(f"{name:>12}" for name in COLUMNS))
    with service() as url:
        clips = list(read_clips(arguments.mocap, bundle, arguments.clips))
        for camera in arguments.cameras:
            for clip in clips:
                video = arguments.out / f"{clip.name.replace(' ', '_')}-{camera}.mp4"
                film(clip, bundle, camera, video)
                record = estimated(arguments, video, url)
                rows.append(row(bundle, record, np.load(video.with_suffix(".npz"))))
                print(f"{clip.name + ', ' + camera:24}" + _cells(rows[-1]), flush=True)
    print(f"{'mean':24}" + _cells(np.nanmean(rows, axis=0)))
    print(f"{'median':24}" + _cells(np.nanmedian(rows, axis=0)))


def _cells(values: np.ndarray) -> str:
    return "".join(f"{value:12.1f}" for value in values)


def estimated(arguments: Arguments, video: Path, url: str) -> dict[str, np.ndarray]:
    """What the client recorded of a video."""
    record = video.with_suffix(".record.npz")
    if arguments.again or not record.exists():
        command = [str(arguments.python), "-m", "service.clients.monocular", str(video), "--service", url]
        focal = float(np.load(video.with_suffix(".npz"))["focal"])
        command += ["--focal", f"{focal:g}", "--record", str(record), "-o", str(video.with_suffix(".dressed.mp4"))]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise CaphyError(f"{video}: the client failed: {done.stderr.strip()[-500:]}")
    with np.load(record) as arrays:
        return dict(arrays)


def row(bundle: AvatarBundle, record: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> np.ndarray:
    """The figures of one video, as :data:`COLUMNS`."""
    seen = np.isfinite(record["poses"][:, 0, 0])
    known = np.arange(len(truth["poses"])) / FPS
    moments = known[(known >= record["frame_time"][0] - 1e-6) & (known <= record["frame_time"][-1] + 1e-6)]
    true = _at(moments, known, Motion(truth["poses"], truth["transl"]))
    raw = _at(moments, record["time"][seen], unfiltered(record, seen, bundle, float(truth["focal"])))
    calm = _at(moments, record["frame_time"], Motion(record["frame_poses"], record["frame_transl"]))
    place = Place(record, truth, bundle, moments)
    worn = dressed(bundle, true), place.vertices(dressed(bundle, raw)), place.vertices(dressed(bundle, calm))
    lags = 1e3 * lag(raw, true, FPS), 1e3 * lag(calm, raw, FPS)
    calm = place.motion(calm)
    noise = jitter(worn[1], worn[0], FPS), jitter(worn[2], worn[0], FPS)
    still = {name: vertices[:1].repeat(len(moments), 0) for name, vertices in worn[0].items()}
    angles = [(joint_angles(calm, true, limb), bone_angles(bundle, calm, true, limb)) for limb in ("arm", "leg")]
    garment = vertex_error(bundle, worn[2], calm, worn[0], true)
    count = len(record["time"])
    speed = count / float(record["seconds"]), 1e3 * float(record["processor"]) / count
    figures = [joint_error(bundle, calm, true), *angles[0], *angles[1], place.gravity_error(), garment]
    return np.array([*figures, *noise, noise[0] / noise[1], jitter(still, worn[0], FPS), *lags, *speed])


def unfiltered(record: dict[str, np.ndarray], seen: np.ndarray, bundle: AvatarBundle, focal: float) -> Motion:
    """What each of the pictures ``seen`` (T,) says for itself, in the client's world."""
    kinematics = Kinematics(Skeleton.of(bundle.joints), focal, (WIDTH, HEIGHT))
    poses, places = np.zeros((int(seen.sum()), 55, 3)), np.zeros((int(seen.sum()), 3))
    for i, picture in enumerate(np.flatnonzero(seen)):
        landmarks = Landmarks(*(record[name][picture] for name in ("pixels", "world", "visibility")))
        posture = kinematics.fit(landmarks, np.inf)
        turn = record["turn"][picture]
        rotations = np.concatenate([turn[None] @ posture.rotations[:1], posture.rotations[1:]])
        poses[i, : len(rotations)] = axis_angle_from_matrix(rotations)
        places[i] = turn @ posture.root + record["origin"][picture] - bundle.joints[0]
    return Motion(poses, places)


def _at(moments: np.ndarray, times: np.ndarray, motion: Motion) -> Motion:
    """The motion at other moments (N,) [s]; before its first and after its last it stands still."""
    return Motion(*interpolate(motion.poses, motion.transl, times, moments.clip(times[0], times[-1])))


class Place:
    """Carries what is in the client's world, by its own idea of the camera, into the filmed one, at given moments."""

    def __init__(
        self, record: dict[str, np.ndarray], truth: dict[str, np.ndarray], bundle: AvatarBundle, moments: np.ndarray
    ) -> None:
        last = np.searchsorted(record["time"], moments + 1e-6).clip(1) - 1
        self._up, self._axes, self._eye = record["turn"][:, 1], truth["axes"], truth["eye"]
        self._origins = record["origin"][last]
        self._turns = truth["axes"].T @ np.swapaxes(record["turn"][last], 1, 2)
        self._pelvis = bundle.joints[0]

    def gravity_error(self) -> float:
        """Mean angle between the client's up and the true one [deg]."""
        return float(np.degrees(np.arccos((self._up @ self._axes[:, 1]).clip(-1, 1))).mean())

    def motion(self, motion: Motion) -> Motion:
        """Poses and translations."""
        poses = motion.poses.copy()
        poses[:, 0] = axis_angle_from_matrix(self._turns @ matrix_from_axis_angle(poses[:, 0]))
        place = np.einsum("tij,tj->ti", self._turns, motion.transl + self._pelvis - self._origins) + self._eye
        return Motion(poses, place - self._pelvis)

    def vertices(self, garments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Garments' vertices (T, V, 3)."""
        turns, origins = np.swapaxes(self._turns, 1, 2), self._origins[:, None]
        return {name: (worn - origins) @ turns + self._eye for name, worn in garments.items()}


@contextmanager
def service() -> Iterator[str]:
    """A service of its own process on a free loopback port."""
    command = [sys.executable, "-m", "caphy.cli", "serve", "--host", "127.0.0.1", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        address = next((m[0] for line in process.stdout or () if (m := re.search(r"http://\S+:\d+", line))), None)
        if address is None:
            raise CaphyError("the service did not start; try 'caphy serve'")
        yield address
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
