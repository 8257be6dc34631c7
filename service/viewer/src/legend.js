// What the colours of a heat map mean, and how the frame that is seen is spread over them.
import { MOST as DEEPEST } from "./penetration.js";
import { RAMP } from "./ramp.js";
import { MOST } from "./strain.js";

const PAUSE = 250; // milliseconds between two readings while a motion plays
const KINDS = {
  strain: { title: "largest stretch of a face against the template", none: "0 %", most: `${100 * MOST} % and more`, read: spread },
  depth: { title: "depth inside the body, as it is shown", none: "0 mm", most: `${1000 * DEEPEST} mm and more`, read: sunk },
};

export class Legend {
  constructor() {
    this.card = document.getElementById("legend");
    this.now = document.getElementById("legend-now");
    this.card.querySelector(".ramp").style.background = `linear-gradient(90deg, ${RAMP.join(",")})`;
  }

  /** Shows what the colours of a `kind` of heat map mean; nothing where there is none. */
  show(kind) {
    this.card.hidden = !kind;
    this.kind = kind;
    this.readAt = 0;
    if (!kind) return;
    const { title, none, most } = KINDS[kind];
    this.card.querySelector("figcaption").textContent = title;
    document.getElementById("legend-none").textContent = none;
    document.getElementById("legend-most").textContent = most;
  }

  /** How the garments that are shown are spread over the colours. */
  read(model, playing) {
    const now = performance.now();
    if (playing && now - this.readAt < PAUSE) return;
    this.readAt = now;
    this.now.textContent = KINDS[this.kind].read([...model.garments.values()].filter((garment) => garment.mesh.visible));
  }
}

/** Median, 95th percentile and largest of the stretch of all faces. */
function spread(garments) {
  const sorted = Float32Array.from(garments.flatMap((garment) => [...garment.stretch])).sort();
  const at = (share) => (100 * (sorted[Math.min(Math.floor(share * sorted.length), sorted.length - 1)] ?? 0)).toFixed(0);
  return `now: median ${at(0.5)} %, 95 % below ${at(0.95)} %, most ${at(1)} %`;
}

/** Share of the vertices deeper than a millimetre, and the deepest. */
function sunk(garments) {
  const depths = garments.flatMap((garment) => [...garment.depth]), most = depths.reduce((a, b) => Math.max(a, b), 0);
  const share = depths.filter((depth) => depth > 1e-3).length / Math.max(depths.length, 1);
  return `now: ${(100 * share).toFixed(2)} % of vertices deeper than 1 mm, most ${(1000 * most).toFixed(1)} mm`;
}
