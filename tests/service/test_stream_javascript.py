"""The JavaScript client's own behaviour, on a socket that only records."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import service.clients

CLIENT = Path(service.clients.__file__).with_name("stream.js")
SOCKET = """
import { GarmentStream, HEADER_BYTES, Kind } from "CLIENT";

const sent = [], bodies = [];
let socket;
globalThis.WebSocket = class {
  readyState = 1;
  constructor() {
    socket = this;
    queueMicrotask(() => this.onopen());
  }
  send(body) {
    const view = new DataView(body);
    sent.push([view.getUint8(5), view.getUint32(8, true), view.getUint32(12, true), view.getFloat64(16, true)]);
    bodies.push(view);
    if (view.getUint8(5) === Kind.HELLO) queueMicrotask(() => this.onmessage({ data: welcome() }));
  }
  close() {}
};

function message(kind, bytes) {
  const view = new DataView(new ArrayBuffer(HEADER_BYTES + bytes));
  new Uint8Array(view.buffer).set([..."CPHS"].map((letter) => letter.charCodeAt(0)));
  view.setUint8(4, 1);
  view.setUint8(5, kind);
  return view;
}

let names = "a"; // of garments; the state of each is one float
function welcome() {
  const view = message(Kind.WELCOME, 8 + 48 * names.length);
  view.setUint16(6, names.length, true);
  [...names].forEach((name, i) => {
    view.setUint8(32 + 48 * i, name.charCodeAt(0));
    view.setUint32(76 + 48 * i, 1, true);
  });
  return view.buffer;
}

function state(number, time, value) {
  const view = message(Kind.STATE, 4);
  view.setUint32(8, number, true);
  view.setUint32(12, 1, true);
  view.setFloat64(16, time, true);
  view.setFloat32(24, value, true);
  return { data: view.buffer };
}

const poses = new Float32Array(165), transl = new Float32Array(3);
const welcomed = (stream) => new Promise((resolve) => (stream.onwelcome = resolve));
const hello = () => bodies.filter((view) => view.getUint8(5) === Kind.HELLO).at(-1);
"""
OPEN = """
const stream = new GarmentStream("ws://nowhere/");
"""
OPENS = """
stream.send(poses, transl); // before the welcome: it waits
stream.onstatus = (status) => status === "open" && stream.send(poses, transl);
stream.onwelcome = () => stream.send(poses, transl);
const poseNumbers = () => sent.filter(([kind]) => kind === Kind.POSES).map(([, number]) => number);
setTimeout(() => console.log(JSON.stringify(poseNumbers())), 50);
"""
RESETS = """
await new Promise((resolve) => (stream.onwelcome = resolve));
const asked = () => sent.filter(([kind]) => kind === Kind.GET_STATE).map(([, , , time]) => time);
stream.send(poses, transl);
const before = stream.state();
stream.reset();
const after = stream.state();
socket.onmessage(state(1, asked()[0], 0.5));
socket.onclose({ code: 1006, reason: "" });
await new Promise((resolve) => (stream.onwelcome = resolve));
socket.onmessage(state(0, asked().at(-1), 0.25));
const values = [(await before).a[0], (await after).a[0]];
const floats = sent.filter(([kind]) => kind === Kind.HELLO).map(([, , extra]) => extra);
console.log(JSON.stringify({ values, floats }));
stream.close();
"""
RATES = """
await welcomed(stream);
stream.send(poses, transl);
stream.setFps(15);
stream.send(poses, transl);
const play = async (ended) => {
  socket.onclose({ code: 1006, reason: "" });
  await welcomed(stream);
  const kinds = sent.slice(ended).map(([kind]) => kind).filter((kind) => kind !== Kind.GET_STATE);
  return [hello().getFloat32(24, true), kinds];
};
const both = await play(sent.length);
socket.onmessage(state(1, 0, 0.5)); // after the first pose
const saved = await play(sent.length);
try {
  stream.setFps(0);
} catch (error) {
  console.log(JSON.stringify({ both, saved, error: error.message }));
}
stream.close();
"""
STATES = """
names = "ab";
const ended = async (state) => {
  const stream = new GarmentStream("ws://nowhere/", { state });
  const closed = new Promise((resolve) => (stream.onerror = ({ code, text }) => resolve(`${text} (${code})`)));
  const asked = stream.state().catch((error) => error.message);
  return [await closed, await asked, await stream.state().catch((error) => error.message)];
};
const thrown = (state) => {
  try {
    new GarmentStream("ws://nowhere/", { state });
  } catch (error) {
    return error.message;
  }
};
const said = async (state) => {
  const stream = new GarmentStream("ws://nowhere/", { state });
  await welcomed(stream);
  stream.close();
  return Array.from({ length: hello().getUint32(12, true) }, (_, i) => hello().getFloat32(32 + 4 * i, true));
};
const a = Float32Array.of(0.25), b = Float32Array.of(0.5);
console.log(JSON.stringify({
  said: [await said({ b, a }), await said([0.25, 0.5]), await said(undefined), await said({})],
  ended: [await ended({ a }), await ended({ a, c: b })],
  thrown: [thrown("none"), thrown(Promise.resolve({ a, b })), thrown(new Map())],
}));
"""
CLOSES = """
await welcomed(stream);
const waiting = stream.state().catch((error) => error.message);
stream.close();
const after = stream.state().catch((error) => error.message);
console.log(JSON.stringify([await waiting, await after]));
"""
REFUSED = """
await welcomed(stream);
const refused = (number) => {
  const view = message(Kind.ERROR, 0);
  view.setUint32(8, number, true);
  view.setUint32(12, 422, true);
  socket.onmessage({ data: view.buffer });
};
const told = [];
const ask = (name) => stream.state().then(({ a }) => told.push([name, a[0]]));
stream.send(poses, transl);
stream.send(poses, transl);
ask("with the refused");
refused(2);
ask("after the refusal");
socket.onmessage(state(1, 0, 0.5));
await new Promise((resolve) => setTimeout(resolve, 0));
stream.send(poses, transl);
ask("of a later pose");
socket.onmessage(state(1, 0, 0.5));
await new Promise((resolve) => setTimeout(resolve, 0));
const waits = told.length;
socket.onmessage(state(3, 0, 0.75));
await new Promise((resolve) => setTimeout(resolve, 0));
console.log(JSON.stringify({ told, waits }));
stream.close();
"""
LATE = """
await welcomed(stream);
const numbers = [];
stream.onmeshes = ({ number }) => numbers.push(number);
const meshes = (number) => {
  const view = message(Kind.MESHES, 8);
  view.setUint32(8, number, true);
  socket.onmessage({ data: view.buffer });
};
stream.send(poses, transl);
stream.reset();
meshes(1);
stream.send(poses, transl);
meshes(2);
console.log(JSON.stringify([numbers, sent.filter(([kind]) => kind === Kind.CREDIT).length]));
stream.close();
"""


def ran(script: str, folder: Path) -> Any:
    """What a script says on the client with a socket that only records, as JSON."""
    node = shutil.which("node")
    assert node, "this test needs node (Debian: apt-get install nodejs)"
    file = folder / "script.mjs"
    file.write_text(SOCKET.replace("CLIENT", CLIENT.resolve().as_uri()) + script)
    done = subprocess.run([node, str(file)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_poses_sent_as_the_stream_opens_go_out_once_and_in_order(tmp_path):
    assert ran(OPEN + OPENS, tmp_path) == [1, 2, 3]


def test_a_state_from_before_a_reset_is_none_of_the_motion_after_it(tmp_path):
    """It answers who asked before the reset; who asked after it, and a new connection's hello, get none of it."""
    assert ran(OPEN + RESETS, tmp_path) == {"values": [0.5, 0.25], "floats": [0, 0]}


def test_a_new_rate_is_none_of_the_poses_before_it(tmp_path):
    """Over a new connection it goes between the poses that it went between; hello has the rate where the state is."""
    assert ran(OPEN + RATES, tmp_path) == {
        "both": [30, [1, 2, 5, 2]],
        "saved": [15, [1, 2]],
        "error": "fps must lie between 1 and 1000, got 0",
    }


def test_states_go_by_their_names(tmp_path):
    found = ran(STATES, tmp_path)
    assert found["said"] == [[0.25, 0.5], [0.25, 0.5], [], []]
    wanted = "state: must hold a (1 floats), b (1 floats), got"
    for ended, got in zip(found["ended"], ("a (1 floats)", "a (1 floats), c (1 floats)"), strict=True):
        assert ended == [f"{wanted} {got} (422)", f"{wanted} {got} (422)", "the stream is closed"]
    for thrown, kind in zip(found["thrown"], ("String", "Promise", "Map"), strict=True):
        assert thrown == f"state must be what state() said, or its floats, got [object {kind}]"


def test_nobody_waits_for_the_state_after_a_pose_that_was_refused(tmp_path):
    """The service never gets there: a promise of it was never kept."""
    assert ran(OPEN + REFUSED, tmp_path) == {
        "told": [["with the refused", 0.5], ["after the refusal", 0.5], ["of a later pose", 0.75]],
        "waits": 2,
    }


def test_a_closed_stream_promises_no_state(tmp_path):
    assert ran(OPEN + CLOSES, tmp_path) == ["the stream is closed", "the stream is closed"]


def test_of_the_motion_before_a_reset_no_meshes_are_given(tmp_path):
    """Its answers give their credits back all the same."""
    assert ran(OPEN + LATE, tmp_path) == [[2], 2]
