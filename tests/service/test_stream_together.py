"""Streams computed together: each is answered as if it were alone, and fails alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import onnx
import pytest

from caphy.io.bundle import AvatarBundle, BundledGarment
from service.avatars import Avatar
from service.encodings import Encoding
from service.engine import STREAMS, GarmentEngine
from service.metrics import Metrics, Stages
from service.stream.limits import StreamLimits
from service.stream.messages import Dressed, Hello, Poses, Rate, ServerDecoder
from service.stream.scheduler import Member, advance
from service.stream.session import Session


@pytest.fixture(scope="module")
def avatar(bundle: AvatarBundle) -> Avatar:
    return Avatar("shell", bundle, 8)


def of_one_stream(garment: BundledGarment) -> BundledGarment:
    """As exports were before streams could be joined: the state's length stands in the graph."""
    model = onnx.load_from_string(garment.onnx)
    for tensor in (*model.graph.input, *model.graph.output):
        if tensor.name.endswith("state"):
            tensor.type.tensor_type.shape.dim[0].dim_value = garment.state_size
    return replace(garment, onnx=model.SerializeToString())


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("weights", [False, True])
def test_one_run_for_many_streams(bundle, motion, old, weights):
    garment = bundle.garment("tshirt")
    engine = GarmentEngine(of_one_stream(garment) if old else garment)
    arrays = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    alone = engine.blend if weights else engine.run
    count, frames = STREAMS + 3, 5
    states = np.stack([engine.initial_state()] * count)
    for frame in range(frames):
        rows = frame + np.arange(count) % 7  # streams at different places of the motion
        shown, states = engine.run_together(*(array[rows] for array in arrays), states, weights)
    for stream in range(count):
        part = slice(stream % 7, stream % 7 + frames)
        expected, state = alone(*(array[part] for array in arrays), engine.initial_state())
        size = max(1.0, np.abs(expected[-1]).max())  # of a blend shape's weight some tens
        np.testing.assert_allclose(shown[stream], expected[-1], atol=3e-6 * size)
        np.testing.assert_allclose(states[stream], state, atol=1e-5)


class Clients:
    """Some streams of one avatar, run by hand as the scheduler runs them."""

    def __init__(self, avatar: Avatar, hellos: list[Hello]) -> None:
        self.sessions = [Session(avatar, hello, StreamLimits()) for hello in hellos]
        self.sent: list[list[bytes]] = [[] for _ in hellos]
        self.failed: list[list[Exception]] = [[] for _ in hellos]
        self.metrics = Metrics()
        self.members = [
            Member(session, sent.append, lambda: True, failed.append)
            for session, sent, failed in zip(self.sessions, self.sent, self.failed, strict=True)
        ]

    def run(self) -> list[list[Dressed]]:
        stages = Stages(self.metrics.stream_seconds)
        busy = self.members
        while busy := advance(busy, stages):
            pass
        answers = []
        for session, sent in zip(self.sessions, self.sent, strict=True):
            decoder = ServerDecoder(session.wanted.encoding, session.wanted.normals)
            decoder.counts = {garment.name: garment.count for garment in session.welcome().garments}
            answers.append([decoder.decode(body) for body in sent])
            sent.clear()
        return answers


def poses(motion, first: int, count: int, number: int) -> Poses:
    part = slice(first, first + count)
    return Poses(number, 0.0, motion.poses[part].astype(np.float32), motion.transl[part].astype(np.float32))


def test_streams_of_every_kind_share_a_turn(avatar, motion):
    """Other garments, other encodings, chunks, and rates at which a message completes no tick."""
    hellos = [
        Hello((), 30.0, credits=9),
        Hello(("trousers",), 30.0, normals=True, credits=9),
        Hello((), 30.0, Encoding.WEIGHTS, credits=9),
        Hello(("tshirt",), 30.0, credits=9),
        Hello((), 60.0, credits=9),
    ]
    chunks = (1, 1, 1, 3, 1)
    together, alone = Clients(avatar, hellos), [Clients(avatar, [hello]) for hello in hellos]
    for turn in range(4):
        for i, session in enumerate(together.sessions):
            message = poses(motion, turn * chunks[i], chunks[i], 1 + turn * chunks[i])
            session.take(message)
            alone[i].sessions[0].take(message)
        for found, single in zip(together.run(), alone, strict=True):
            ((answer,), (expected,)) = found, single.run()[0]
            assert (answer.number, answer.tick, answer.meshes.frames) == (
                expected.number,
                expected.tick,
                expected.meshes.frames,
            )
            for kind in ("vertices", "normals", "weights"):
                arrays = getattr(expected.meshes, kind)
                assert set(getattr(answer.meshes, kind)) == set(arrays)
                atol = {"vertices": 3e-6, "normals": 0.01, "weights": 1e-3}[kind]
                for name, array in arrays.items():
                    np.testing.assert_allclose(getattr(answer.meshes, kind)[name], array, atol=atol)
    assert not any(together.failed)


def test_one_stream_that_fails_ends_alone(avatar, motion):
    """A state that drives its network out of the numbers spoils no neighbour's mesh."""
    clients, single = Clients(avatar, [Hello((), 30.0, credits=9)] * 3), Clients(avatar, [Hello((), 30.0, credits=9)])
    clients.sessions[1].states["tshirt"][:] = np.nan
    for session in (*clients.sessions, *single.sessions):
        session.take(poses(motion, 0, 1, 1))
    found, ((expected,),) = clients.run(), single.run()
    assert [len(answers) for answers in found] == [1, 0, 1]
    assert "finite" in str(clients.failed[1][0])
    for answers in (found[0], found[2]):
        for name, vertices in expected.meshes.vertices.items():
            np.testing.assert_allclose(answers[0].meshes.vertices[name], vertices, atol=3e-6)


def test_a_run_that_breaks_is_tried_stream_by_stream(avatar, motion, monkeypatch):
    clients = Clients(avatar, [Hello((), 30.0, credits=9)] * 3)
    engine = avatar.engines["tshirt"]
    run = engine.run

    def broken(*arrays: np.ndarray) -> None:
        raise RuntimeError("out of memory")

    def broken_once(poses: np.ndarray, transl: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return broken() if state[0] == 0.5 else run(poses, transl, state)

    monkeypatch.setattr(engine, "run_together", broken)
    monkeypatch.setattr(engine, "run", broken_once)
    clients.sessions[2].states["tshirt"][0] = 0.5
    for session in clients.sessions:
        session.take(poses(motion, 0, 1, 1))
    assert [len(answers) for answers in clients.run()] == [1, 1, 0]
    assert "out of memory" in str(clients.failed[2][0])


def test_stages_are_counted(avatar, motion):
    clients = Clients(avatar, [Hello((), 30.0, credits=9)] * 3)
    clients.sessions[0].take(Rate(30.0))
    for session in clients.sessions:
        session.take(poses(motion, 0, 1, 1))
    clients.run()
    text = clients.metrics.exposition().decode()
    for stage, count in (("infer", 1), ("encode", 1), ("answer", 3)):
        assert f'caphy_stream_seconds_count{{stage="{stage}"}} {count}.0' in text
