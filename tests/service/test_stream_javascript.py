"""The JavaScript client's own behaviour, on a socket that only records."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import service.clients

CLIENT = Path(service.clients.__file__).with_name("stream.js")
SCRIPT = """
import { GarmentStream, HEADER_BYTES, Kind } from "CLIENT";

const sent = [];
globalThis.WebSocket = class {
  readyState = 1;
  constructor() { queueMicrotask(() => this.onopen()); }
  send(body) {
    const view = new DataView(body);
    sent.push([view.getUint8(5), view.getUint32(8, true)]);
    if (view.getUint8(5) === Kind.HELLO) queueMicrotask(() => this.onmessage({ data: welcome() }));
  }
  close() {}
};

function welcome() {
  const view = new DataView(new ArrayBuffer(HEADER_BYTES + 8));
  new Uint8Array(view.buffer).set([..."CPHS"].map((letter) => letter.charCodeAt(0)));
  view.setUint8(4, 1);
  view.setUint8(5, Kind.WELCOME);
  return view.buffer;
}

const poses = new Float32Array(165), transl = new Float32Array(3);
const stream = new GarmentStream("ws://nowhere/");
stream.send(poses, transl); // before the welcome: it waits
stream.onstatus = (status) => status === "open" && stream.send(poses, transl);
stream.onwelcome = () => stream.send(poses, transl);
const poseNumbers = () => sent.filter(([kind]) => kind === Kind.POSES).map(([, number]) => number);
setTimeout(() => console.log(JSON.stringify(poseNumbers())), 50);
"""


def test_poses_sent_as_the_stream_opens_go_out_once_and_in_order(tmp_path):
    node = shutil.which("node")
    assert node, "this test needs node (Debian: apt-get install nodejs)"
    script = tmp_path / "opens.mjs"
    script.write_text(SCRIPT.replace("CLIENT", CLIENT.resolve().as_uri()))
    done = subprocess.run([node, str(script)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [1, 2, 3]
