// Poses that another program sends through the service, such as a camera's client, dressed and shown as they come.
import { GarmentStream, HEADER_BYTES, Kind, protocolsOf } from "../../clients/stream.js";
import { Figures } from "./figures.js";
import { apiKey } from "./service.js";
import { JOINTS } from "./wire.js";

const QUIET = 1500; // milliseconds without a pose after which nobody is taken to send
const AGAIN = 1000; // between two attempts to listen
const REFUSED = new Set([4404, 4422, 4501, 1008]);

export class Feed {
  /** heard(pose, place, vertices by garment) when meshes arrive; waiting(text) while nobody sends or the service is
   * away; refused(text). */
  constructor(avatar, name, { heard, waiting, refused }) {
    Object.assign(this, { avatar, name, heard, waiting, refused });
    this.figures = new Figures();
    this.poses = new Map(); // sent on and not answered yet, by number
    this.nobody = `Waiting for somebody who sends on feed “${name}”…`;
    waiting(this.nobody);
    this.listen();
  }

  listen() {
    const url = new URL(`/avatars/${encodeURIComponent(this.avatar)}/feeds/${encodeURIComponent(this.name)}`, location.href);
    this.socket = new WebSocket(String(url).replace(/^http/, "ws"), protocolsOf(apiKey.get()));
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => this.take(data);
    this.socket.onclose = ({ code, reason }) => {
      if (this.closed) return;
      if (REFUSED.has(code)) return this.refused(`${reason} (${code})`);
      this.waiting("Disconnected: the feed broke off. Trying again…");
      setTimeout(() => this.closed || this.listen(), AGAIN);
    };
  }

  take(data) {
    const view = new DataView(data), kind = view.getUint8(5), frames = view.getUint16(6, true);
    if (kind === Kind.RATE) this.open(view.getFloat32(HEADER_BYTES, true));
    if (kind === Kind.RESET) this.stream?.reset();
    if (kind !== Kind.POSES || !this.stream) return;
    clearTimeout(this.quiet);
    this.quiet = setTimeout(() => this.waiting(this.nobody), QUIET);
    const poses = new Float32Array(data, HEADER_BYTES, 3 * JOINTS * frames);
    const places = new Float32Array(data, HEADER_BYTES + poses.byteLength, 3 * frames);
    const number = this.stream.send(poses, places);
    this.poses.set(number, { pose: poses.subarray(-3 * JOINTS), place: places.subarray(-3), frames });
    if (this.poses.size > 300) this.poses.clear(); // the service is away; it will get them again
  }

  /** A stream of this page's own for the garments, at the sender's rate. */
  open(fps) {
    this.stream?.close();
    this.poses.clear();
    const url = new URL(`/avatars/${encodeURIComponent(this.avatar)}/stream`, location.href);
    this.stream = new GarmentStream(url, { fps, encoding: "uint16", key: apiKey.get() ?? undefined });
    this.stream.onmeshes = (answer) => this.worn(answer);
    this.stream.onerror = ({ code, text }) => this.refused(`${text} (${code})`);
  }

  worn({ number, frames, garments, milliseconds }) {
    const sent = this.poses.get(number);
    for (const before of this.poses.keys()) if (before <= number) this.poses.delete(before);
    if (!sent || !frames || this.closed) return;
    this.figures.note(sent.frames, this.stream.latency, milliseconds);
    this.heard(sent.pose, sent.place, Object.entries(garments).map(([name, { vertices }]) => [name, vertices.subarray(vertices.length - vertices.length / frames)]));
  }

  close() {
    this.closed = true;
    clearTimeout(this.quiet);
    this.socket.close();
    this.stream?.close();
  }
}
