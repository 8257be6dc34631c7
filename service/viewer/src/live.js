// Frames one by one, as an application would: each pose goes out when its time comes, the newest one wins.
import { Refusal, framesOf } from "./service.js";

const REMEMBERED = 240; // latencies that the figures shown are taken over

export class Live {
  /** heard(frame, garments) when meshes arrive; lost(text) and back() when the service goes and comes. */
  constructor(avatar, fps, { heard, lost, back }) {
    Object.assign(this, { avatar, fps, heard, lost, back });
    this.state = new Float32Array(0);
    this.latencies = [];
    this.sent = this.dropped = 0;
    this.arrivals = [];
  }

  send(frame, poses, transl) {
    this.sent += 1;
    if (this.waiting) this.dropped += 1;
    this.waiting = { frame, poses, transl };
    this.next();
  }

  async next() {
    if (this.busy || !this.waiting || this.closed) return;
    this.busy = true;
    const { frame, poses, transl } = this.waiting, started = performance.now();
    this.waiting = null;
    try {
      const answer = await framesOf(this.avatar, { poses, transl, fps: this.fps, state: this.state });
      this.state = Float32Array.from(answer.garments.flatMap((garment) => [...garment.state]));
      this.note(performance.now() - started);
      this.heard(frame, new Map(answer.garments.map((garment) => [garment.name, garment.vertices])));
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      this.lost(error.message);
    } finally {
      this.busy = false;
    }
    this.next();
  }

  note(latency) {
    const now = performance.now();
    this.latencies.push(latency);
    this.arrivals.push(now);
    if (this.latencies.length > REMEMBERED) this.latencies.shift();
    while (this.arrivals[0] < now - 1000) this.arrivals.shift();
  }

  /** Forget the motion so far. */
  reset() { this.state = new Float32Array(0); }

  close() { this.closed = true; }

  /** Median and 95th percentile of latency [ms], frames dropped and sent, frames that came within the last second. */
  figures() {
    const sorted = [...this.latencies].sort((a, b) => a - b);
    const at = (share) => sorted[Math.min(Math.floor(share * sorted.length), sorted.length - 1)];
    return { median: at(0.5), most: at(0.95), dropped: this.dropped, sent: this.sent, rate: this.arrivals.length };
  }
}
