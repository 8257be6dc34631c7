// A motion and the garment meshes of its frames, fetched ahead in parts. Vertices are kept as 16-bit steps within each
// frame's bounds: half the memory, and at two metres of reach within 0.02 mm.
import { JOINTS } from "./wire.js";
import { framesOf } from "./service.js";

const PART = 60; // frames asked for at once
export const MOST_FRAMES = 3600; // kept at most: about 100 MB for the default avatar

export class Clip {
  constructor(motion) {
    Object.assign(this, motion); // frames, fps, poses, transl, source, notes
    this.whole = motion.frames;
    this.frames = Math.min(motion.frames, MOST_FRAMES);
    this.ready = 0; // frames whose meshes are here
    this.meshes = new Map();
  }

  get seconds() { return (this.frames - 1) / this.fps; }

  pose(frame) { return this.poses.subarray(frame * JOINTS * 3, (frame + 1) * JOINTS * 3); }
  place(frame) { return this.transl.subarray(frame * 3, (frame + 1) * 3); }

  /** Fetches every frame, going on after the last that is here; calls `heard` after each part. */
  async load(avatar, heard, signal) {
    while (this.ready < this.frames) {
      const first = this.ready, last = Math.min(first + PART, this.frames);
      const part = {
        poses: this.poses.slice(first * JOINTS * 3, last * JOINTS * 3),
        transl: this.transl.slice(first * 3, last * 3),
        fps: this.fps,
        state: this.state ?? new Float32Array(0),
      };
      const answer = await framesOf(avatar, part, signal);
      for (const garment of answer.garments) this.keep(garment, answer.frames);
      this.state = Float32Array.from(answer.garments.flatMap((garment) => [...garment.state]));
      this.ready = last;
      heard();
    }
  }

  keep({ name, count, vertices }, frames) {
    if (!this.meshes.has(name)) this.meshes.set(name, []);
    const list = this.meshes.get(name), size = 3 * count;
    for (let frame = 0; frame < frames; frame++) list.push(pack(vertices.subarray(frame * size, (frame + 1) * size)));
  }

  /** Writes a garment's vertices between frame `frame` and the next (share 0 to 1) into `out` (V * 3). */
  vertices(name, frame, share, out) {
    const list = this.meshes.get(name);
    const before = list[frame], after = list[Math.min(frame + 1, this.ready - 1)];
    const other = share && after !== before;
    for (let i = 0, k = 0; i < out.length; i++, k = k === 2 ? 0 : k + 1) {
      const here = before.low[k] + before.step[k] * before.steps[i];
      out[i] = other ? here + share * (after.low[k] + after.step[k] * after.steps[i] - here) : here;
    }
    return out;
  }
}

function pack(vertices) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < vertices.length; i += 3) for (let k = 0; k < 3; k++) {
    const value = vertices[i + k];
    if (value < low[k]) low[k] = value;
    if (value > high[k]) high[k] = value;
  }
  const step = low.map((least, k) => (high[k] - least) / 65535 || 1e-9);
  const steps = new Uint16Array(vertices.length);
  for (let i = 0; i < vertices.length; i++) steps[i] = Math.round((vertices[i] - low[i % 3]) / step[i % 3]);
  return { low, step, steps };
}
