"""Conditioned requests and streams, over the wire and by hand: what is answered, and what is said of it."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from caphy.conditioning import Body, Conditioner, Conditioning, Did, condition
from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle
from caphy.rotations import matrix_from_axis_angle
from service.avatars import Avatar
from service.client import Client
from service.clients.stream import StreamClient, StreamRefused
from service.encodings import Encoding
from service.frames import FramesRequest
from service.metrics import Metrics, Stages
from service.protocol import decode_request, encode_request
from service.stream.limits import StreamLimits
from service.stream.messages import Credit, Hello, Poses, Reset, Seen, ServerDecoder, decode_client, encode_client
from service.stream.scheduler import Member, advance
from service.stream.session import Session

STAGES = Stages(Metrics().stream_seconds)


def expected(bundle: AvatarBundle, times, poses, transl, confidence=None, flush=True):
    """Frames by the library alone."""
    body = Body(bundle.joints, float(bundle.body.vertices[:, 1].min()))
    conditioner = Conditioner(Conditioning(fps=bundle.fps), body)
    frames = condition(conditioner, times, poses, transl, confidence)
    if not flush:
        frames = [frame for frame in frames if frame.time <= times[-1] - 0.06 + 1e-6]
    return frames


def dressed(bundle: AvatarBundle, frames, name="tshirt"):
    """Vertices of frames whose garments begin anew, settled, wherever they are reset."""
    engine = Avatar("shell", bundle, 8).engines[name]
    shown, state = [], engine.initial_state()
    for frame in frames:
        poses, transl = frame.poses[None].astype(np.float32), frame.transl[None].astype(np.float32)
        if Did.RESET in frame.did:
            held = np.repeat(poses, 30, axis=0), np.repeat(transl, 30, axis=0)
            state = engine.run(*held, engine.initial_state())[1]
        vertices, state = engine.run(poses, transl, state)
        shown.append(vertices[0])
    return np.array(shown)


@pytest.fixture(scope="module")
def lost(motion):
    """A second of a motion, then nobody for two seconds, then the rest 5 m away; at uneven times."""
    rng = np.random.default_rng(0)
    times = np.concatenate([np.arange(15), np.arange(15, 30) + 60]) / 30 + rng.uniform(-0.004, 0.004, 30)
    poses, transl = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    transl[15:, 0] += 5
    return times, poses, transl


def test_a_request_is_the_library_and_the_networks(url, bundle, motion):
    answered = Client(url).run("shell", motion, condition={})
    frames = expected(bundle, np.arange(len(motion)) / 30, motion.poses.astype("f4"), motion.transl.astype("f4"))
    assert answered.vertices["tshirt"] == pytest.approx(dressed(bundle, frames), abs=2e-5)
    said = answered.conditioning
    assert said is not None
    assert said["latency"] == 0.06
    assert said["settings"]["cutoff"] == 3.0
    assert said["emitted"] == len(frames) == answered.vertices["tshirt"].shape[0]
    assert said["did"][0] == [0, 0, Did.RESET]


def test_times_gaps_and_returns_over_http(http, bundle, lost):
    times, poses, transl = lost
    body = encode_request(FramesRequest(poses, transl, 30.0, np.zeros(0), times, np.ones(30)))
    back = decode_request(body)
    assert np.array_equal(back.times, times)
    assert back.confidence.shape == (30, 55)
    answer = http.post(
        "/avatars/shell/frames?condition=on&garment=tshirt",
        content=body,
        headers={"content-type": "application/octet-stream"},
    )
    assert answer.status_code == 200, answer.text
    said = json.loads(answer.headers["caphy-conditioning"])
    frames = expected(bundle, times, poses, transl)
    assert said["emitted"] == len(frames)
    assert said["frames"]["held"] > 5
    assert said["frames"]["resting"] > 30
    assert said["frames"]["reset"] == 2
    flags = np.zeros(len(frames), int)
    for first, last, did in said["did"]:
        flags[first : last + 1] = did
    assert flags.tolist() == [int(frame.did) for frame in frames]
    shown = np.frombuffer(answer.content, "<f4", offset=20 + 48)[: dressed(bundle, frames).size]
    assert shown.reshape(len(frames), -1, 3) == pytest.approx(dressed(bundle, frames), abs=2e-5)


def test_the_garment_does_not_pop_on_return(bundle, lost):
    """Seen from the root, the garment of the first frame after the return is that of the last frame before it."""
    times, poses, transl = lost
    frames = expected(bundle, times, poses, transl)
    again = next(i for i, frame in enumerate(frames) if i and Did.RESET in frame.did)
    worn = dressed(bundle, frames)
    speeds = np.linalg.norm(np.diff(worn, axis=0), axis=-1).max(axis=1)
    own = []
    for i in (again - 1, again):
        root = matrix_from_axis_angle(frames[i].poses[0])
        own.append((worn[i] - frames[i].transl - bundle.joints[0]) @ root)
    assert np.linalg.norm(own[1] - own[0], axis=-1).max() < 0.02
    assert np.delete(speeds, again - 1).max() * 30 < 8


def test_json_says_what_was_done(http, motion):
    asked = {"fps": 30, "poses": motion.poses[:4].tolist(), "times": [0, 0.033, 0.033, 0.1], "confidence": [1, 1, 1, 1]}
    answer = http.post("/avatars/shell/frames?condition=on", json=asked)
    assert answer.status_code == 200, answer.text
    assert answer.json()["conditioning"]["refused"] == {"time stamp": 1}
    assert answer.json()["frames"] == 4
    assert json.loads(answer.headers["caphy-conditioning"])["refused"] == {"time stamp": 1}


def test_off_unless_asked_for_and_said(http, motion):
    asked = {"fps": 30, "poses": motion.poses[:4].tolist()}
    for query in ("", "?condition=off"):
        answer = http.post(f"/avatars/shell/frames{query}", json=asked)
        assert answer.headers["caphy-conditioning"] == "off"
        assert "conditioning" not in answer.json()


@pytest.mark.parametrize(
    ("query", "extra", "words"),
    [
        ("?condition=maybe", {}, "on, off, or settings"),
        ('?condition={"cutoff":-1}', {}, "cutoff must lie"),
        ('?condition={"fps":60}', {}, "fps is the avatar's"),
        ("?condition=[1]", {}, "settings in JSON"),
        ('?condition={"frame":"camera","up":[1' + 400 * "0" + ",0,0]}", {}, "up must be a direction"),
        ("", {"times": [0, 1, 2, 3]}, "ask for it"),
        ("?condition=on", {"times": [0, 1]}, "one for each pose"),
        ("?condition=on", {"confidence": [1, 1]}, "confidence: must have shape"),
        ("?condition=on", {"confidence": [0, 0, 0, 0]}, "nobody was seen"),
        ("?condition=on", {"times": [0, 9, 18, 27]}, "at most"),
        ("?condition=on", {"confidence": [1, 1, 1.5, 1]}, "got 1.5 at frame 2"),
        ("?condition=on", {"confidence": [[1] * 55, [1] * 18 + [-1] * 37] * 2}, "frame 1, joint 18 (left_elbow)"),
        ("?condition={}" + 1999 * " ", {}, "may have 2000 characters, got 2001"),
    ],
)
def test_what_cannot_be_conditioned_is_refused_in_words(http, motion, query, extra, words):
    asked = {"fps": 30, "poses": motion.poses[:4].tolist(), **extra}
    answer = http.post(f"/avatars/shell/frames{query}", json=asked)
    assert answer.status_code in (413, 422)
    assert words in answer.json()["detail"]


def conditioned_request(http, poses, transl, times=None, confidence=None, settings="on"):
    return http.post(
        f"/avatars/shell/frames?condition={settings}&garment=tshirt",
        content=encode_request(FramesRequest(poses, transl, 30.0, np.zeros(0), times, confidence)),
        headers={"content-type": "application/octet-stream"},
    )


def test_frames_are_counted_as_they_are_answered(http, motion):
    """At most as many as there are poses, but where nobody is seen at first there are fewer."""
    unseen = {"fps": 30, "poses": np.repeat(motion.poses[:1], 150, 0).tolist(), "confidence": [0.0] * 100 + [1.0] * 50}
    unseen["transl"] = np.repeat(motion.transl[:1], 150, 0).tolist()

    def counted() -> float:
        told = re.search(r'caphy_frames_total\{avatar="shell"\} ([0-9.e+]+)', http.get("/metrics").text)
        return 0.0 if told is None else float(told[1])

    before = counted()
    answer = http.post("/avatars/shell/frames?condition=on&garment=tshirt", json=unseen)
    assert answer.status_code == 200, answer.text
    frames = len(answer.json()["garments"]["tshirt"]["vertices"])
    assert frames <= 60 and counted() - before == frames


@pytest.mark.parametrize("leap", [95.0, 1.7e9])
def test_silences_make_no_frames(http, motion, leap):
    times = np.r_[np.arange(15), np.arange(15) + 30 * leap] / 30
    answer = conditioned_request(http, motion.poses, motion.transl, times, settings='{"latency":0.5}')
    assert answer.status_code == 200, answer.text
    assert json.loads(answer.headers["caphy-conditioning"])["emitted"] == 30


@pytest.mark.filterwarnings("error")
def test_times_beyond_any_clock_are_refused_without_a_warning(http, motion):
    for times in (np.r_[-1e308, np.arange(28) / 30, 1e308], 1.76e12 + np.arange(30) * 33.0):
        answer = conditioned_request(http, motion.poses, motion.transl, times)
        assert answer.status_code == 422
        assert "must be seconds" in answer.json()["detail"] and "milliseconds" in answer.json()["detail"]


def test_milliseconds_are_no_silence_on_a_stream(bundle):
    """A browser's Date.now(): refused in words, where each pose was left out for ever."""
    stream, poses = Stream(bundle), np.zeros((4, 55, 3), np.float32)
    with pytest.raises(CaphyError, match=r"must be seconds within .* are they milliseconds\? Divide by 1000"):
        stream.run(Seen(1, 0.0, poses, poses[:, 0], 1.76e12 + np.arange(4) * 33.0, np.ones((4, 55), np.float32)))


@pytest.mark.parametrize(("value", "word"), [(np.inf, "got inf"), (np.nan, "got nan"), (-np.inf, "got -inf")])
def test_confidences_that_are_none_name_frame_and_joint(http, motion, value, word):
    confidence = np.ones((30, 55))
    confidence[7, 18] = value
    answer = conditioned_request(http, motion.poses, motion.transl, confidence=confidence)
    assert answer.status_code == 422
    assert f"{word} at frame 7, joint 18 (left_elbow)" in answer.json()["detail"]


def test_a_conditioned_motion_that_is_too_long_is_told_of_the_stream(http):
    answer = conditioned_request(http, np.zeros((1801, 55, 3)), np.zeros((1801, 3)))
    assert answer.status_code == 413
    assert "where it is conditioned, use the stream" in answer.json()["detail"]


class Stream:
    """A conditioned session run by hand."""

    def __init__(self, bundle: AvatarBundle, settings: str = "on", **hello) -> None:
        self.session = Session(
            Avatar("shell", bundle, 8),
            Hello(("tshirt",), 30.0, credits=60, conditioning=settings, **hello),
            StreamLimits(),
        )
        self.decoder = ServerDecoder(Encoding.FLOAT32, False, conditioned=bool(settings))
        self.decoder.counts = {garment.name: garment.count for garment in self.session.welcome().garments}
        self.sent: list[bytes] = []
        self.errors: list[Exception] = []
        self.member = Member(self.session, self.sent.append, lambda: True, self.errors.append)

    def run(self, *messages):
        for message in messages:
            self.session.take(decode_client(encode_client(message)))
            while advance([self.member], STAGES):
                pass
        assert not self.errors
        found = [self.decoder.decode(body) for body in self.sent]
        self.sent.clear()
        return found


def seen(lost, first, count):
    times, poses, transl = lost
    part = slice(first, first + count)
    return Seen(first + 1, 0.0, poses[part], transl[part], times[part], np.ones((len(poses[part]), 55), np.float32))


@pytest.mark.parametrize("size", [1, 4])
def test_a_stream_is_the_whole_file(bundle, lost, size):
    """Lost and found again: any division into messages gives the frames and meshes of the whole."""
    stream = Stream(bundle)
    assert stream.session.welcome().latency == 0.06
    times, poses, transl = lost
    nobody = Seen(1, 0.0, poses[:1], transl[:1], times[14:15] + 0.8, np.zeros((1, 55), np.float32))
    messages = [seen(lost, first, min(size, 15 - first)) for first in range(0, 15, size)]
    messages += [Seen(100, *_fields(nobody, 0.0)), Seen(101, *_fields(nobody, 0.8)), Credit(60)]
    later = [seen(lost, first, size) for first in range(15, 30 - size + 1, size)]
    messages += [Seen(m.number + 200, m.time, m.poses, m.transl, m.times, m.confidence) for m in later]
    answers = stream.run(*messages)
    end = 15 + size * len(later)
    every = np.concatenate([times[:15], nobody.times, nobody.times + 0.8, times[15:end]])
    trust = np.array([1.0] * 15 + [0.0] * 2 + [1.0] * (end - 15))
    rows = [*range(15), 0, 0, *range(15, end)]
    frames = expected(bundle, every, poses[rows], transl[rows], trust, flush=False)
    did = np.concatenate([a.did for a in answers])
    assert did.tolist() == [int(frame.did) for frame in frames]
    assert any(flags & Did.RESTING for flags in did)
    worn = np.concatenate([a.meshes.vertices["tshirt"] for a in answers])
    assert worn == pytest.approx(dressed(bundle, frames), abs=2e-5)
    ticks = [a.tick for a in answers if a.meshes.frames]
    assert ticks == np.cumsum([0] + [a.meshes.frames for a in answers if a.meshes.frames])[:-1].tolist()
    assert [a.shown for a in answers if a.meshes.frames][-1] == pytest.approx(frames[-answers[-1].meshes.frames].time)


def _fields(message, later):
    return message.time, message.poses, message.transl, message.times + later, message.confidence


def test_numbers_give_times_where_there_are_none(bundle, motion):
    poses, transl = motion.poses.astype("f4"), motion.transl.astype("f4")
    stream = Stream(bundle)
    numbers = [1, 2, 3, 5, 6, 7]
    answers = stream.run(*(Poses(n, 0.0, poses[n : n + 1], transl[n : n + 1]) for n in numbers))
    assert sum(a.meshes.frames for a in answers) == 5
    assert all(a.did is not None for a in answers)
    (first, *_) = stream.run(Reset(), *(Poses(n, 0.0, poses[n : n + 1], transl[n : n + 1]) for n in range(20, 23)))[2:]
    assert first.tick == 0
    assert first.did[0] & Did.RESET


@pytest.mark.parametrize("reset", [True, False])
def test_a_motion_that_begins_anew_is_settled_though_hello_had_a_state(bundle, motion, reset):
    """After a reset, or of the state before a first frame."""
    poses, transl = motion.poses.astype("f4"), motion.transl.astype("f4")
    messages = [Poses(n, 0.0, poses[n : n + 1], transl[n : n + 1]) for n in range(1, 4)]
    size = Avatar("shell", bundle, 8).engines["tshirt"].state_size
    stream, fresh = Stream(bundle, state=np.full(size, 0.5 * reset, np.float32)), Stream(bundle)
    found, expected = stream.run(*[Reset()] * reset, *messages), fresh.run(*messages)
    assert found[-1].meshes.frames
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.meshes.vertices["tshirt"], other.meshes.vertices["tshirt"], atol=1e-6)


def test_times_are_for_conditioned_streams(bundle, lost):
    with pytest.raises(CaphyError, match="ask for conditioning"):
        Stream(bundle, "").run(seen(lost, 0, 1))


SPAN = np.arange(1, 32) * 0.97
"""Time stamps [s] of which each step is one that a stream fills in, and nearly as long as one that it does not."""


def test_full_messages_at_a_rate_just_below_the_avatars_are_taken(bundle, motion):
    """29.97 frames a second: 32 poses span 32.03 frames of the avatar's, from the pose before on."""
    poses, transl = np.repeat(motion.poses[:1], 32, 0).astype("f4"), np.repeat(motion.transl[:1], 32, 0).astype("f4")
    stream, sure = Stream(bundle), np.ones((32, 55), np.float32)
    for number in (1, 33, 65):
        stream.run(Seen(number, 0.0, poses, transl, (number + np.arange(32)) / 29.97, sure))


@pytest.mark.parametrize("times", [[0.5, 0.9, 1.2], SPAN, [*SPAN, 0.97], [0.97, np.nan, *SPAN[2:], np.nan]])
def test_times_that_make_too_many_frames_are_refused_whatever_their_order(bundle, motion, times):
    poses, transl = np.repeat(motion.poses[:1], 32, 0).astype("f4"), np.repeat(motion.transl[:1], 32, 0).astype("f4")
    count, sure = len(times), np.ones((32, 55), np.float32)
    stream = Stream(bundle)
    stream.run(Seen(1, 0.0, poses[:1], transl[:1], np.zeros(1), sure[:1]))
    with pytest.raises(CaphyError, match="span"):
        stream.run(Seen(2, 0.0, poses[:count], transl[:count], np.array(times), sure[:count]))
    later = stream.run(Seen(2, 0.0, poses, transl, np.arange(1, 33) / 30, sure), Credit(9))
    assert 28 <= sum(answer.meshes.frames for answer in later) <= 32


def test_what_waits_before_a_silence_counts_among_the_frames_of_a_message(bundle, motion):
    poses, transl = np.repeat(motion.poses[:1], 32, 0).astype("f4"), np.repeat(motion.transl[:1], 32, 0).astype("f4")
    stream, sure = Stream(bundle, '{"latency":0.5}'), np.ones((32, 55), np.float32)
    stream.run(Seen(1, 0.0, poses, transl, np.arange(32) / 30, sure))
    with pytest.raises(CaphyError, match="may span 32 frames"):
        stream.run(Seen(33, 0.0, poses, transl, np.r_[np.arange(32, 63), 200] / 30, sure))
    (answer,) = stream.run(Seen(33, 0.0, poses, transl, np.arange(200, 232) / 30, sure))
    assert answer.meshes.frames == 32


def test_a_stamp_that_does_not_rise_leaves_the_others_their_message(bundle, motion):
    poses, transl = motion.poses[:4].astype("f4"), motion.transl[:4].astype("f4")
    stream, sure = Stream(bundle), np.ones((4, 55), np.float32)
    (answer,) = stream.run(Seen(1, 0.0, poses, transl, np.array([5.0, 5.1, 5.2, 0.1]), sure))
    assert answer.meshes.frames == 5  # up to 5.2 s less the latency
    (answer,) = stream.run(Poses(5, 0.0, poses, transl))  # whose times go on after the last that rose
    assert answer.meshes.frames == 4
    assert [bool(flags & Did.REJECTED) for flags in answer.did] == [True, False, False, False]  # the old stamp


def test_a_message_that_is_refused_leaves_the_stream_as_it_was(bundle, motion):
    poses, transl = motion.poses[:8].astype("f4"), motion.transl[:8].astype("f4")
    times, sure = np.arange(8) / 30, np.ones((8, 55), np.float32)
    wrong = sure.copy()
    wrong[5] = 5
    stream, other = Stream(bundle), Stream(bundle)
    first = Seen(1, 0.0, poses[:4], transl[:4], times[:4], sure[:4])
    stream.run(first), other.run(first)
    with pytest.raises(CaphyError, match=r"pose 6: .*between 0.* got 5 at joint 0 \(pelvis\)"):
        stream.run(Seen(5, 0.0, poses[4:], transl[4:], times[4:], wrong[4:]))
    again = Seen(5, 0.0, poses[4:], transl[4:], times[4:], sure[4:])
    (found,), (expected,) = stream.run(again), other.run(again)
    assert found.did.tolist() == expected.did.tolist()
    np.testing.assert_array_equal(found.meshes.vertices["tshirt"], expected.meshes.vertices["tshirt"])


def test_the_client_over_a_socket(url, bundle, lost):
    times, poses, transl = lost
    with StreamClient(url, "shell", ["tshirt"], conditioning={}, credits=8) as stream:
        assert stream.welcome.latency == 0.06
        answers = []
        for i in range(10):
            stream.send(poses[i], transl[i], times[i])
            answers.append(stream.receive())
    frames = expected(bundle, times[:10], poses[:10], transl[:10], flush=False)
    worn = np.concatenate([a.meshes.vertices["tshirt"] for a in answers])
    assert worn == pytest.approx(dressed(bundle, frames), abs=2e-5)
    with pytest.raises(StreamRefused, match="cutoff must lie"):
        StreamClient(url, "shell", conditioning={"cutoff": 1e9})
