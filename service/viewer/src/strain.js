// Largest stretch of every face against the garment's template: the larger singular value of the deformation gradient
// F = [b - a, c - a] D^-1, less one. D holds the template's edges in the plane of the face.

/** Per face the inverse of D as (d00, d01, d11), upper triangular; faces without area get zeros and show no strain. */
export function restInverse(template, faces) {
  const inverse = new Float32Array(faces.length);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => 3 * faces[f + k]);
    const u = [0, 1, 2].map((k) => template[b + k] - template[a + k]);
    const v = [0, 1, 2].map((k) => template[c + k] - template[a + k]);
    const length = Math.hypot(...u);
    const along = length && (u[0] * v[0] + u[1] * v[1] + u[2] * v[2]) / length;
    const height = Math.sqrt(Math.max(v[0] ** 2 + v[1] ** 2 + v[2] ** 2 - along ** 2, 0));
    if (length > 1e-9 && height > 1e-9) inverse.set([1 / length, -along / (length * height), 1 / height], f);
  }
  return inverse;
}

/** Writes the largest stretch of each face (1 is 100 %), zero where a face is only compressed, into `out` (F). */
export function largestStretch(vertices, faces, inverse, out) {
  for (let f = 0, i = 0; f < faces.length; f += 3, i++) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const p = inverse[f], q = inverse[f + 1], r = inverse[f + 2];
    let uu = 0, uv = 0, vv = 0;
    for (let k = 0; k < 3; k++) {
      const e = vertices[b + k] - vertices[a + k], g = vertices[c + k] - vertices[a + k];
      const first = e * p, second = e * q + g * r;
      uu += first * first; uv += first * second; vv += second * second;
    }
    const largest = (uu + vv) / 2 + Math.hypot((uu - vv) / 2, uv);
    out[i] = r ? Math.max(Math.sqrt(largest) - 1, 0) : 0;
  }
  return out;
}

export const MOST = 0.25; // stretch that gets the last colour
