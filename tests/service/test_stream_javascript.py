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

const sent = [];
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

function welcome() { // one garment, "a", whose state is one float
  const view = message(Kind.WELCOME, 8 + 48);
  view.setUint16(6, 1, true);
  view.setUint8(32, 97);
  view.setUint32(76, 1, true);
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
    assert ran(OPENS, tmp_path) == [1, 2, 3]


def test_a_state_from_before_a_reset_is_none_of_the_motion_after_it(tmp_path):
    """It answers who asked before the reset; who asked after it, and a new connection's hello, get none of it."""
    assert ran(RESETS, tmp_path) == {"values": [0.5, 0.25], "floats": [0, 0]}
