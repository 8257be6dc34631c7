"""The graph against a reference in plain loops, written from the published formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from shell_avatar import random_network, shell, wiggle

from caphy.conventions import JOINT_PARENTS
from caphy.errors import CaphyError
from export.garment_graph import garment_graph
from export.head import Head, hidden_states, low_rank_head, smallest_head, with_head, worst_error
from export.kinematics_graph import chain, rotation_from_quaternion
from export.onnx_graph import OnnxGraph
from export.parity import check_parity, extreme_poses, random_poses, single_thread_session


def full_head(network) -> Head:
    weight, bias = (p.detach().double().numpy() for p in (network.head.weight, network.head.bias))
    return Head(weight, np.eye(weight.shape[1]), bias)


def rodrigues(a):
    angle = np.sqrt(a @ a)
    if angle == 0:
        return np.eye(3)
    x, y, z = a / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def reference(network, poses, transl):
    """Vertices (T, V, 3) from rest, one frame, layer, joint and vertex at a time, in float64."""
    p = {k: v.detach().double().numpy() for k, v in network.state_dict().items()}
    width, layers, fps = network.gru.hidden_size, network.gru.num_layers, network.fps
    hidden = [np.zeros(width) for _ in range(layers)]
    answer, before = [], []
    for t in range(len(poses)):
        local = [rodrigues(a) for a in poses[t].astype(np.float64)]
        root, at = local[0], transl[t].astype(np.float64)
        velocity = (at - before[-1][0]) * fps if t > 0 else np.zeros(3)
        acceleration = (velocity - before[-1][1]) * fps if t > 1 else np.zeros(3)
        turn = before[-1][2].T @ root if t > 0 else np.eye(3)
        spin = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2 * fps
        before.append((at, velocity, root))
        x = [np.concatenate([local[j][:, 0], local[j][:, 1]]) for j in network.driving]
        x += [root.T @ [0, -1, 0], np.clip(root.T @ velocity, -5, 5), np.clip(root.T @ acceleration / 10, -5, 5)]
        x = np.concatenate([*x, np.clip(spin / 3, -5, 5)])
        for i in range(layers):
            gi = p[f"gru.weight_ih_l{i}"] @ x + p[f"gru.bias_ih_l{i}"]
            gh = p[f"gru.weight_hh_l{i}"] @ hidden[i] + p[f"gru.bias_hh_l{i}"]
            r, z = (sigmoid(gi[k * width : (k + 1) * width] + gh[k * width : (k + 1) * width]) for k in (0, 1))
            new = np.tanh(gi[2 * width :] + r * gh[2 * width :])
            x = hidden[i] = (1 - z) * new + z * hidden[i]
        points = p["template"] + (p["head.weight"] @ x + p["head.bias"]).reshape(-1, 3)
        world = [np.eye(4) for _ in range(55)]
        for j, parent in enumerate(JOINT_PARENTS):
            step = np.eye(4)
            step[:3, :3] = local[j]
            step[:3, 3] = p["joints"][j] - (p["joints"][parent] if j else 0)
            world[j] = world[parent] @ step if j else step
        frame = np.empty_like(points)
        for v, point in enumerate(points):
            frame[v] = at
            for j in np.flatnonzero(p["weights"][v]):
                frame[v] += p["weights"][v, j] * (world[j] @ [*(point - p["joints"][j]), 1])[:3]
        answer.append(frame)
    return np.stack(answer)


def test_graph_follows_the_published_formulas():
    network = random_network(shell("tshirt"))
    motion = wiggle(0.4)
    session = single_thread_session(garment_graph(network, full_head(network), "tshirt").SerializeToString())
    poses, transl = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    state = np.zeros(network.state_size, np.float32)
    vertices, _ = session.run(None, {"poses": poses, "transl": transl, "state": state})
    expected = reference(network, poses, transl)
    rest = reference(network, np.zeros_like(poses[:1]), np.zeros((1, 3)))
    assert np.abs(expected - rest).max() > 0.1  # the motion moves it
    np.testing.assert_allclose(vertices, expected, atol=1e-5)


@pytest.mark.parametrize(("name", "width", "layers"), [("tshirt", 16, 1), ("trousers", 40, 2)])
def test_parity_on_random_and_extreme_poses(name, width, layers):
    network = random_network(shell(name), width=width, layers=layers)
    model = garment_graph(network, full_head(network), name).SerializeToString()
    parity = check_parity(model, network)
    assert parity.network < 1e-5
    assert parity.streaming < 1e-5


@pytest.mark.parametrize("parameter", ["gru.weight_hh_l2", "gru.bias_ih_l0", "head.bias", "joints", "weights"])
def test_parity_refuses_a_graph_of_another_network(parameter):
    network = random_network(shell("tshirt"))
    model = garment_graph(network, full_head(network), "tshirt").SerializeToString()
    tensor = network.state_dict()[parameter]
    with torch.no_grad():
        tensor.add_(0.01 * torch.randn_like(tensor))
    with pytest.raises(CaphyError, match="must answer as the network"):
        check_parity(model, network)


def test_any_chunks_give_the_same_stream():
    network = random_network(shell("tshirt"))
    session = single_thread_session(garment_graph(network, full_head(network), "tshirt").SerializeToString())
    poses, transl = random_poses(60, 5)
    state = np.zeros(network.state_size, np.float32)
    whole, end = session.run(None, {"poses": poses, "transl": transl, "state": state})
    parts = []
    for part in np.split(np.arange(60), [1, 2, 3, 10, 31]):
        vertices, state = session.run(None, {"poses": poses[part], "transl": transl[part], "state": state})
        parts.append(vertices)
    np.testing.assert_allclose(np.concatenate(parts), whole, atol=2e-6)
    np.testing.assert_allclose(state, end, atol=1e-4)


def test_streams_in_one_run_are_each_stream_alone():
    """Rows of all streams' first frames, then their second ones; some go on, others begin."""
    network = random_network(shell("tshirt"))
    session = single_thread_session(garment_graph(network, full_head(network), "tshirt").SerializeToString())
    streams, frames, before = 3, 4, 5
    inputs = [random_poses(before + frames, seed) for seed in range(streams)]
    zero, states, expected = np.zeros(network.state_size, np.float32), [], []
    for i, (poses, transl) in enumerate(inputs):
        first = {"poses": poses[:before], "transl": transl[:before], "state": zero}
        states.append(session.run(["next_state"], first)[0] if i != 1 else zero)
        rest = {"poses": poses[before:], "transl": transl[before:], "state": states[-1]}
        expected.append(session.run(None, rest))
    poses, transl = (np.stack([pair[k][before:] for pair in inputs], axis=1) for k in (0, 1))
    joined = {"poses": poses.reshape(-1, 55, 3), "transl": transl.reshape(-1, 3), "state": np.concatenate(states)}
    vertices, after = session.run(None, joined)
    vertices = vertices.reshape(frames, streams, -1, 3)
    for i, (alone, state) in enumerate(expected):
        np.testing.assert_allclose(vertices[:, i], alone, atol=2e-6)
        np.testing.assert_allclose(after.reshape(streams, -1)[i], state, atol=1e-5)


def test_quaternion_products_make_rotations():
    rng = np.random.default_rng(0)
    for axis_angle in rng.normal(size=(20, 3)):
        angle = np.linalg.norm(axis_angle)
        q = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis_angle / angle])
        rotation = np.outer(q, q).ravel() @ rotation_from_quaternion()
        np.testing.assert_allclose(rotation.reshape(3, 3), rodrigues(axis_angle), atol=1e-14)


def test_chain_holds_all_ancestors():
    assert chain([18], JOINT_PARENTS) == [0, 3, 6, 9, 13, 16, 18]


def test_extreme_poses_turn_every_joint_about_every_axis():
    poses, transl = extreme_poses()
    assert len(poses) == len(transl) == 2 + 165
    assert (np.abs(poses).max(axis=0) > 3).all()


def test_head_of_full_rank_is_exact_and_lower_rank_states_its_error():
    network = random_network(shell("tshirt"), width=48)
    hidden = hidden_states(network, [wiggle(seed=1)])
    held_out = hidden_states(network, [wiggle(seed=2)])
    assert worst_error(network, low_rank_head(network, hidden, 48), held_out) < 1e-9
    head = low_rank_head(network, hidden, 8)
    error = worst_error(network, head, held_out)
    exact = network.head(torch.tensor(held_out, dtype=torch.float32)).detach().numpy().reshape(len(held_out), -1, 3)
    approximate = (held_out @ head.reduce.T @ head.expand.T + head.bias).reshape(exact.shape)
    assert error == pytest.approx(np.linalg.norm(exact - approximate, axis=-1).max(), rel=1e-3)
    assert error > 1e-6


def test_head_keeps_the_tolerance_with_the_least_rank():
    network = random_network(shell("tshirt"), width=48)
    hidden = hidden_states(network, [wiggle(seed=1)])
    head, error = smallest_head(network, hidden, hidden, tolerance=1e-4)
    assert error <= 1e-4
    assert head.rank == 32  # of 48
    copied = with_head(network, head)
    np.testing.assert_allclose(copied.head.weight.detach().numpy(), head.expand @ head.reduce)


def test_head_without_a_usable_rank_is_refused():
    network = random_network(shell("tshirt"), width=8)
    hidden = hidden_states(network, [wiggle(seed=1)])
    with torch.no_grad():
        network.head.weight[0, 0] = torch.nan
    with pytest.raises((CaphyError, np.linalg.LinAlgError)):
        smallest_head(network, hidden, hidden)


def test_motions_are_streamed_at_the_networks_rate():
    network = random_network(shell("tshirt"), width=8)
    fast = replace(wiggle(1.0), fps=60.0)
    assert len(hidden_states(network, [fast])) == 15


def test_builder_checks_its_graph():
    graph = OnnxGraph()
    x = graph.input("x", ["frames", 3])
    graph.output(graph.node("Reshape", x, [-1, 7, 7, 7]), "y", ["frames"])
    with pytest.raises(Exception, match="shape"):
        graph.model("broken", "")
