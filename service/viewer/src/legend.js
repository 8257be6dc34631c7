// What the colours of strain mean, and how the frame that is seen is spread over them.
import { MOST, RAMP } from "./strain.js";

const PAUSE = 250; // milliseconds between two readings while a motion plays

export class Legend {
  constructor() {
    this.card = document.getElementById("legend");
    this.now = document.getElementById("legend-now");
    this.card.querySelector(".ramp").style.background = `linear-gradient(90deg, ${RAMP.join(",")})`;
    document.getElementById("legend-most").textContent = `${100 * MOST} % and more`;
  }

  show(on) { this.card.hidden = !on; }

  /** Median, 95th percentile and largest of the stretch of all faces that are shown. */
  read(model, playing) {
    const now = performance.now();
    if (playing && now - (this.readAt ?? 0) < PAUSE) return;
    this.readAt = now;
    const shown = [...model.garments.values()].filter((garment) => garment.mesh.visible);
    const sorted = Float32Array.from(shown.flatMap((garment) => [...garment.stretch])).sort();
    const at = (share) => (100 * (sorted[Math.min(Math.floor(share * sorted.length), sorted.length - 1)] ?? 0)).toFixed(0);
    this.now.textContent = `now: median ${at(0.5)} %, 95 % below ${at(0.95)} %, most ${at(1)} %`;
  }
}
