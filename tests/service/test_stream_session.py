"""What a stream answers, skips and remembers, without sockets: against the engines run on the whole motion."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle
from caphy.io.poses import PoseSequence
from service.avatars import Avatar
from service.encodings import Encoding
from service.metrics import Metrics, Stages
from service.stream.clock import CausalClock
from service.stream.limits import StreamLimits, read_limits
from service.stream.messages import Credit, Dressed, GetState, Hello, Poses, Rate, Reset, ServerDecoder, State
from service.stream.scheduler import Member, advance
from service.stream.session import QUEUE, Session

STAGES = Stages(Metrics().stream_seconds)


@pytest.fixture(scope="module")
def avatar(bundle: AvatarBundle) -> Avatar:
    return Avatar("shell", bundle, 8)


@pytest.fixture(scope="module")
def whole(avatar, motion) -> dict[str, np.ndarray]:
    arrays = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    return {name: e.run(*arrays, e.initial_state())[0] for name, e in avatar.engines.items()}


class Client:
    """A session, run by hand as the scheduler runs it."""

    def __init__(self, avatar: Avatar, limits: StreamLimits | None = None, **hello) -> None:
        hello = {"garments": (), "fps": 30.0, "credits": 2, **hello}
        self.session = Session(avatar, Hello(**hello), limits or StreamLimits())
        self.decoder = ServerDecoder(hello.get("encoding", Encoding.FLOAT32), hello.get("normals", False))
        self.decoder.counts = {garment.name: garment.count for garment in self.session.welcome().garments}
        self.sent: list[bytes] = []
        self.errors: list[Exception] = []
        self.member = Member(self.session, self.sent.append, lambda: True, self.errors.append)

    def send(self, motion: PoseSequence, first: int, count: int = 1, number: int | None = None) -> None:
        part = slice(first, first + count)
        poses, transl = motion.poses[part].astype(np.float32), motion.transl[part].astype(np.float32)
        self.session.take(Poses(first + 1 if number is None else number, first / 7, poses, transl))

    def run(self, free: bool = True) -> list[Dressed | State]:
        """Everything that the server says now."""
        self.member.free = lambda: free
        while advance([self.member], STAGES):
            pass
        found = [self.decoder.decode(body) for body in self.sent]
        self.sent.clear()
        assert all(isinstance(message, Dressed | State) for message in found)
        return found  # type: ignore[return-value]


def same(answer: Dressed | State, whole: dict[str, np.ndarray], first: int, atol: float = 5e-6) -> None:
    assert isinstance(answer, Dressed)
    for name, vertices in whole.items():
        np.testing.assert_allclose(
            answer.meshes.vertices[name], vertices[first : first + answer.meshes.frames], rtol=0, atol=atol
        )


def test_frame_by_frame_is_the_whole_motion(avatar, motion, whole):
    client = Client(avatar)
    for frame in range(12):
        client.send(motion, frame)
        (answer,) = client.run()
        same(answer, whole, frame)
        assert (answer.number, answer.tick, answer.time) == (frame + 1, frame, frame / 7)
        assert answer.skipped == 0
        client.session.take(Credit(1))


def test_a_chunk_is_answered_at_once(avatar, motion, whole):
    client = Client(avatar)
    client.send(motion, 0, 5)
    client.send(motion, 5, 7)
    first, second = client.run()
    assert (first.meshes.frames, second.meshes.frames, second.tick, second.number) == (5, 7, 5, 12)
    same(first, whole, 0)
    same(second, whole, 5)


def test_without_credits_nothing_is_answered_and_the_newest_wins(avatar, motion, whole):
    client = Client(avatar, credits=0)
    for frame in range(10):
        client.send(motion, frame)
    assert client.run() == []
    client.session.take(Credit(2))
    answers = client.run()
    assert [answer.tick for answer in answers] == [8, 9]
    assert [answer.skipped for answer in answers] == [8, 8]
    for answer in answers:  # skipped poses were lived: the state is that of a client who saw all
        same(answer, whole, answer.tick)


def test_more_messages_than_credits_skip_the_oldest(avatar, motion, whole):
    client = Client(avatar, credits=1)
    for frame in range(4):
        client.send(motion, frame)
    (answer,) = client.run()
    assert (answer.tick, answer.skipped) == (3, 3)
    same(answer, whole, 3)


def test_a_reader_that_takes_nothing_holds_no_more_than_a_few_frames(avatar, motion, whole):
    client = Client(avatar, credits=5)
    for turn in range(20):
        for frame in range(30):
            client.send(motion, frame, number=turn * 30 + frame + 1)
            assert client.run(free=False) == []
        assert client.session._frames <= 65
        assert len(client.session._queue) < QUEUE
    client.run()
    assert client.session.skipped > 500


@pytest.mark.parametrize("fps", [60.0, 120.0])
def test_poses_faster_than_the_avatars_do_not_fill_the_queue_before_a_credit_comes(avatar, motion, fps):
    client = Client(avatar, credits=0, fps=fps)
    for number in range(1, 2 * QUEUE + 1):
        client.send(motion, number % len(motion), number=number)
        assert client.run() == []
        assert not client.session.is_full  # or the credit behind them would not be read
    client.session.take(Credit(1))
    (answer,) = client.run()
    assert answer.number == 2 * QUEUE
    assert answer.skipped == 2 * QUEUE - 1


def test_a_state_asked_for_skips_nothing_that_has_a_credit(avatar, motion):
    client = Client(avatar, credits=5)
    for frame in range(3):
        client.send(motion, frame)
    client.session.take(GetState())
    assert client.run(free=False) == []
    assert [message.number for message in client.run()] == [1, 2, 3, 3]
    assert client.session.skipped == 0


def test_credits_are_capped(avatar, motion):
    client = Client(avatar, credits=65535)
    client.session.take(Credit(2**32 - 1))
    assert client.session._credits == StreamLimits().max_credits


def test_the_state_continues_in_another_session(avatar, motion, whole):
    first = Client(avatar)
    first.send(motion, 0, 9)
    first.session.take(GetState(4.5))
    _, state = first.run()
    assert isinstance(state, State)
    assert (state.number, state.time) == (9, 4.5)
    second = Client(avatar, state=state.state)
    second.send(motion, 9, 6)
    (answer,) = second.run()
    same(answer, whole, 9)
    assert answer.tick == 0


def test_the_state_comes_after_the_poses_before_it_even_without_credits(avatar, motion):
    client, other = Client(avatar, credits=0), Client(avatar)
    client.send(motion, 0, 3)
    client.session.take(GetState())
    client.send(motion, 3, 3)
    (state,) = client.run()
    other.send(motion, 0, 3)
    other.session.take(GetState())
    _, expected = other.run()
    np.testing.assert_allclose(state.state, expected.state, atol=1e-5)
    assert state.number == 3


def test_reset_starts_anew(avatar, motion, whole):
    client = Client(avatar)
    client.send(motion, 4, 6)
    client.run()
    client.session.take(Reset())
    client.session.take(Credit(2))
    client.send(motion, 0, 3)
    (answer,) = client.run()
    same(answer, whole, 0)
    assert answer.tick == 0


def test_poses_before_a_reset_are_not_computed(avatar, motion, whole):
    client = Client(avatar)
    client.send(motion, 4, 6)
    client.session.take(Reset())
    client.send(motion, 0, 3)
    (answer,) = client.run()
    same(answer, whole, 0)
    assert answer.skipped == 1


def test_the_newest_poses_wait_for_their_credit_though_the_state_was_asked_for(avatar, motion, whole):
    client = Client(avatar, credits=0)
    for frame in range(5):
        client.send(motion, frame)
    client.session.take(GetState())
    (state,) = client.run()
    assert (state.number, client.session.skipped) == (5, 4)
    client.session.take(Credit(1))
    (answer,) = client.run()
    assert (answer.tick, answer.number) == (4, 5)
    same(answer, whole, 4)
    client.send(motion, 5)
    client.session.take(GetState())
    client.run()
    client.send(motion, 6)  # newer poses replace what is kept
    client.session.take(Credit(1))
    (answer,) = client.run()
    assert (answer.tick, answer.skipped) == (6, 5)
    same(answer, whole, 6)


@pytest.mark.parametrize("fps", [24.0, 25.0, 60.0, 120.0, 29.97])
def test_other_rates_give_what_resampling_the_whole_gives(avatar, motion, fps):
    fast = motion.resample(fps)
    expected = fast.resample(30)
    client = Client(avatar, fps=fps, credits=64)
    answers = []
    for frame in range(0, len(fast), 3):
        client.send(fast, frame, 3)
        answers += client.run()
        client.session.take(Credit(1))
    arrays = expected.poses.astype(np.float32), expected.transl.astype(np.float32)
    engine = avatar.engines["tshirt"]
    whole = engine.run(*arrays, engine.initial_state())[0]
    found = np.concatenate([answer.meshes.vertices["tshirt"] for answer in answers])
    np.testing.assert_allclose(found[: len(whole)], whole, rtol=0, atol=2e-5)
    assert abs(len(found) - len(whole)) <= 1
    assert [a.tick for a in answers] == list(np.cumsum([0] + [a.meshes.frames for a in answers[:-1]]))


def test_a_change_of_rate_keeps_time(avatar, motion):
    """Every pose at 60 fps, then every second one at 30: the same ticks."""
    fast = motion.resample(60)
    one, two = Client(avatar, fps=60.0, credits=64), Client(avatar, fps=60.0, credits=64)
    one.send(fast, 0, 31)
    two.send(fast, 0, 17)
    two.session.take(Rate(30.0))
    poses, transl = fast.poses[18:31:2].astype(np.float32), fast.transl[18:31:2].astype(np.float32)
    two.session.take(Poses(18, 0.0, poses, transl))
    (expected,) = one.run()
    found = np.concatenate([answer.meshes.vertices["tshirt"] for answer in two.run()])
    np.testing.assert_allclose(found, expected.meshes.vertices["tshirt"], rtol=0, atol=5e-6)


def test_missing_numbers_are_filled_in_and_long_gaps_are_one_step(motion):
    clock = CausalClock(30.0, 30.0, 32)
    clock.take(1, motion.poses[:2], motion.transl[:2])
    ticks, moved = clock.take(5, motion.poses[4:5], motion.transl[4:5])
    assert len(ticks) == 3
    np.testing.assert_allclose(moved[1], (motion.transl[1] + 2 * motion.transl[4]) / 3, atol=1e-6)
    np.testing.assert_allclose(ticks[-1], motion.poses[4], atol=1e-5)
    ticks, _ = clock.take(500, motion.poses[5:6], motion.transl[5:6])
    np.testing.assert_allclose(ticks, motion.poses[5:6], atol=1e-6)


def test_numbers_must_rise_and_answers_stay_small(motion):
    clock = CausalClock(30.0, 10.0, 32)
    clock.take(7, motion.poses[:2], motion.transl[:2])
    with pytest.raises(CaphyError, match="after 8 came 8"):
        clock.take(8, motion.poses[:1], motion.transl[:1])
    with pytest.raises(CaphyError, match="at most 32"):
        clock.take(9, motion.poses[:20], motion.transl[:20])
    ticks, _ = clock.take(9, motion.poses[2:3], motion.transl[2:3])  # what was refused has not happened
    assert len(ticks) == 3


@pytest.mark.parametrize("encoding", list(Encoding))
def test_every_encoding(avatar, motion, whole, encoding):
    client = Client(avatar, encoding=encoding, garments=("trousers",))
    client.send(motion, 0, 4)
    (answer,) = client.run()
    if encoding is Encoding.WEIGHTS:
        assert answer.meshes.weights["trousers"].shape == (4, avatar.engines["trousers"].weight_count)
        engine = avatar.engines["trousers"]
        arrays = motion.poses[:4].astype(np.float32), motion.transl[:4].astype(np.float32)
        expected, _ = engine.blend(*arrays, engine.initial_state())
        np.testing.assert_allclose(answer.meshes.weights["trousers"], expected, rtol=2**-10, atol=1e-6)
    else:
        same(answer, {"trousers": whole["trousers"]}, 0, atol=5e-4)


@pytest.mark.parametrize(
    ("hello", "word"),
    [
        ({"garments": ("hat",)}, "no garment 'hat'"),
        ({"fps": 0.0}, "fps"),
        ({"fps": float("nan")}, "fps"),
        ({"state": np.zeros(3)}, "state"),
        ({"encoding": Encoding.WEIGHTS, "normals": True}, "GLB"),
    ],
)
def test_hellos_that_cannot_be_answered(avatar, hello, word):
    with pytest.raises(CaphyError, match=word):
        Client(avatar, **hello)


def test_states_that_are_not_finite(avatar):
    size = sum(engine.state_size for engine in avatar.engines.values())
    with pytest.raises(CaphyError, match="finite"):
        Client(avatar, state=np.full(size, np.nan))
    with pytest.raises(CaphyError, match=r"within 1.001, got 1e\+07"):
        Client(avatar, state=np.full(size, 1e7))


def test_poses_that_cannot_be_used_leave_the_stream_as_it_was(avatar, motion, whole):
    client = Client(avatar)
    client.send(motion, 0)
    bad = motion.poses[1:2].astype(np.float32)
    bad[0, 18, 1] = np.nan
    with pytest.raises(CaphyError, match="left_elbow"):
        client.session.take(Poses(2, 0.0, bad, np.zeros((1, 3), np.float32)))
    with pytest.raises(CaphyError, match="at most 32"):
        client.session.take(Poses(2, 0.0, np.zeros((33, 55, 3), np.float32), np.zeros((33, 3), np.float32)))
    with pytest.raises(CaphyError, match="at least one"):
        client.session.take(Poses(2, 0.0, np.zeros((0, 55, 3), np.float32), np.zeros((0, 3), np.float32)))
    client.send(motion, 1)
    first, second = client.run()
    same(first, whole, 0)
    same(second, whole, 1)


def test_frames_that_no_message_could_hold_are_not_promised(monkeypatch):
    monkeypatch.setenv("CAPHY_STREAM_MAX_FRAMES", "200")
    with pytest.raises(CaphyError, match=r"200 frames are \d+ bytes, .*; set CAPHY_STREAM_MAX_MESSAGE_BYTES=\d+"):
        read_limits()
    monkeypatch.setenv("CAPHY_STREAM_MAX_MESSAGE_BYTES", str(1 << 20))
    assert read_limits().max_frames == 200
