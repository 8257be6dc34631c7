// Colours of heat maps, from nothing to the most; lightness falls all the way, so that they read without hues too.

export const RAMP = ["#dfe7ee", "#f6cf45", "#ee7b35", "#c3263f", "#4c1350"];

const STOPS = RAMP.map((hex) => [1, 3, 5].map((i) => linear(parseInt(hex.slice(i, i + 2), 16) / 255)));

function linear(c) {
  return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
}

/** The colour of a share of the most (0 to 1, more is cut), linear light, written into `out` at `offset`. */
export function rampColour(share, out, offset) {
  const place = Math.min(share, 1) * (STOPS.length - 1);
  const i = Math.min(Math.floor(place), STOPS.length - 2), rest = place - i;
  for (let k = 0; k < 3; k++) out[offset + k] = STOPS[i][k] + rest * (STOPS[i + 1][k] - STOPS[i][k]);
}
