"""Latency of one garment per pose: the exported graph, a straightforward graph, and torch, all on one thread.

python -m benchmarks.latency
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch

from benchmarks._straightforward import straightforward_graph
from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.io.procedural import procedural_motion
from caphy.network.garment_network import GarmentNetwork
from export.garment_graph import garment_graph
from export.head import hidden_states, low_rank_head, worst_error
from export.parity import single_thread_session

SIZES = (1000, 4424, 12000)
RANK = 64
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
    """As the service runs it: small chunks that stay in the cache."""
    state, frames = inputs["state"], len(inputs["poses"])
    for start in range(0, frames, chunk):
        part = slice(start, start + chunk)
        _, state = run(None, {"poses": inputs["poses"][part], "transl": inputs["transl"][part], "state": state})


def compare(count: int) -> None:
    """Print the table for one garment size."""
    network = shirt(count)
    hidden = hidden_states(network, [procedural_motion(seed=1, seconds=10)])
    head = low_rank_head(network, hidden, RANK)
    error = worst_error(network, head, hidden_states(network, [procedural_motion(seed=2, seconds=10)]))
    fast = single_thread_session(garment_graph(network, head, "fast").SerializeToString())
    plain = single_thread_session(straightforward_graph(network).SerializeToString())
    motion = procedural_motion(seed=3, seconds=4)
    print(f"\n{count:,} vertices, {len(network.driving)} driving joints, head of rank {RANK}: "
          f"worst vertex {1e3 * error:.3f} mm from the full head on a held-out motion")  # fmt: skip
    print(f"  {'':34}{'1 frame: median':>16}{'p99':>8}{'ratio':>7}   {'of 60, each: median':>23}{'p99':>8}{'ratio':>7}")
    rows: dict[str, list[tuple[float, float]]] = {}
    for frames in (1, 60):
        inputs = {
            "poses": motion.poses[:frames].astype(np.float32),
            "transl": motion.transl[:frames].astype(np.float32),
            "state": np.zeros(network.state_size, np.float32),
        }
        tensors = [torch.tensor(array) for array in inputs.values()]

        def eager(tensors: list[torch.Tensor] = tensors) -> None:
            with torch.inference_mode():
                network(*tensors)

        works: dict[str, Callable[[], object]] = {
            "exported, in chunks of 8": lambda i=inputs: chunked(fast.run, i, 8),
            "straightforward ONNX": lambda i=inputs: plain.run(None, i),
            "torch eager": eager,
        }
        for name, work in works.items():
            median, worst = milliseconds(work)
            rows.setdefault(name, []).append((median / frames, worst / frames))
    for name, ((one, one_worst), (many, many_worst)) in rows.items():
        base = rows["exported, in chunks of 8"]
        print(f"  {name:34}{one:13.3f} ms{one_worst:8.3f}{one / base[0][0]:6.1f}x   "
              f"{many:20.3f} ms{many_worst:8.3f}{many / base[1][0]:6.1f}x")  # fmt: skip


def main() -> None:
    """Every size, on one thread."""
    torch.set_num_threads(1)
    print("GRU 4 x 256, axis-angle poses to skinned vertices, one thread (the paper: 3-6 ms on an RTX 3090)")
    for count in SIZES:
        compare(count)


if __name__ == "__main__":
    main()
