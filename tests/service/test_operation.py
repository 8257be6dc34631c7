"""Keys, request ids, logs and numbers, as an operator meets them."""

from __future__ import annotations

import base64
import io
import json
import logging
import os
import re
import subprocess
import sys

import anyio
import pytest
from fastapi import FastAPI, WebSocket
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from starlette.websockets import WebSocketDisconnect
from test_app import BINARY, FRAMES, body_of, refused

from caphy.cli import main
from caphy.errors import CaphyError
from service.app import create_app
from service.keys import RequireKey, Subprotocol
from service.logs import JsonLines
from service.settings import Settings, read_settings
from service.stream.limits import StreamLimits

KEY = "a-key-with-ümlaut"
OTHER = "the-key-before"


@pytest.fixture(scope="module")
def locked(avatars):
    with TestClient(
        create_app(Settings(avatars=avatars, api_key=f"{KEY}, {OTHER}")), raise_server_exceptions=False
    ) as client:
        yield client


def numbers(http: TestClient) -> dict[tuple[str, ...], float]:
    """Samples of /metrics by name and sorted label values."""
    families = text_string_to_metric_families(http.get("/metrics").text)
    return {(s.name, *sorted(s.labels.values())): s.value for family in families for s in family.samples}


@pytest.mark.parametrize("path", ["/avatars", "/v2", "/v2/models/shell.tshirt", "/metrics", "/docs", "/openapi.json"])
def test_without_the_key_nothing_is_answered(locked, path):
    for headers in (
        {},
        {"authorization": "Bearer wrong"},
        {"x-api-key": "wrong"},
        {"authorization": f"Basic {KEY}"},
        {"x-api-key": f"{KEY},{OTHER}"},
    ):
        response = locked.get(path, headers={name: value.encode() for name, value in headers.items()})
        assert response.status_code == 401
        assert response.headers["www-authenticate"] == "Bearer"
        assert "x-api-key" in response.text


def test_the_key_opens(locked, motion):
    for headers in (
        {"authorization": f"Bearer {KEY}"},
        {"authorization": f"bearer {KEY}"},
        {"x-api-key": KEY},
        {"x-api-key": OTHER},
    ):
        encoded = {name: value.encode() for name, value in headers.items()}
        assert locked.get("/avatars", headers=encoded).status_code == 200
        asked = {**{k: v.encode() for k, v in BINARY.items()}, **encoded}
        assert locked.post(FRAMES, content=body_of(motion[:1]), headers=asked).status_code == 200


@pytest.mark.parametrize("path", ["/health", "/ready", "/v2/health/live", "/v2/health/ready"])
def test_probes_need_no_key(locked, path):
    assert locked.get(path).status_code == 200


def test_the_body_of_a_stranger_is_not_read(locked):
    async def receive():
        raise AssertionError("the body was read")

    async def send(message):
        sent.append(message)

    sent: list[dict] = []
    scope = {"type": "http", "method": "POST", "path": FRAMES, "headers": [], "query_string": b""}
    anyio.run(locked.app, scope, receive, send)
    assert sent[0]["status"] == 401


@pytest.fixture(scope="module")
def echo():
    """An application of one WebSocket behind the same middleware."""
    app = FastAPI()

    @app.websocket("/stream")
    async def stream(websocket: WebSocket) -> None:
        await websocket.accept()
        await websocket.send_text("in")

    app.add_middleware(Subprotocol)
    app.add_middleware(RequireKey, keys=[OTHER, KEY])
    return TestClient(app)


def test_websockets_want_the_key_too(echo):
    for headers in ({}, {"x-api-key": "wrong"}):
        with echo.websocket_connect("/stream", headers=headers) as socket:  # accepted: browsers hear of no refusal
            with pytest.raises(WebSocketDisconnect) as found:
                socket.receive_text()
            assert (found.value.code, found.value.reason[:24]) == (1008, "this service wants a key")
    with echo.websocket_connect("/stream", headers={"x-api-key": KEY.encode()}) as socket:
        assert socket.receive_text() == "in"


def test_browsers_send_the_key_as_a_subprotocol(echo):
    encoded = base64.urlsafe_b64encode(KEY.encode()).decode().rstrip("=")
    with echo.websocket_connect("/stream", subprotocols=["caphy", f"caphy.key.{encoded}"]) as socket:
        assert socket.receive_text() == "in"
        assert socket.accepted_subprotocol == "caphy"
    for wrong in ("caphy.key.", "caphy.key.!", f"caphy.key.{encoded[:-2]}", encoded):
        with echo.websocket_connect("/stream", subprotocols=["caphy", wrong]) as socket:
            assert socket.accepted_subprotocol == "caphy"  # one of those it offers, or a browser hangs up
            with pytest.raises(WebSocketDisconnect):
                socket.receive_text()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "example.org"])
def test_others_are_let_in_only_on_purpose(host, capsys, monkeypatch):
    monkeypatch.delenv("CAPHY_API_KEY", raising=False)
    assert main(["serve", "--host", host]) == 2
    said = capsys.readouterr().err
    assert "CAPHY_API_KEY" in said
    assert "CAPHY_ALLOW_ANONYMOUS" in said
    for allowed in ({"api_key": "k"}, {"allow_anonymous": True}):
        Settings(host=host, **allowed).require_key_beyond_loopback()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_this_machine_needs_no_key(host):
    Settings(host=host).require_key_beyond_loopback()


@pytest.mark.parametrize("empty", [" ", "new, ", ",old"])
def test_an_empty_key_is_none(monkeypatch, empty):
    monkeypatch.setenv("CAPHY_API_KEY", empty)
    with pytest.raises(CaphyError, match=r"CAPHY_API_KEY.*empty"):
        read_settings()


def test_the_key_is_not_shown(monkeypatch):
    monkeypatch.setenv("CAPHY_API_KEY", "secret-7")
    assert "secret-7" not in repr(read_settings())


def test_requests_carry_ids(http):
    assert http.get("/health", headers={"x-request-id": "client-7.a"}).headers["x-request-id"] == "client-7.a"
    made = [http.get("/health").headers["x-request-id"] for _ in range(2)]
    assert made[0] != made[1]
    for bad in ("a b", "x" * 200, "é", '"'):
        found = http.get("/health", headers={"x-request-id": bad.encode()}).headers["x-request-id"]
        assert found != bad
        assert len(found) == 32


def test_failures_carry_ids_and_are_logged_with_them(http, monkeypatch, motion):
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    log = logging.getLogger("caphy.service.requests")
    log.addHandler(handler)
    monkeypatch.setattr("service.frames.answer", lambda *_: 1 / 0)
    try:
        response = http.post(FRAMES, content=body_of(motion), headers={**BINARY, "x-request-id": "id-9"})
    finally:
        log.removeHandler(handler)
    refused(response, 500)
    assert response.headers["x-request-id"] == "id-9"
    failure, request = map(json.loads, stream.getvalue().splitlines())
    assert failure["request_id"] == request["request_id"] == "id-9"
    assert "ZeroDivisionError" in failure["traceback"]
    assert (request["status"], request["level"]) == (500, "error")
    assert request["milliseconds"] > 0


def test_requests_stages_and_frames_are_counted(http, motion):
    route = "/avatars/{avatar}/frames"
    before = numbers(http)
    for _ in range(3):
        assert http.post(FRAMES, content=body_of(motion[:5]), headers=BINARY).status_code == 200
    http.post(FRAMES, content=b"nonsense", headers=BINARY)
    http.get("/such/a/path/is/not/there")
    after = numbers(http)

    def grown(name: str, *labels: str) -> float:
        key = (name, *sorted(labels))
        return after.get(key, 0) - before.get(key, 0)

    assert grown("caphy_requests_total", "POST", route, "200") == 3
    assert grown("caphy_requests_total", "POST", route, "422") == 1
    assert grown("caphy_requests_total", "GET", "unknown", "404") == 1
    assert grown("caphy_frames_total", "shell") == 15
    for stage in ("parse", "infer", "encode"):
        assert grown("caphy_stage_seconds_count", stage) == 3
        assert grown("caphy_stage_seconds_sum", stage) > 0
    assert grown("caphy_request_seconds_bucket", "+Inf", route) == 4
    assert after["caphy_avatar_bytes", "shell"] >= 0
    assert after["caphy_avatar_loads_total", "loaded", "shell"] == 1
    assert after["caphy_resident_bytes",] > 1e7
    assert after["caphy_buffered_bytes",] == 0
    assert after["caphy_inference_in_flight",] == 0


def test_log_lines_are_json():
    record = logging.makeLogRecord(
        {"name": "caphy.x", "levelname": "INFO", "msg": 'a "%s"\n', "args": ("b",), "pid": 7}
    )
    line = JsonLines().format(record)
    assert "\n" not in line
    found = json.loads(line)
    assert (found["message"], found["level"], found["logger"], found["pid"]) == ('a "b"\n', "info", "caphy.x", 7)
    assert found["time"].endswith("+00:00")


def test_the_openapi_names_no_secret(http):
    assert "api_key" not in http.get("/openapi.json").text


def test_nothing_is_reported_home(avatars, tmp_path):
    """onnxruntime leaves a device id in the cache of whoever lets it report to its maker."""
    code = "import sys, pathlib, service.avatars as found; found.load_avatars(pathlib.Path(sys.argv[1]), 8)"
    environment = {k: v for k, v in os.environ.items() if k not in ("XDG_CACHE_HOME", "ORT_DISABLE_TELEMETRY")}
    command = [sys.executable, "-c", code, str(avatars)]
    subprocess.run(command, check=True, env={**environment, "HOME": str(tmp_path)})
    assert list(tmp_path.rglob("*")) == []


def test_the_page_of_endpoints_lists_all_and_loads_nothing(http):
    page = http.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    assert page.headers["content-security-policy"].startswith("default-src 'none'")
    assert not re.search(r"https?://|<script|<link|<img|src=", page.text)
    for path, operations in http.get("/openapi.json").json()["paths"].items():
        for method in operations:
            assert f"<h2>{method.upper()} {path}</h2>" in page.text
    assert http.get("/redoc").status_code == 404


def test_memory_is_noted_though_nobody_asks(avatars):
    with TestClient(create_app(Settings(avatars=avatars))) as client:
        client.get("/health")
        assert client.app.state.metrics.registry.get_sample_value("caphy_resident_bytes") > 1e7


@pytest.mark.parametrize("value", ["inf", "1e9", "nan", "0"])
def test_settings_have_bounds(value, monkeypatch, capsys):
    for name in ("CAPHY_SEND_SECONDS", "CAPHY_STREAM_SEND_SECONDS"):
        with monkeypatch.context() as patched:
            patched.setenv(name, value)
            assert main(["serve", "--port", "0"]) == 2
        assert f"{name}: Input should be" in capsys.readouterr().err


def test_every_limit_has_a_highest_value():
    for limits in (Settings, StreamLimits):
        for name, field in limits.model_fields.items():
            if field.annotation in (int, float):
                assert any(hasattr(bound, "le") for bound in field.metadata), name


def test_warnings_are_lines_of_the_log():
    code = (
        "import warnings; from fastapi import FastAPI; from service.server import make_server; "
        "from service.settings import Settings; make_server(FastAPI(), Settings()); warnings.warn('overflow')"
    )
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    line = json.loads(found.stderr)
    assert (line["level"], line["logger"]) == ("warning", "py.warnings")
    assert "overflow" in line["message"]
