// Frames one by one, as an application would: each pose goes out when its time comes, the newest one is answered.
import { GarmentStream } from "../../clients/stream.js";
import { Figures } from "./figures.js";
import { apiKey } from "./service.js";
import { JOINTS } from "./wire.js";

const CUT = 8; // frames; a longer step is a cut, and the cloth starts anew

export class Live {
  /** heard(frame, vertices by garment) when meshes arrive; lost(), back() and refused(text) tell of the connection. */
  constructor(avatar, clip, { heard, lost, back, refused }) {
    Object.assign(this, { clip, heard });
    this.figures = new Figures();
    this.frameOf = new Map(); // by the number of their pose
    const url = new URL(`/avatars/${encodeURIComponent(avatar)}/stream`, location.href);
    this.stream = new GarmentStream(url, { fps: clip.fps, encoding: "uint16", key: apiKey.get() ?? undefined });
    this.stream.onmeshes = (answer) => this.take(answer);
    this.stream.onstatus = (status) => {
      if (status === "open") back();
      else if (!this.closed && status === "connecting" && this.known) lost();
      this.known = true;
    };
    this.stream.onerror = ({ code, text }) => refused(`${text} (${code})`);
  }

  /** The pose of a frame, and with it those since the last one sent: cloth lives through them all. */
  send(frame) {
    if (frame === this.last || !this.stream.open) return;
    const step = frame - (this.last ?? frame - 1);
    if (step < 0 || step > CUT) {
      this.stream.reset();
      this.before = frame - 1;
    }
    const first = step < 0 || step > CUT ? frame : frame - step + 1;
    const poses = this.clip.poses.subarray(first * JOINTS * 3, (frame + 1) * JOINTS * 3);
    this.frameOf.set(this.stream.send(poses, this.clip.transl.subarray(first * 3, (frame + 1) * 3)), frame);
    this.last = frame;
  }

  take({ number, frames, garments, milliseconds }) {
    const frame = this.frameOf.get(number);
    for (const sent of this.frameOf.keys()) if (sent <= number) this.frameOf.delete(sent);
    if (frame === undefined || this.closed) return;
    this.figures.note(frame - (this.before ?? frame - 1), this.stream.latency, milliseconds);
    this.before = frame;
    this.heard(frame, Object.entries(garments).map(([name, { vertices }]) => [name, vertices.subarray(vertices.length - vertices.length / frames)]));
  }

  /** Frames that came so far. */
  get seen() { return this.figures.seen; }

  close() {
    this.closed = true;
    this.stream.close();
  }
}
