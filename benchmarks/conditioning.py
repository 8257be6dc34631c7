"""Noise on true poses, as estimators have it, and what conditioning leaves of it in the default avatar's clothes.

python -m benchmarks.conditioning [FOLDER_OF_POSE_FILES] [--seconds 8] prints, per kind of noise, the median over clips
(and the worst clip) of

  jitter   rms acceleration of garment vertices against those of the true poses, unfiltered, conditioned, their ratio
  error    mean distance of garment vertices from those of the true poses, unfiltered and conditioned
  latency  from a moment to its frame: stated, by time stamps (mean), and the shift of the motion itself that fits best
  speed    highest vertex speed over the true highest, conditioned; frames with more than three times of it

Without a folder, motions are made up. Clips that jump by themselves are left out. Garments are compared with garments
of the same moment: latency is no error here, it is told beside it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caphy.conditioning import Conditioner, Conditioning, Did, Frame
from caphy.conditioning.quaternions import between, exponential, logarithm, product, rotated
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence, read_poses
from caphy.io.poses.sequence import interpolate
from caphy.io.procedural import procedural_motion
from service.avatars import Avatar, load_avatars
from service.settings import BUNDLED_AVATARS

FPS = 30.0
BODY = np.arange(len(JOINT_NAMES)) < 22
SWAPPED = [
    JOINT_NAMES.index(n.replace("left", "*").replace("right", "left").replace("*", "right")) for n in JOINT_NAMES
]
WARM = 5
"""Frames at the beginning that are not scored: accelerations need three, the filter's first has no past."""


@dataclass(frozen=True)
class Noise:
    """What is done to true poses: rms error of each joint [degrees], its correlation from pose to pose, shares of
    poses that are flipped and dropped, and the clock's jitter [s]."""

    degrees: float
    correlation: float = 0.0
    flipped: float = 0.0
    dropped: float = 0.0
    clock: float = 0.0

    def __str__(self) -> str:
        extra = f", {self.flipped:.0%} flips, {self.dropped:.0%} dropped, clock" if self.flipped else ""
        return f"{self.degrees:g} deg {'AR ' + format(self.correlation, 'g') if self.correlation else 'white'}{extra}"


NOISES = (
    Noise(3),
    Noise(6),
    Noise(3, 0.8),
    Noise(6, 0.8),
    Noise(3, 0, 0.05, 0.2, 0.006),
    Noise(6, 0, 0.05, 0.2, 0.006),
    Noise(6, 0.8, 0.05, 0.2, 0.006),
)


@dataclass(frozen=True, eq=False)
class Seen:
    """Poses (T, 55, 3), transl (T, 3) and the times at which they were seen (T,) [s]."""

    times: np.ndarray
    poses: np.ndarray
    transl: np.ndarray


def true_at(clip: PoseSequence, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return interpolate(clip.poses, clip.transl, np.arange(len(clip)) / clip.fps, np.clip(times, 0, clip.duration))


def seen(clip: PoseSequence, noise: Noise, seed: int) -> Seen:
    """The clip as an estimator would see it at 30 Hz."""
    rng = np.random.default_rng(seed)
    count = int(clip.duration * FPS) + 1
    times = np.arange(count) / FPS + noise.clock * np.clip(rng.normal(size=count), -2, 2)
    times[0] = 0.0
    poses, transl = true_at(clip, times)
    errors = rng.normal(size=(count, len(JOINT_NAMES), 3)) * np.radians(noise.degrees) / np.sqrt(3) * BODY[:, None]
    for i in range(1, count):
        errors[i] = noise.correlation * errors[i - 1] + np.sqrt(1 - noise.correlation**2) * errors[i]
    turns = product(exponential(poses), exponential(errors))
    for i in np.flatnonzero(rng.random(count) < noise.flipped):
        turns[i] = flipped(turns[i], rng)
    kept = rng.random(count) >= noise.dropped
    kept[0] = True
    return Seen(times[kept], logarithm(turns)[kept], transl[kept])


def flipped(turns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A pose (55, 4) with left and right exchanged, the body turned round, or two limbs bent the other way."""
    kind = rng.integers(3)
    if kind == 0:
        return turns[SWAPPED] * np.array([1.0, 1.0, -1.0, -1.0])
    if kind == 1:
        return np.concatenate([product(np.array([0.0, 0.0, 1.0, 0.0]), turns[0])[None], turns[1:]])
    turns = turns.copy()
    for joint in rng.choice([1, 2, 16, 17], 2, replace=False):
        turns[joint] = product(exponential(np.array([rng.uniform(1.2, 2.2), 0.0, 0.0])), turns[joint])
    return turns


Filter = Callable[[Seen], tuple[list[Frame], list[float]]]
"""Frames at 30 Hz of what was seen, and when each was there [s]."""


def unfiltered(given: Seen) -> tuple[list[Frame], list[float]]:
    """What a stream without conditioning does: interpolation as soon as a pose at the time or later is there."""
    times = np.arange(int(given.times[-1] * FPS + 1e-6) + 1) / FPS
    poses, transl = interpolate(given.poses, given.transl, given.times, times)
    there = given.times[np.minimum(np.searchsorted(given.times, times - 1e-9), len(given.times) - 1)]
    return [Frame(*row) for row in zip(times, poses, transl, strict=True)], there.tolist()


def conditioned(given: Seen) -> tuple[list[Frame], list[float]]:
    conditioner = Conditioner(Conditioning(fps=FPS))
    frames: list[Frame] = []
    there: list[float] = []
    for time, poses, transl in zip(given.times, given.poses, given.transl, strict=True):
        frames += conditioner.push(time, poses, transl)
        there += [time] * (len(frames) - len(there))
    return frames, there


def one_euro(given: Seen, least: float = 1.0, slope: float = 0.3) -> tuple[list[Frame], list[float]]:
    """The One-Euro filter (Casiez et al., CHI 2012) on each joint's rotation, on what :func:`unfiltered` gives."""
    frames, there = unfiltered(given)
    turns = exponential(np.array([frame.poses for frame in frames]))
    value, speed = turns[0], np.zeros((len(JOINT_NAMES), 3))
    out = []
    for frame, turn in zip(frames, turns, strict=True):
        offset = between(value, turn)
        speed = speed + share(1.0) * (offset * FPS - speed)
        rate = share(least + slope * np.linalg.norm(speed, axis=-1, keepdims=True))
        value = rotated(value, rate * offset)
        out.append(Frame(frame.time, logarithm(value), frame.transl))
    return out, there


def share(cutoff: np.ndarray | float) -> np.ndarray | float:
    return 1 / (1 + FPS / (2 * np.pi * cutoff))


def dressed(avatar: Avatar, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Vertices (T, V, 3) of all garments, settled on the first pose."""
    poses, transl = (np.concatenate([np.repeat(a[:1], 30, 0), a]).astype(np.float32) for a in (poses, transl))
    runs = [engine.run(poses, transl, engine.initial_state())[0][30:] for engine in avatar.engines.values()]
    return np.concatenate(runs, axis=1).astype(np.float64)


@dataclass(frozen=True)
class Score:
    jitter: float
    error: float
    there: float
    shift: float
    speed: float
    fast: int


def score(avatar: Avatar, clip: PoseSequence, given: Seen, method: Filter) -> Score:
    frames, there = method(given)
    times = np.array([frame.time for frame in frames])
    worn = dressed(avatar, *(np.array([getattr(frame, name) for frame in frames]) for name in ("poses", "transl")))
    truth = dressed(avatar, *true_at(clip, times))
    anew = np.array([bool(frame.did & Did.RESET) for frame in frames[1:]])
    speed, true = (np.linalg.norm(np.diff(v, axis=0), axis=-1).max(axis=1) * FPS for v in (worn, truth))
    speed = np.where(anew, 0.0, speed)
    apart = np.diff(worn - truth, 2, axis=0)[WARM:] * FPS**2
    return Score(
        float(np.sqrt((apart**2).sum(-1).mean())),
        1e3 * float(np.linalg.norm(worn - truth, axis=-1)[WARM:].mean()),
        1e3 * float(np.mean(np.array(there) - times[: len(there)])),
        1e3 * shift(clip, frames),
        float(speed.max() / true.max()),
        int((speed > 3 * true.max()).sum()),
    )


def shift(clip: PoseSequence, frames: list[Frame]) -> float:
    """By how much later than its own time the motion of the frames is that of the truth [s]: best fit of rotations."""
    inner = frames[WARM:-WARM]
    turns = exponential(np.array([frame.poses for frame in inner])[:, BODY])
    times = np.array([frame.time for frame in inner])
    tried = np.arange(-0.1, 0.1001, 0.01)
    misfit = [
        float((between(turns, exponential(true_at(clip, times - late)[0][:, BODY])) ** 2).sum(-1).mean())
        for late in tried
    ]
    best = min(max(int(np.argmin(misfit)), 1), len(tried) - 2)
    a, b, c = misfit[best - 1 : best + 2]
    return float(tried[best] + 0.005 * (a - c) / max(a - 2 * b + c, 1e-12))


def clips(folder: Path | None, seconds: float) -> Iterator[tuple[str, PoseSequence]]:
    if folder is None:
        for seed in range(3):
            yield f"made up {seed}", procedural_motion(seed, seconds, 60.0)
        return
    for path in sorted(p for p in folder.rglob("*") if p.suffix in (".bvh", ".npz")):
        try:
            clip = read_poses(path)[: int(seconds * 120)]
        except CaphyError as error:
            print(f"left out: {error}")
            continue
        if clip.duration > 2.0 and not clip.jumps():
            yield path.stem, clip[: int(seconds * clip.fps)]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each clip")
    parser.add_argument("--clips", type=int, default=99, help="at most")
    arguments = parser.parse_args()
    (avatar,) = load_avatars(BUNDLED_AVATARS, 8).values()
    chosen = list(clips(arguments.folder, arguments.seconds))[: arguments.clips]
    print(f"{len(chosen)} clips, {sum(clip.duration for _, clip in chosen):.0f} s: {', '.join(n for n, _ in chosen)}")
    for noise in NOISES:
        given = [(clip, seen(clip, noise, seed)) for seed, (_, clip) in enumerate(chosen)]
        raw = [score(avatar, *pair, unfiltered) for pair in given]
        print(f"\n{noise}")
        for name, method in (("One-Euro", one_euro), ("conditioned", conditioned)):
            report(name, raw, [score(avatar, *pair, method) for pair in given])


def report(name: str, raw: list[Score], made: list[Score]) -> None:
    ratios = [r.jitter / m.jitter for r, m in zip(raw, made, strict=True)]
    waited = [m.there - r.there for r, m in zip(raw, made, strict=True)]
    parts = [
        f"jitter {_median(raw, 'jitter'):6.1f} -> {_median(made, 'jitter'):5.1f} m/s2",
        f"ratio {np.median(ratios):5.2f} (worst {min(ratios):5.2f})",
        f"error {_median(raw, 'error'):5.1f} -> {_median(made, 'error'):5.1f} mm",
        f"added latency {np.median(waited):5.1f} ms, shift {_median(made, 'shift'):5.1f} ms",
        f"speed {max(m.speed for m in made):5.2f} ({sum(m.fast for m in made)} frames over 3)",
        f"unfiltered {max(r.speed for r in raw):5.2f} ({sum(r.fast for r in raw)})",
    ]
    print(f"  {name:12}", "; ".join(parts), flush=True)


def _median(scores: list[Score], name: str) -> float:
    return float(np.median([getattr(score, name) for score in scores]))


if __name__ == "__main__":
    main()
