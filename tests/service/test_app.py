"""The endpoints, and everything a client can get wrong."""

from __future__ import annotations

import asyncio
import io
import struct

import numpy as np
import pytest
import trimesh
from fastapi.testclient import TestClient
from pydantic import ValidationError

from caphy.errors import CaphyError
from service.app import create_app
from service.frames import same_rate
from service.observe import Observed
from service.protocol import MEDIA_TYPE, FramesRequest, decode_response, encode_request
from service.settings import Settings, read_settings

FRAMES = "/avatars/shell/frames"
BINARY = {"content-type": MEDIA_TYPE}
JSON = {"content-type": "application/json"}


def body_of(motion, fps=None, state=(), **changes) -> bytes:
    request = FramesRequest(
        changes.get("poses", motion.poses),
        changes.get("transl", motion.transl),
        motion.fps if fps is None else fps,
        np.array(state),
    )
    return encode_request(request)


def still(frames: int, joints: int = 55, fps: float = 30.0) -> bytes:
    """A request of the rest pose."""
    return encode_request(FramesRequest(np.zeros((frames, joints, 3)), np.zeros((frames, 3)), fps, np.zeros(0)))


def refused(response, status: int, *words: str) -> None:
    """The answer is a problem (RFC 9457) that names what was wrong."""
    assert response.status_code == status, response.text[:300]
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert problem["status"] == status
    assert problem["title"]
    for word in words:
        assert word in problem["detail"]
    assert "Traceback" not in response.text


def test_health_and_ready(http):
    assert http.get("/health").json()["status"] == "ok"
    assert http.get("/ready").json() == {"status": "ready"}


def test_not_ready_before_avatars_are_loaded(avatars):
    client = TestClient(create_app(Settings(avatars=avatars)))  # no lifespan: nothing is loaded
    refused(client.get("/ready"), 503, "loading")


def test_lists_and_describes_avatars(http, bundle):
    (listed,) = http.get("/avatars").json()
    assert (listed["id"], listed["fps"]) == ("shell", 30)
    assert [g["name"] for g in listed["garments"]] == ["tshirt", "trousers"]
    described = http.get("/avatars/shell").json()
    assert "CC0" in described["licence"]
    np.testing.assert_allclose(described["joints"], bundle.joints)
    assert described["provenance"] == {"made_by": "tests"}


def test_static_mesh_as_json_and_glb(http, bundle):
    meshes = http.get("/avatars/shell/mesh").json()
    assert list(meshes) == ["body", "tshirt", "trousers"]
    np.testing.assert_allclose(meshes["tshirt"]["vertices"], bundle.garment("tshirt").mesh.vertices, atol=6e-6)
    assert meshes["tshirt"]["faces"] == bundle.garment("tshirt").mesh.faces.tolist()
    count = sum(len(vertices) for vertices in meshes["tshirt"]["regions"].values())
    assert count == len(meshes["tshirt"]["vertices"])
    glb = http.get("/avatars/shell/mesh?format=glb")
    assert glb.headers["content-type"] == "model/gltf-binary"
    scene = trimesh.load(io.BytesIO(glb.content), file_type="glb", process=False)
    np.testing.assert_allclose(scene.geometry["body"].vertices, bundle.body.vertices, atol=1e-6)


def test_binary_and_json_agree(http, motion):
    few = motion[:12]
    binary = decode_response(http.post(FRAMES, content=body_of(few), headers=BINARY).content)
    asked = {"fps": 30, "poses": few.poses.tolist(), "transl": few.transl.tolist()}
    answered = http.post(FRAMES, json=asked).json()
    assert answered["frames"] == 12
    assert (answered["fps"], answered["request_fps"]) == (30, 30)
    assert list(answered["garments"]) == list(binary.vertices) == ["tshirt", "trousers"]
    for name, garment in answered["garments"].items():
        np.testing.assert_allclose(garment["vertices"], binary.vertices[name], atol=1.1e-5)
        np.testing.assert_allclose(garment["state"], binary.states[name], atol=1e-6)


def test_a_rate_in_single_precision_is_the_avatars_own():
    """Binary requests hold it so: 29.97 fps is another number there, and a motion could not be continued."""
    assert same_rate(float(np.float32(29.97)), 29.97) == 29.97 and same_rate(30.0, 30.0) == 30.0
    assert same_rate(29.9701, 29.97) == 29.9701


def test_accept_chooses_the_answer(http, motion):
    few = motion[:2]
    mixed = http.post(FRAMES, content=body_of(few), headers={**BINARY, "accept": "application/json"})
    assert mixed.json()["frames"] == 2
    asked = {"fps": 30, "poses": few.poses.tolist(), "transl": few.transl.tolist()}
    assert decode_response(http.post(FRAMES, json=asked, headers={"accept": MEDIA_TYPE}).content).fps == 30
    refused(http.post(FRAMES, json=asked, headers={"accept": "text/html"}), 406, "application/json")
    refused(http.post(FRAMES, json=asked, headers={"accept": "*/*;q=0"}), 406, "application/json")
    for accept in (f"{MEDIA_TYPE};q=0, application/json", f"application/json, {MEDIA_TYPE};q=0.1"):
        liked = http.post(FRAMES, content=body_of(few), headers={**BINARY, "accept": accept})
        assert liked.headers["content-type"] == "application/json"


def test_one_garment(http, motion):
    answer = decode_response(http.post(FRAMES + "?garment=trousers", content=body_of(motion), headers=BINARY).content)
    assert list(answer.vertices) == ["trousers"]


@pytest.mark.parametrize("cut", [1, 13])
def test_state_continues_a_motion(http, motion, cut):
    whole = decode_response(http.post(FRAMES, content=body_of(motion), headers=BINARY).content)
    first = decode_response(http.post(FRAMES, content=body_of(motion[:cut]), headers=BINARY).content)
    state = np.concatenate(list(first.states.values()))
    rest = motion[cut:]
    second = decode_response(http.post(FRAMES, content=body_of(rest, state=state), headers=BINARY).content)
    cold = decode_response(http.post(FRAMES, content=body_of(rest), headers=BINARY).content)
    for name, vertices in whole.vertices.items():
        joined = np.concatenate([first.vertices[name], second.vertices[name]])
        np.testing.assert_allclose(joined, vertices, atol=5e-6)
        assert np.abs(cold.vertices[name][0] - vertices[cut]).max() > 1e-4  # the state matters


def test_states_of_leaps_through_all_there_is_are_taken_back(http, motion):
    poses = np.random.default_rng(0).uniform(-2, 2, (60, 55, 3))
    transl = np.where(np.arange(60)[:, None] % 2, 999.0, -999.0) * np.ones(3)
    first = http.post(FRAMES, content=body_of(motion, poses=poses, transl=transl), headers=BINARY)
    state = np.concatenate(list(decode_response(first.content).states.values()))
    assert np.abs(state).max() > 5e4
    assert http.post(FRAMES, content=body_of(motion, state=state), headers=BINARY).status_code == 200


def test_state_continues_a_motion_in_json(http, motion):
    def post(part, **extra):
        asked = {"fps": 30, "poses": part.poses.tolist(), "transl": part.transl.tolist(), **extra}
        return http.post(FRAMES, json=asked)

    whole = post(motion[:8]).json()["garments"]
    first = post(motion[:5]).json()["garments"]
    second = post(motion[5:8], state={name: g["state"] for name, g in first.items()}).json()["garments"]
    for name, garment in whole.items():
        np.testing.assert_allclose(second[name]["vertices"], garment["vertices"][5:], atol=2e-5)


def test_other_frame_rates_are_resampled_by_slerp(http, motion):
    fast = motion.resample(60)
    answer = decode_response(http.post(FRAMES, content=body_of(fast), headers=BINARY).content)
    assert (answer.fps, answer.request_fps) == (30, 60)
    expected = decode_response(http.post(FRAMES, content=body_of(fast.resample(30)), headers=BINARY).content)
    for name, vertices in expected.vertices.items():
        assert answer.vertices[name].shape == vertices.shape
        np.testing.assert_allclose(answer.vertices[name], vertices, atol=1e-5)


def test_server_timing_names_the_stages(http, motion):
    header = http.post(FRAMES, content=body_of(motion), headers=BINARY).headers["server-timing"]
    assert all(stage in header for stage in ("parse;dur=", "infer;dur=", "encode;dur="))


WRONG_JOINTS = [(22, "without hands"), (24, "SMPL"), (52, "SMPL-H"), (1, "55"), (56, "55")]


@pytest.mark.parametrize(("joints", "word"), WRONG_JOINTS)
def test_wrong_joint_counts(http, joints, word):
    asked = {"fps": 30, "poses": np.zeros((3, joints, 3)).tolist()}
    refused(http.post(FRAMES, content=still(3, joints), headers=BINARY), 422, word, str(joints), "55")
    refused(http.post(FRAMES, json=asked), 422, word, str(joints), "55")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30, 90.0])
def test_bad_angles_name_frame_and_joint(http, motion, value):
    poses = motion.poses.copy()
    poses[7, 18, 1] = value
    refused(http.post(FRAMES, content=body_of(motion, poses=poses), headers=BINARY), 422, "frame 7", "left_elbow")


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1700.0])
def test_bad_translations_name_the_frame(http, motion, value):
    transl = motion.transl.copy()
    transl[3, 2] = value
    refused(http.post(FRAMES, content=body_of(motion, transl=transl), headers=BINARY), 422, "frame 3", "transl")


@pytest.mark.parametrize("text", ["NaN", "Infinity", "1e999"])
def test_json_numbers_must_be_finite(http, text):
    poses = "[[" + "[0,0,0]," * 54 + f"[0,0,{text}]]]"
    refused(http.post(FRAMES, content=f'{{"fps":30,"poses":{poses}}}', headers=JSON), 422, "finite")


@pytest.mark.parametrize("fps", [0.0, -30.0, np.nan, np.inf, 1e9])
def test_bad_frame_rates(http, motion, fps):
    refused(http.post(FRAMES, content=body_of(motion, fps=fps), headers=BINARY), 422, "fps")


def test_bad_states(http, motion, bundle):
    size = sum(garment.state_size for garment in bundle.garments)
    refused(http.post(FRAMES, content=body_of(motion, state=np.zeros(5)), headers=BINARY), 422, "state", str(size))
    for value in (np.nan, 1e30, 1e3, -2):
        state = np.full(size, value)
        refused(http.post(FRAMES, content=body_of(motion, state=state), headers=BINARY), 422, "tshirt", "within 1.001")
    first = bundle.garments[0].state_size
    for place, word in ((first - 1, "tshirt's motion"), (size - 1, "trousers's motion"), (size - 17, "memory")):
        state = np.zeros(size)
        state[place] = 1e8
        refused(http.post(FRAMES, content=body_of(motion, state=state), headers=BINARY), 422, word)
    refused(http.post(FRAMES, content=body_of(motion, fps=60, state=np.zeros(size)), headers=BINARY), 422, "30 fps")
    asked = {"fps": 30, "poses": motion.poses.tolist(), "state": {"tshirt": [0.0]}}
    refused(http.post(FRAMES, json=asked), 422, "state", "trousers")


def test_too_many_frames(http):
    refused(http.post(FRAMES, content=still(1801), headers=BINARY), 413, "1800")
    refused(http.post(FRAMES, content=still(100, fps=1), headers=BINARY), 413, "2971")
    accept = {**BINARY, "accept": "application/json"}
    refused(http.post(FRAMES, content=still(200), headers=accept), 413, "octet-stream")


def test_no_frames(http):
    refused(http.post(FRAMES, json={"fps": 30, "poses": []}), 422, "poses")
    refused(http.post(FRAMES, content=still(0), headers=BINARY), 422, "at least one frame")


def test_too_large_a_body_is_cut_off_while_it_streams(avatars):
    with TestClient(create_app(Settings(avatars=avatars, max_body_bytes=2000))) as client:
        refused(client.post(FRAMES, content=bytes(3000), headers=BINARY), 413, "2000")
        refused(client.post(FRAMES, content=iter([bytes(1500)] * 4), headers=BINARY), 413, "2000")


@pytest.mark.parametrize("kind", ["text/plain", "multipart/form-data", "application/x-npz", ""])
def test_other_content_types(http, kind):
    refused(http.post(FRAMES, content=b"x", headers={"content-type": kind}), 415, "application/json")


def test_unknown_avatars_garments_and_routes(http, motion):
    refused(http.get("/avatars/nobody"), 404, "nobody", "shell")
    refused(http.get("/avatars/nobody/mesh"), 404)
    refused(http.post("/avatars/nobody/frames", content=body_of(motion), headers=BINARY), 404)
    refused(http.post("/avatars/..%2f..%2fetc/frames", content=body_of(motion), headers=BINARY), 404)
    refused(http.post(FRAMES + "?garment=hat", content=body_of(motion), headers=BINARY), 404, "hat", "tshirt")
    refused(http.get("/nothing"), 404)
    refused(http.get(FRAMES), 405)
    refused(http.get("/avatars/shell/mesh?format=obj"), 422, "format")
    refused(http.get("/avatars/shell/mesh?format=glb&moprh=true"), 422, "'moprh' is no parameter here; there is format")
    refused(http.post("/avatars/shell/poses?name=a.npz&fsp=60", content=b""), 422, "'fsp' is no parameter here")
    refused(http.get("/avatars/shell/poses?fps=60"), 422, "'fps' is no parameter here; there are none")


@pytest.mark.parametrize("body", [b"", b"CPHQ", b"XXXX" + bytes(20), bytes(24), b"{}", b"\xff" * 100])
def test_malformed_binary(http, body):
    refused(http.post(FRAMES, content=body, headers=BINARY), 422)


def test_a_header_that_promises_more_than_it_holds(http):
    header = struct.pack("<4sHHIIfI", b"CPHQ", 1, 0, 2**32 - 1, 2**32 - 1, 30.0, 2**32 - 1)
    refused(http.post(FRAMES, content=header, headers=BINARY), 422, "bytes")


@pytest.mark.parametrize(
    "body",
    [
        *("", "{", "[]", "null", "[" * 100000),
        *('{"fps":30}', '{"fps":"x","poses":[]}', '{"poses":[[1]],"fps":30}', '{"fps":30,"poses":[],"typo":1}'),
        *('{"fps":30,"poses":[[[0,0,0]],[[0,0]]]}', '{"fps":30,"poses":[[[]]]}'),
    ],
)
def test_malformed_json(http, body):
    refused(http.post(FRAMES, content=body, headers=JSON), 422)


def test_wrong_json_is_told_by_its_first_mistake(http, monkeypatch):
    """pydantic tells of each, a kilobyte for each: 8 MB of them took 3 GB and half a minute."""
    told = []
    errors = ValidationError.errors

    def counted(error, **options):
        told.append(error.error_count())
        return errors(error, **options)

    monkeypatch.setattr(ValidationError, "errors", counted)
    wrong = ",".join(['""'] * 9000)
    for body in (
        f'{{"fps":30,"poses":[[[{wrong}]]]}}',
        f'{{"fps":30,"poses":[[{wrong}],[{wrong}]]}}',
        f'{{"fps":30,"poses":[{wrong}]}}',
        f'{{"fps":30,"poses":[],"confidence":[{wrong}]}}',
        f'{{"fps":30,"poses":[],"state":{{"tshirt":[{wrong}]}}}}',
        '{"fps":30,"poses":[],' + ",".join(f'"{i}":0' for i in range(900)) + "}",
    ):
        refused(http.post(FRAMES, content=body, headers=JSON), 422)
    assert len(told) == 6 and max(told[:5]) <= 2 and told[5] == 900


def test_long_json_is_counted_before_it_is_parsed(http, monkeypatch):
    monkeypatch.setattr("service.frames.JsonRequest.model_validate_json", lambda _: 1 / 0)
    frame = "[" + ",".join(["[0,0,0]"] * 55) + "]"
    for body in (
        '{"fps":30,"poses":[' + ",".join([frame] * 3000) + "]}",
        '{"fps":30,"poses":[' + "[]," * 600_000 + "[]]}",
        "{" + ",".join(f'"{i}":0' for i in range(2000)) + "}",
    ):
        refused(http.post(FRAMES, content=body, headers=JSON), 413, "1800 frames")


def test_an_error_of_our_own_is_a_500_without_a_traceback(http, monkeypatch, motion):
    monkeypatch.setattr("service.frames.answer", lambda *_: 1 / 0)
    refused(http.post(FRAMES, content=body_of(motion), headers=BINARY), 500)


def test_starts_only_with_avatars(tmp_path):
    with pytest.raises(CaphyError, match="holds no avatar"), TestClient(create_app(Settings(avatars=tmp_path))):
        pass
    with pytest.raises(CaphyError, match="--avatars"), TestClient(create_app(Settings(avatars=tmp_path / "none"))):
        pass


def test_openapi_describes_both_encodings(http):
    operation = http.get("/openapi.json").json()["paths"]["/avatars/{avatar}/frames"]["post"]
    assert set(operation["requestBody"]["content"]) == {"application/json", MEDIA_TYPE}


def test_pages_of_other_origins_may_ask_where_the_operator_says_so(avatars, motion):
    """A preflight is answered without the key, and refusals can be read by the page."""
    page, ours = (
        {"origin": "https://example.org"},
        Settings(avatars=avatars, api_key="k", origins="https://example.org"),
    )
    wants = {"access-control-request-method": "POST", "access-control-request-headers": "authorization, content-type"}
    with TestClient(create_app(ours)) as client:
        before = client.options(FRAMES, headers={**page, **wants})
        assert before.status_code == 200
        assert before.headers["access-control-allow-origin"] == page["origin"]
        assert "authorization" in before.headers["access-control-allow-headers"]
        answer = client.post(FRAMES, content=body_of(motion), headers={**BINARY, **page, "authorization": "Bearer k"})
        assert answer.status_code == 200 and answer.headers["access-control-allow-origin"] == page["origin"]
        locked = client.post(FRAMES, content=body_of(motion), headers={**BINARY, **page})
        refused(locked, 401)
        assert locked.headers["access-control-allow-origin"] == page["origin"]
        other = client.options(FRAMES, headers={**wants, "origin": "https://example.com"})
        assert "access-control-allow-origin" not in other.headers


def test_pages_of_other_origins_are_told_of_a_failure_too(avatars, motion, monkeypatch):
    """Without the header a browser shows them a network's error, and nobody looks into the log."""
    monkeypatch.setattr("service.frames.require_valid", lambda *_: 1 / 0)
    with TestClient(create_app(Settings(avatars=avatars, origins="https://example.org"))) as client:
        answer = client.post(FRAMES, content=body_of(motion), headers={**BINARY, "origin": "https://example.org"})
    assert answer.status_code == 500
    assert answer.headers["access-control-allow-origin"] == "https://example.org"


def test_without_that_no_other_page_may(http, motion):
    answer = http.post(FRAMES, content=body_of(motion), headers={**BINARY, "origin": "https://example.org"})
    assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize("origins", ["example.org", "https://example.org/page", "https://a.org; https://b.org"])
def test_origins_that_are_none_are_refused(origins):
    with pytest.raises(CaphyError, match=r"CAPHY_ORIGINS: .*a scheme and a host"):
        read_settings(origins=origins)


@pytest.mark.parametrize("path", ["/", "/health", "/ready", "/v2/health/ready", "/avatars", "/avatars/shell/mesh"])
def test_heads_are_those_of_get(http, path):
    head, get = http.head(path), http.get(path)
    assert head.status_code == get.status_code == 200
    assert head.headers["content-type"] == get.headers["content-type"]
    assert http.head(FRAMES).status_code == 405


def test_errors_are_described_as_they_are_answered(http):
    paths = http.get("/openapi.json").json()["paths"]
    for path, method in ((p, m) for p, methods in paths.items() for m in methods):
        told = paths[path][method]["responses"]
        protocol = path == "/v2" or path.startswith("/v2/")
        assert not (protocol and "422" in told), path
        for status, response in told.items():
            if status >= "400" and "content" in response:
                assert set(response["content"]) == {f"application/{'json' if protocol else 'problem+json'}"}, path
        probe = path in ("/health", "/ready", "/v2/health/live", "/v2/health/ready")
        assert probe or {"401", "429", "503"} <= set(told), path
    answered = http.get("/avatars/shell/mesh?format=usd")
    assert (answered.status_code, answered.headers["content-type"]) == (422, "application/problem+json")


def test_what_a_stop_cuts_off_is_told_to_come_again(avatars, motion):
    """uvicorn cancels what is in flight when the time for that is over; a bare 500 and a traceback are no answer."""
    app = create_app(Settings(avatars=avatars))

    async def stopped(*_: object) -> None:
        raise asyncio.CancelledError

    sent: list[dict] = []

    async def send(message: dict) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "GET", "path": "/avatars", "headers": [], "client": ("1.2.3.4", 5)}
    asyncio.run(Observed(stopped, app.state.metrics)(scope, stopped, send))  # pyright: ignore
    assert sent[0]["status"] == 503
    assert (b"retry-after", b"1") in sent[0]["headers"]
