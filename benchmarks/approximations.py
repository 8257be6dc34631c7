"""What each approximation of a garment's network costs in vertices and saves in bytes and time.

python -m benchmarks.approximations

The bundled avatar's garments; heads are fitted on some made-up motions, and errors are the worst of any vertex on
another one, against the network as it is stored (whose own error is in the avatar's manifest). One thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import tyro

from benchmarks.latency import milliseconds
from caphy.io.bundle import BundledGarment, read_bundle
from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion
from caphy.network.from_graph import network_of
from caphy.network.garment_network import GarmentNetwork
from export.again import head_of
from export.garment_graph import garment_graph
from export.head import Head, hidden_states, low_rank_head
from export.parity import single_thread_session
from service.engine import STREAMS
from service.settings import BUNDLED_AVATARS

Run = Callable[[np.ndarray, np.ndarray, np.ndarray], list[np.ndarray]]
FRAMES = 60


def float16(head: Head) -> Head:
    """The large factor as float16 holds it."""
    return head.rounded()


def int8(head: Head) -> Head:
    """The large factor in 127 steps to each side, of a size of its own for every blend shape."""
    step = np.maximum(np.abs(head.expand).max(axis=0), 1e-30) / 127  # a blend shape may be nothing at all
    return replace(head, expand=np.rint(head.expand / step) * step)


def fewer_influences(network: GarmentNetwork, most: int) -> GarmentNetwork:
    """The network with the ``most`` heaviest joints of every vertex only."""
    weights = network.weights.double().numpy()
    least = -np.sort(-weights, axis=1)[:, most - 1 : most]
    kept = np.where(weights >= np.maximum(least, 1e-9), weights, 0)
    found = GarmentNetwork(
        network.template.numpy(),
        kept / kept.sum(axis=1, keepdims=True),
        network.joints.numpy(),
        fps=network.fps,
        driving=network.driving,
    )
    found.gru.load_state_dict(network.gru.state_dict())
    return found


def variants(
    network: GarmentNetwork, stored: Head, hidden: np.ndarray
) -> Iterator[tuple[str, GarmentNetwork, Head, int]]:
    """Name, network, head and bytes of the head's large factor."""
    yield f"as stored (rank {stored.rank}, float16)", network, stored, 2 * stored.expand.size
    yield "head in int8", network, int8(stored), stored.expand.size
    for rank in (192, 128, 96, 64, 32):
        head = float16(low_rank_head(network, hidden, rank))
        yield f"head of rank {rank}", network, head, 2 * head.expand.size
    for most in (3, 2, 1):
        yield (
            f"{most} joint{'s' if most > 1 else ''} per vertex",
            fewer_influences(network, most),
            stored,
            2 * stored.expand.size,
        )


def vertices(run: Run, motion: PoseSequence, state_size: int) -> np.ndarray:
    """Of the whole motion (T, V, 3) [m]."""
    state = np.zeros(state_size, np.float32)
    return run(motion.poses.astype(np.float32), motion.transl.astype(np.float32), state)[0]


def runner(network: GarmentNetwork, head: Head) -> Run:
    """A function that runs the exported graph."""
    session = single_thread_session(garment_graph(network, head, "x").SerializeToString())
    return lambda poses, transl, state: session.run(None, {"poses": poses, "transl": transl, "state": state})


def together(run: Run, motion: PoseSequence, state_size: int) -> np.ndarray:
    """The motion (T, V, 3) as one of :data:`STREAMS` streams that are run together, frame by frame."""
    poses, transl = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    state, shown = np.zeros(STREAMS * state_size, np.float32), []
    for frame in range(len(poses)):
        rows = (frame - 5 * np.arange(STREAMS)) % len(poses)
        found, state = run(poses[rows], transl[rows], state)
        shown.append(found[0])
    return np.stack(shown)


def compare(garment: BundledGarment, network: GarmentNetwork) -> None:
    """Print one garment's table."""
    hidden = hidden_states(network, [procedural_motion(seed, seconds=20.0) for seed in range(4)])
    held_out = procedural_motion(seed=11, seconds=10.0).resample(network.fps)
    exact, size = None, network.state_size
    print(f"\n{garment.name}, {len(garment.mesh.vertices):,} vertices")
    print(f"  {'':34}{'worst vertex':>14}{'head':>10}{'1 frame':>12}{'of 60, each':>14}")
    for name, changed, head, count in variants(network, head_of(garment), hidden):
        run = runner(changed, head)
        shown = vertices(run, held_out, size)
        exact = shown if exact is None else exact
        error = 1e3 * float(np.linalg.norm(shown - exact, axis=-1).max())
        one, many = (_each(run, frames, size) for frames in (1, FRAMES))
        print(f"  {name:34}{error:11.4f} mm{count / 1e6:7.1f} MB{one:9.3f} ms{many:11.3f} ms")
    run = runner(network, head_of(garment))
    assert exact is not None
    error = 1e3 * float(np.linalg.norm(together(run, held_out, size) - exact, axis=-1).max())
    print(
        f"  {f'{STREAMS} streams together':34}{error:11.4f} mm{'':10}{_each(run, 1, size, STREAMS):9.3f} ms each stream"
    )


def _each(run: Run, frames: int, state_size: int, streams: int = 1) -> float:
    """Median milliseconds for each frame."""
    motion = procedural_motion(seed=3, seconds=4)
    poses, transl = (
        np.repeat(array[:frames].astype(np.float32), streams, axis=0) for array in (motion.poses, motion.transl)
    )
    state = np.zeros(streams * state_size, np.float32)
    return milliseconds(lambda: run(poses, transl, state), 0.6)[0] / (frames * streams)


def main() -> None:
    """Every garment of the bundled avatar."""
    bundle = read_bundle(BUNDLED_AVATARS / "default")
    for garment in bundle.garments:
        compare(garment, network_of(garment, bundle.joints, bundle.fps))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
