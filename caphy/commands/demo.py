"""``caphy demo``: the whole path once, with pictures."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from caphy.commands.output import OUTPUT
from caphy.errors import CaphyError
from caphy.io.places import writable_folder, write_bytes

if TYPE_CHECKING:
    from caphy.io.poses import PoseSequence
    from service.client import Client


@dataclass(frozen=True)
class Demo:
    """Serve an avatar, send it a motion, write an animated GLB and a contact sheet, and say how long a frame takes."""

    poses: Annotated[Path | None, tyro.conf.Positional] = None
    """A motion in any format caphy reads; a made-up one by default."""
    avatar: Path | None = None
    """An avatar bundle; by default the one that comes with the package."""
    output: Annotated[Path, OUTPUT] = Path("demo-out")
    """Folder to write avatar.glb and sheet.png into."""
    seconds: float = 8.0
    """At most so much of the motion [s]."""


def main(arguments: list[str]) -> None:
    """Run ``caphy demo`` with the arguments after it."""
    command = tyro.cli(Demo, prog="caphy demo", args=arguments)

    from caphy.io.bundle import read_bundle
    from caphy.io.bundled import bundled
    from service.client import Client
    from service.settings import BUNDLED_AVATARS

    if not 0 < command.seconds < float("inf"):
        raise CaphyError(f"--seconds must be positive and finite, got {command.seconds:g}")
    writable_folder(command.output)
    folder = bundled(command.avatar) if command.avatar else BUNDLED_AVATARS / "default"
    bundle = read_bundle(folder)
    motion = _motion(command, bundle.fps).about(bundle.joints[0])
    with _service(folder) as url:
        client = Client(url)
        avatar = client.avatars()[0]["id"]
        print(f"serving {avatar} on {url}; sending {len(motion)} frames at {motion.fps:g} fps: {motion.source}")
        client.frames(avatar, motion[:1])
        started = time.perf_counter()
        vertices = client.frames(avatar, motion)
        whole = 1e3 * (time.perf_counter() - started) / len(motion)
        inference = client.server_timing["infer"] / len(motion)
        single = _single_frames(client, avatar, motion[:60])
        client.close()

    garments = f"{len(vertices)} garment{'s' * (len(vertices) != 1)}"
    print(f"\nmilliseconds per frame, {garments}, {sum(v.shape[1] for v in vertices.values())} vertices:")
    print(f"  {'':28}{'inference':>12}{'round trip':>12}")
    print(f"  {'whole motion at once':28}{inference:12.2f}{whole:12.2f}")
    print(f"  {'one frame at a time, median':28}{single[0]:12.2f}{single[1]:12.2f}")
    _write(command.output, bundle, motion, vertices)
    print(f"\nnext: 'caphy serve', then http://127.0.0.1:8000/ shows it moving, /docs the API; 'caphy export {folder}'")
    print("with --format glb, usd, pc2 or obj for other programs; README.md for your own poses, garments and training")


def _motion(command: Demo, fps: float) -> PoseSequence:
    from caphy.io.poses import read_poses
    from caphy.io.procedural import procedural_motion

    if command.poses is None:
        return procedural_motion(seconds=command.seconds, fps=fps)
    return read_poses(command.poses).to_y_up().resample(fps)[: max(1, round(command.seconds * fps))]


def _single_frames(client: Client, avatar: str, motion: PoseSequence) -> np.ndarray:
    """Median milliseconds of inference and of the round trip when a motion is streamed frame by frame."""
    states, times = None, []
    for frame in range(len(motion)):
        started = time.perf_counter()
        states = client.run(avatar, motion[frame : frame + 1], states=states).states
        times.append((client.server_timing["infer"], 1e3 * (time.perf_counter() - started)))
    return np.median(times, axis=0)


def _write(out: Path, bundle, motion: PoseSequence, vertices: dict[str, np.ndarray]) -> None:
    from caphy.report.render import write_png
    from export.glb import animated_glb
    from export.sheet import motion_sheet

    made = animated_glb(bundle, motion.poses, motion.transl, vertices)
    write_bytes(out / "avatar.glb", made.content)
    print(
        f"\n{out / 'avatar.glb'}: animated, for any glTF viewer; {len(made.content) / 1e6:.1f} MB, vertices within "
        f"{1e3 * max(made.errors.values()):.2f} mm of the service's"
    )
    write_png(motion_sheet(bundle, motion.poses, motion.transl, vertices), out / "sheet.png")
    print(f"{out / 'sheet.png'}: contact sheet")


@contextmanager
def _service(avatars: Path) -> Iterator[str]:
    """A service of its own process on a free loopback port; stopped at the end."""
    command = [sys.executable, "-m", "caphy.cli", "serve", "--avatars", str(avatars)]
    command += ["--host", "127.0.0.1", "--port", "0"]
    own = {name: value for name, value in os.environ.items() if not name.upper().startswith("CAPHY_")}  # keys, limits
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=own)
    try:
        yield _address(process)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()


def _address(process: subprocess.Popen[str]) -> str:
    """The address a starting service prints; raises CaphyError with its words where it ends instead."""
    said = []
    for line in process.stdout or ():
        if match := re.search(r"http://\S+", line):
            return match[0]
        said.append(line)
    raise CaphyError(f"the service did not start: {''.join(said).strip()}")
