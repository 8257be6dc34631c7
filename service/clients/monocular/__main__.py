"""``python -m service.clients.monocular``: from a video to the same video dressed."""

from __future__ import annotations

import argparse
import hashlib
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import caphy
from caphy.conditioning import Conditioning
from caphy.errors import CaphyError
from caphy.garment.template import write_npz
from caphy.io.bundle import MANIFEST, AvatarBundle, read_bundle
from caphy.io.places import writable_file
from caphy.io.poses import PoseSequence, write_poses
from service.client import Client
from service.clients.feed import FeedClient
from service.clients.monocular.dressing import Dressing, Wardrobe, open_wardrobe
from service.clients.monocular.estimator import Estimator
from service.clients.monocular.landmarks import Landmarks, MediapipeDetector, PeopleCounter
from service.clients.monocular.live import FEED, LiveWardrobe
from service.clients.monocular.overlay import Overlay
from service.clients.monocular.run import Record, run
from service.clients.monocular.video import Video

BUNDLE = Path(caphy.__file__).parent / "data" / "avatars" / "default"


def main(arguments: list[str] | None = None) -> int:
    """Run the client; returns the exit status: 0 where somebody was dressed, 1 otherwise."""
    options = _options(arguments)
    try:
        return _run(options)
    except CaphyError as error:
        print(f"monocular: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m service.clients.monocular", description=__doc__)
    parser.add_argument("video", help="a video file, or a camera's number such as 0")
    parser.add_argument("-o", "--out", type=Path, help="the dressed video to write (.mp4)")
    parser.add_argument(
        "--live", nargs="?", const=FEED, metavar="FEED", help=f"show it in the service's page, on a feed ({FEED!r})"
    )
    parser.add_argument("--service", default="http://127.0.0.1:8000", help="address of 'caphy serve'")
    parser.add_argument("--key", help="API key, where the service wants one")
    parser.add_argument("--bundle", type=Path, default=BUNDLE, help="the folder of the avatar that the service serves")
    parser.add_argument("--focal", type=float, help="focal length [pixels]; the picture's diagonal where not given")
    parser.add_argument("--latency", type=float, default=Conditioning().latency, help="of the conditioning [s]")
    parser.add_argument("--poses", type=Path, help="also write the conditioned poses (.npz), for 'caphy poses'")
    parser.add_argument("--record", type=Path, help="also write what every picture gave (.npz), for the benchmark")
    parser.add_argument(
        "--seconds", type=float, default=np.inf, help="stop after so much of the video; Ctrl-C stops a camera"
    )
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    if not options.seconds > 0:
        raise CaphyError(f"--seconds must be positive, got {options.seconds:g}")
    for place, suffix in ((options.out, ".mp4"), (options.poses, ".npz"), (options.record, ".npz")):
        if place is not None:  # a video takes long, and must not be written over while it is read
            writable_file(place, suffix, inputs=[options.video])
    video = Video(options.video)
    bundle = read_bundle(options.bundle)
    version = hashlib.sha256((options.bundle / MANIFEST).read_bytes()).hexdigest()[:12]
    avatar = _served(options.service, bundle, version, options.key)
    focal = options.focal or float(np.hypot(*video.size))
    if not 50 < focal < 1e5:
        raise CaphyError(
            f"--focal must be a focal length in pixels, such as {np.hypot(*video.size):.0f}, got {focal:g}"
        )
    detector, counter = MediapipeDetector(), PeopleCounter()
    estimator = Estimator(bundle.joints, detector, focal, video.size)
    settings = Conditioning(fps=bundle.fps, latency=options.latency)
    wardrobe = _wardrobe(options, avatar, bundle)
    partial = None if options.out is None else options.out.with_name(f".{options.out.stem}.partial.mp4")
    writer, show = _writer(partial, video)
    overlay = Overlay(bundle, focal, video.size) if options.out else None
    dressing = Dressing(wardrobe, settings)
    try:
        with _ended_by_ctrl_c(video):
            record = run(video, estimator, dressing, overlay, show, counter, options.seconds)
    finally:
        if writer is not None and partial is not None:
            writer.release()
            partial.replace(options.out)
        wardrobe.close()
        detector.close()
        counter.close()
    return _finish(options, video, bundle, estimator, dressing, record, wardrobe.name)


@contextmanager
def _ended_by_ctrl_c(video: Video) -> Iterator[None]:
    """The first Ctrl-C ends a camera's pictures, which nothing else does, and what they gave is written; the second
    ends the program, as the first does with a file."""
    if not video.is_camera:
        yield
        return

    def stop(*_: object) -> None:
        video.stop()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _wardrobe(options: argparse.Namespace, avatar: str, bundle: AvatarBundle) -> Wardrobe:
    """Who dresses: the service for what is drawn here, its page for what is shown there."""
    if not options.live:
        return open_wardrobe(options.service, avatar, bundle.fps, options.key)
    feed = FeedClient(options.service, avatar, options.live, fps=bundle.fps, key=options.key)
    print(f"open {feed.page}", flush=True)
    drawn = open_wardrobe(options.service, avatar, bundle.fps, options.key) if options.out else None
    return LiveWardrobe(feed, bundle, drawn)


def _served(url: str, bundle: AvatarBundle, version: str, key: str | None = None) -> str:
    """The id under which the service serves a bundle of this version, or the only one with its garments."""
    offered = Client(url, key=key).avatars()
    garments = {garment.name: len(garment.mesh.vertices) for garment in bundle.garments}
    alike = [a for a in offered if {g["name"]: g["vertices"] for g in a["garments"]} == garments]
    same = [avatar for avatar in alike if avatar["version"] == version]
    if same or len(alike) == 1:
        return (same or alike)[0]["id"]
    if alike:
        raise CaphyError(
            f"{url}: serves {', '.join(avatar['id'] for avatar in alike)}, all with the garments of {bundle.name!r}, "
            "and none is the one drawn here; give the folder of the avatar it serves with --bundle"
        )
    raise CaphyError(
        f"{url}: serves {', '.join(avatar['id'] for avatar in offered)}, none of which has the garments of "
        f"{bundle.name!r}; give the folder of the avatar it serves with --bundle"
    )


def _writer(out: Path | None, video: Video) -> tuple[Any, Callable[[np.ndarray, float], None]]:
    if out is None:
        return None, lambda pixels, time: None
    out.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), video.fps, video.size)
    if not writer.isOpened():
        raise CaphyError(f"{out}: opencv cannot write this; is its folder full, or does its name have odd characters?")
    written = 0

    def show(pixels: np.ndarray, time: float) -> None:
        nonlocal written
        while written < round(time * video.fps) + 1:  # the file has one rate, the pictures may not
            writer.write(pixels)
            written += 1

    return writer, show


def _finish(
    options: argparse.Namespace,
    video: Video,
    bundle: AvatarBundle,
    estimator: Estimator,
    dressing: Dressing,
    record: Record,
    how: str,
) -> int:
    """Write what was asked for, say what happened."""
    counts = estimator.counts
    for note in _notes(video, estimator, record):
        print(f"note: {note}")
    if counts["pictures"] == counts["nobody"] + counts["no body"]:
        raise CaphyError(
            f"{video.source}: nobody was found in {counts['pictures']} pictures; the person must be seen from head to "
            "feet, and be at least a quarter of the picture's height"
        )
    did = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in dressing.conditioner.summary.frames.items())
    frames = record.frames
    if not frames:
        raise CaphyError(f"{video.source}: none of its poses could be used{f' ({did})' if did else ''}")
    if options.poses:
        poses, transl = np.stack([f.poses for f in frames]), np.stack([f.transl for f in frames])
        write_poses(
            PoseSequence(poses, transl, bundle.fps, source=video.source, pelvis=bundle.joints[0]), options.poses
        )
    if options.record:
        _write_record(options.record, record)
    print(
        f"{counts['pictures']} pictures, {len(frames)} frames dressed over {how}"
        f"{f' ({did})' if did else ''}; {counts['pictures'] / record.seconds:.1f} pictures a second "
        f"({1e3 * record.processor / counts['pictures']:.0f} ms of the processor each), "
        f"{1e3 * dressing.conditioner.settings.latency:.0f} ms of latency added"
    )
    if options.out:
        print(f"written: {options.out}")
    return 0


def _notes(video: Video, estimator: Estimator, record: Record) -> list[str]:
    counts = estimator.counts
    notes = list(video.notes)
    missed = counts["nobody"] + counts["no body"]
    if 0 < missed < counts["pictures"]:
        notes.append(f"nobody was found in {missed} of {counts['pictures']} pictures; the clothes hold, then rest")
    crowd = [people for people in record.people if people > 1]
    if len(crowd) > 1:  # once may be a mistake
        notes.append(f"there are {max(crowd)} people; only one is followed, the one found first")
    if counts["cuts"]:
        notes.append(f"{counts['cuts']} cuts between scenes; each begins anew")
    if counts["jumps"]:
        notes.append(f"the person was found somewhere else at once, {counts['jumps']}x; taken for somebody else")
    if not estimator.gravity.by_lines:
        notes.append(
            "no vertical lines were found; up is how the person stands in the mean, which may be off by 10 deg"
        )
    return notes


def _write_record(path: Path, record: Record) -> None:
    """Times, landmarks and poses (NaN where nobody was seen), the camera's turns, and frames, as plain arrays."""
    estimates, frames = record.estimates, record.frames
    nobody = np.full((55, 3), np.nan)
    nothing = Landmarks(np.full((33, 2), np.nan), np.full((33, 3), np.nan), np.zeros(33))
    told = {
        "time": np.array([e.time for e in estimates]),
        "poses": np.stack([nobody if e.poses is None else e.poses for e in estimates]),
        "transl": np.stack([nobody[0] if e.transl is None else e.transl for e in estimates]),
        "pixels": np.stack([(seen or nothing).pixels for seen in record.seen]),
        "world": np.stack([(seen or nothing).world for seen in record.seen]),
        "visibility": np.stack([(seen or nothing).visibility for seen in record.seen]),
        "turn": np.stack([e.turn for e in estimates]),
        "origin": np.stack([e.origin for e in estimates]),
        "frame_time": np.array([f.time for f in frames]),
        "frame_poses": np.stack([f.poses for f in frames]),
        "frame_transl": np.stack([f.transl for f in frames]),
        "seconds": np.array(record.seconds),
        "processor": np.array(record.processor),
    }
    write_npz(path, told, compressed=False)


if __name__ == "__main__":
    sys.exit(main())
