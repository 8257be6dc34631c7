"""Latency of one garment per pose: the exported graph, a straightforward graph, and torch, all on one thread.

python -m benchmarks.latency

Beside them floors for float32 on this core: reading once as many bytes as weights and output have, from wherever that
many bytes that are read again and again stay (a cache, as they do here); reading a layer's recurrent weights once for
every frame, because a frame needs the one before; and all multiplications at the speed of a large matrix product. Then
what the service adds (parse, encode), how long it takes to start, and what an avatar holds in memory.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
import tyro

from benchmarks._straightforward import straightforward_graph
from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.io.bundle import AvatarBundle, BundledGarment, SkinnedMesh
from caphy.io.procedural import procedural_motion
from caphy.network.garment_network import GarmentNetwork
from export.avatar import body_mesh
from export.garment_graph import garment_graph
from export.head import Head, hidden_states, low_rank_head, worst_error
from export.parity import single_thread_session
from service import protocol
from service.avatars import Avatar
from service.frames import Wanted, answer, require_valid
from service.huge_pages import onto_huge_pages
from service.settings import Settings

SIZES = (1000, 4424, 12000)
RANK = 64
CHUNK = Settings.model_fields["chunk_frames"].default
UPPER_BODY = ("pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar", "left_shoulder",
              "right_shoulder", "left_elbow", "right_elbow")  # fmt: skip


def shirt(count: int) -> GarmentNetwork:
    """A network of the paper's size on points around the upper body, with smooth blend shapes of a few centimetres."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    body = default_body("fine")
    owned = np.isin(body.weights.argmax(axis=1), [JOINT_NAMES.index(name) for name in UPPER_BODY])
    chosen = rng.choice(np.flatnonzero(owned), count)
    template = body.v_template[chosen] + rng.normal(size=(count, 3)) * 0.01
    network = GarmentNetwork(template, body.weights[chosen], body.joints)
    waves = torch.randn(256, 3) * 4
    with torch.no_grad():
        shapes = torch.sin(network.template @ waves.T + torch.rand(256))[:, None] * torch.randn(3, 256)
        network.head.weight.copy_((shapes * 0.02 / np.sqrt(256)).flatten(0, 1))
    return network


def shirt_avatar(network: GarmentNetwork, rank: int) -> AvatarBundle:
    """The bundled body in a shirt of that network."""
    head = low_rank_head(network, hidden_states(network, [procedural_motion(seconds=5)]), rank)
    count = len(network.template)
    faces = np.arange(count - count % 3).reshape(-1, 3)
    mesh = SkinnedMesh.from_dense(network.template.numpy(), faces, network.weights.double().numpy())
    content = garment_graph(network, head, "shirt").SerializeToString()
    body, joints = body_mesh(default_body("medium"))
    garment = BundledGarment("shirt", mesh, content, network.state_size)
    return AvatarBundle("bench", 30.0, joints, default_body("medium").parents, body, (garment,), "CC0")


def milliseconds(work: Callable[[], object], seconds: float = 1.5) -> tuple[float, float]:
    """Median and 99th percentile over runs in ``seconds``, after a few to warm up."""
    for _ in range(5):
        work()
    times, end = [], time.perf_counter() + seconds
    while len(times) < 20 or time.perf_counter() < end:
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times)), 1e3 * float(np.percentile(times, 99))


def chunked(run: Callable[..., list], inputs: dict[str, np.ndarray], chunk: int) -> None:
    """As the service runs it: a chunk of frames at a time."""
    state, frames = inputs["state"], len(inputs["poses"])
    for start in range(0, frames, chunk):
        part = slice(start, start + chunk)
        _, state = run(None, {"poses": inputs["poses"][part], "transl": inputs["transl"][part], "state": state})


def reading(count: int) -> float:
    """Seconds to read ``count`` bytes that were read before."""
    memory = np.ones(count // 4, np.float32)
    return min(_seconds(memory.max) for _ in range(30))


def product_speed() -> float:
    """Float32 operations per second of a large matrix product on one thread."""
    matrix = torch.ones(256, 256)
    return 2 * 256**3 / min(_seconds(lambda: matrix @ matrix) for _ in range(300))


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def touched(network: GarmentNetwork, head: Head, frames: int) -> tuple[int, int]:
    """Bytes of weights and output, and float32 operations of the matrix products, that ``frames`` frames need."""
    count, joints = len(network.template), int((network.weights != 0).any(0).sum())
    matrices = sum(p.numel() for name, p in network.gru.named_parameters() if "weight" in name)
    matrices += head.expand.size + head.reduce.size
    skinning = count * joints
    return 4 * (matrices + skinning + 3 * count * (frames + 1)), 2 * frames * (matrices + 12 * skinning)


def compare(count: int, speed: float) -> None:
    """Print the table for one garment size."""
    network = shirt(count)
    hidden = hidden_states(network, [procedural_motion(seed=1, seconds=10)])
    head = low_rank_head(network, hidden, RANK)
    error = worst_error(network, head, hidden_states(network, [procedural_motion(seed=2, seconds=10)]))
    fast = single_thread_session(garment_graph(network, head, "fast").SerializeToString())
    plain = single_thread_session(straightforward_graph(network).SerializeToString())
    onto_huge_pages()
    print(f"\n{count:,} vertices, {len(network.driving)} driving joints, head of rank {RANK}: "
          f"worst vertex {1e3 * error:.3f} mm from the full head on a held-out motion")  # fmt: skip
    print(f"  {'':38}{'1 frame: median':>16}{'p99':>8}{'ratio':>7}   {'of 60, each: median':>23}{'p99':>8}{'ratio':>7}")
    rows: dict[str, list[tuple[float, float]]] = {}
    for frames in (1, 60):
        for name, work in _works(network, fast.run, plain.run, frames).items():
            median, worst = milliseconds(work)
            rows.setdefault(name, []).append((median / frames, worst / frames))
    base = rows[next(iter(rows))]
    for name, ((one, one_worst), (many, many_worst)) in rows.items():
        print(f"  {name:38}{one:13.3f} ms{one_worst:8.3f}{one / base[0][0]:6.1f}x   "
              f"{many:20.3f} ms{many_worst:8.3f}{many / base[1][0]:6.1f}x")  # fmt: skip
    needed = {frames: touched(network, head, frames) for frames in (1, 60)}
    recurrent = network.gru.num_layers * reading(4 * 3 * network.gru.hidden_size**2)
    floors = {
        "floor: weights and output read": [reading(needed[frames][0]) / frames for frames in (1, 60)],
        "floor: recurrent weights, each frame": [recurrent, recurrent],
        "floor: multiplications": [needed[frames][1] / speed / frames for frames in (1, 60)],
    }
    for name, (one, many) in floors.items():
        print(f"  {name:38}{1e3 * one:13.3f} ms{'':8}{1e3 * one / base[0][0]:6.2f}x   "
              f"{1e3 * many:20.3f} ms{'':8}{1e3 * many / base[1][0]:6.2f}x")  # fmt: skip


def _works(
    network: GarmentNetwork, fast: Callable[..., list], plain: Callable[..., list], frames: int
) -> dict[str, Callable[[], object]]:
    """What is compared, by name."""
    motion = procedural_motion(seed=3, seconds=4)[:frames]
    inputs = {"poses": motion.poses.astype(np.float32), "transl": motion.transl.astype(np.float32)}
    inputs["state"] = np.zeros(network.state_size, np.float32)
    tensors = [torch.tensor(array) for array in inputs.values()]

    def eager() -> None:
        with torch.inference_mode():
            network(*tensors)

    chunks = {f"exported, in chunks of {chunk}": chunk for chunk in (CHUNK, 8)}
    return {
        **{name: lambda chunk=chunk: chunked(fast, inputs, chunk) for name, chunk in chunks.items()},
        "straightforward ONNX": lambda: plain(None, inputs),
        "torch eager": eager,
    }


def stages(count: int) -> None:
    """Print what a request in the service's own binary format takes, stage by stage."""
    avatar = Avatar("bench", shirt_avatar(shirt(count), RANK), CHUNK)
    engines, settings, motion = list(avatar.engines.values()), Settings(), procedural_motion(seed=3, seconds=4)
    for frames in (1, 60):
        part = motion[:frames]
        body = protocol.encode_request(protocol.FramesRequest(part.poses, part.transl, 30.0, np.zeros(0)))

        def parse(body: bytes = body) -> protocol.FramesRequest:
            request = protocol.decode_request(body)
            require_valid(request, settings, 30.0, engines[:1])
            return request

        request, parts = parse(), []
        for encoding in ("float32", "uint16"):
            response = answer(request, engines, 30.0, Wanted.of(encoding, False))
            parts.append((f"encode {encoding}", lambda response=response: protocol.encode_response(response)))
        works = [("parse", parse), ("infer", lambda request=request: answer(request, engines, 30.0)), *parts]
        said = ", ".join(f"{name} {milliseconds(work, 0.5)[0]:.3f} ms" for name, work in works)
        print(f"  {frames:2} frame{'s' if frames > 1 else ''} in a request: {said}")


def cold_start() -> None:
    """Print what the service says of its own start with the bundled avatar."""
    command = [sys.executable, "-m", "caphy.cli", "serve", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    try:
        process.stdout.readline()
        print("\nthe service with the bundled avatar:")
        for _ in range(2):
            print(f"  {process.stdout.readline().strip()}")
    finally:
        process.terminate()
        process.wait(timeout=30)


def main() -> None:
    """Every size, on one thread."""
    torch.set_num_threads(1)
    speed = product_speed()
    print("GRU 4 x 256, axis-angle poses to skinned vertices, one thread (the paper: 3-6 ms on an RTX 3090)")
    print(f"this core: {speed / 1e9:.0f} GFLOP/s in a matrix product; load before {os.getloadavg()[0]:.1f}")
    for count in SIZES:
        compare(count, speed)
    print("\nstages of a request, 4,424 vertices:")
    stages(4424)
    cold_start()


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
