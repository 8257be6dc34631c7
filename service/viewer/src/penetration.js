// How deep each vertex of a garment lies inside the body: the distance to the nearest point of the body's surface, where
// that surface's outside is turned away from the vertex.

export const MOST = 0.01; // depth that gets the last colour [m]
const CELL = 0.025, REACH = 2; // of the grid that finds what is near [m], and how many cells away is looked

/** The body's surface as it is posed now; `place` it once for each frame, then ask for `depths`. */
export class BodySurface {
  constructor(body) {
    this.body = body;
    const { position, skinIndex, skinWeight } = body.geometry.attributes;
    this.count = position.count;
    this.faces = body.geometry.index.array;
    this.rest = Float32Array.from(position.array);
    this.joints = Uint16Array.from({ length: 4 * this.count }, (_, i) => skinIndex.getComponent(i >> 2, i & 3));
    this.weights = Float32Array.from({ length: 4 * this.count }, (_, i) => skinWeight.getComponent(i >> 2, i & 3));
    this.points = new Float32Array(3 * this.count);
    this.next = new Int32Array(this.count);
    this.around = facesAround(this.faces, this.count);
  }

  /** Moves the surface to where the bones are now. */
  place() {
    const { skeleton } = this.body;
    skeleton.bones[0].updateWorldMatrix(true, true);
    skeleton.update();
    const { boneMatrices: m } = skeleton, { rest, joints, weights, points } = this;
    for (let v = 0; v < this.count; v++) {
      const x = rest[3 * v], y = rest[3 * v + 1], z = rest[3 * v + 2];
      let px = 0, py = 0, pz = 0;
      for (let k = 4 * v; k < 4 * v + 4; k++) {
        const w = weights[k], b = 16 * joints[k];
        if (!w) continue;
        px += w * (m[b] * x + m[b + 4] * y + m[b + 8] * z + m[b + 12]);
        py += w * (m[b + 1] * x + m[b + 5] * y + m[b + 9] * z + m[b + 13]);
        pz += w * (m[b + 2] * x + m[b + 6] * y + m[b + 10] * z + m[b + 14]);
      }
      points[3 * v] = px; points[3 * v + 1] = py; points[3 * v + 2] = pz;
    }
    this.sort();
  }

  /** Puts every vertex into its cell of a grid around the body. */
  sort() {
    const { points } = this, low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let k = 0; k < 3; k++) for (let i = k; i < points.length; i += 3) {
      if (points[i] < low[k]) low[k] = points[i];
      if (points[i] > high[k]) high[k] = points[i];
    }
    this.low = low;
    this.size = low.map((from, k) => Math.floor((high[k] - from) / CELL) + 1);
    const [wide, tall, long] = this.size, [x, y, z] = low;
    if (!this.first || this.first.length < wide * tall * long) this.first = new Int32Array(wide * tall * long);
    this.first.fill(-1);
    for (let v = 0, i = 0; v < this.count; v++, i += 3) {
      const column = Math.floor((points[i] - x) / CELL) + wide * Math.floor((points[i + 1] - y) / CELL);
      const cell = column + wide * tall * Math.floor((points[i + 2] - z) / CELL);
      this.next[v] = this.first[cell];
      this.first[cell] = v;
    }
  }

  /** Writes how deep each of `vertices` (3 V) lies inside [m], zero outside, into `out` (V). */
  depths(vertices, out) {
    for (let v = 0; v < out.length; v++) {
      const x = vertices[3 * v], y = vertices[3 * v + 1], z = vertices[3 * v + 2], near = this.nearest(x, y, z);
      out[v] = near < 0 || this.isOutside(x, y, z, near) ? 0 : this.depth(x, y, z, near);
    }
    return out;
  }

  /** The nearest vertex of the body, -1 where none is within the grid's reach. */
  nearest(x, y, z) {
    const { points, next, first, low } = this, [wide, tall, long] = this.size;
    const i = Math.floor((x - low[0]) / CELL), j = Math.floor((y - low[1]) / CELL), k = Math.floor((z - low[2]) / CELL);
    let best = (REACH * CELL) ** 2, found = -1;
    for (let reach = 1; reach <= REACH && found < 0; reach++) {
      const i0 = Math.max(i - reach, 0), i1 = Math.min(i + reach, wide - 1), j0 = Math.max(j - reach, 0);
      const j1 = Math.min(j + reach, tall - 1), k1 = Math.min(k + reach, long - 1);
      for (let c = Math.max(k - reach, 0); c <= k1; c++) for (let b = j0; b <= j1; b++) for (let a = i0; a <= i1; a++) {
        for (let v = first[(c * tall + b) * wide + a]; v >= 0; v = next[v]) {
          const dx = points[3 * v] - x, dy = points[3 * v + 1] - y, dz = points[3 * v + 2] - z;
          const squared = dx * dx + dy * dy + dz * dz;
          if (squared < best) { best = squared; found = v; }
        }
      }
    }
    return found;
  }

  /** Whether all faces around vertex `near` face the point: nearly always, and soon told. */
  isOutside(x, y, z, near) {
    const { starts, list } = this.around, { points: p, faces } = this;
    x -= p[3 * near]; y -= p[3 * near + 1]; z -= p[3 * near + 2];
    for (let s = starts[near]; s < starts[near + 1]; s++) {
      const a = 3 * faces[list[s]], b = 3 * faces[list[s] + 1], c = 3 * faces[list[s] + 2];
      const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      if (x * (uy * vz - uz * vy) + y * (uz * vx - ux * vz) + z * (ux * vy - uy * vx) <= 0) return false;
    }
    return true;
  }

  /** Distance to the nearest point of the faces around vertex `near`, zero where it is on the outside. */
  depth(x, y, z, near) {
    const { starts, list } = this.around, { points: p, faces } = this;
    let best = Infinity, inside = 0;
    for (let s = starts[near]; s < starts[near + 1]; s++) {
      const a = 3 * faces[list[s]], b = 3 * faces[list[s] + 1], c = 3 * faces[list[s] + 2];
      const u = [p[b] - p[a], p[b + 1] - p[a + 1], p[b + 2] - p[a + 2]];
      const v = [p[c] - p[a], p[c + 1] - p[a + 1], p[c + 2] - p[a + 2]];
      const w = [x - p[a], y - p[a + 1], z - p[a + 2]];
      const [s1, s2] = closest(u, v, w), r = [0, 1, 2].map((k) => w[k] - s1 * u[k] - s2 * v[k]);
      const squared = dot(r, r), n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const along = dot(r, n) / (Math.sqrt(dot(n, n)) || 1);
      // faces that share the nearest point: the one most faced decides
      if (squared < best - 1e-12) { best = squared; inside = along; } else if (squared < best + 1e-12 && Math.abs(along) > Math.abs(inside)) inside = along;
    }
    return inside < 0 ? Math.sqrt(best) : 0;
  }
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Shares (s, t) of u and v that give the point of a triangle at 0, u, v nearest to w (Ericson 2005, section 5.1.5). */
function closest(u, v, w) {
  const d1 = dot(u, w), d2 = dot(v, w);
  if (d1 <= 0 && d2 <= 0) return [0, 0];
  const uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), d3 = d1 - uu, d4 = d2 - uv, d5 = d1 - uv, d6 = d2 - vv;
  if (d3 >= 0 && d4 <= d3) return [1, 0];
  if (d6 >= 0 && d5 <= d6) return [0, 1];
  const c = d1 * d4 - d3 * d2, b = d5 * d2 - d1 * d6, a = d3 * d6 - d5 * d4;
  if (c <= 0 && d1 >= 0 && d3 <= 0) return [d1 / (d1 - d3), 0];
  if (b <= 0 && d2 >= 0 && d6 <= 0) return [0, d2 / (d2 - d6)];
  if (a <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) {
    const share = (d4 - d3) / (d4 - d3 + d5 - d6);
    return [1 - share, share];
  }
  return [b / (a + b + c), c / (a + b + c)];
}

/** Per vertex the faces around it: offsets into the index, `list[starts[v]]` to `list[starts[v + 1] - 1]`. */
function facesAround(faces, count) {
  const starts = new Int32Array(count + 1), list = new Int32Array(faces.length);
  for (const v of faces) starts[v + 1]++;
  for (let v = 0; v < count; v++) starts[v + 1] += starts[v];
  const at = starts.slice();
  for (let i = 0; i < faces.length; i++) list[at[faces[i]]++] = i - (i % 3);
  return { starts, list };
}
