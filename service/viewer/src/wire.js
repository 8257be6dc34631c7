// The binary frames request and its answer, as docs/protocol.md has them byte by byte. Little-endian throughout.

export const JOINTS = 55;
export const MEDIA_TYPE = "application/octet-stream";

/** The body of a request for frames; poses (T * 55 * 3), transl (T * 3) and state are Float32Arrays. */
export function encodeRequest({ poses, transl, fps, state }) {
  const header = new ArrayBuffer(24);
  const view = new DataView(header);
  [..."CPHQ"].forEach((letter, i) => view.setUint8(i, letter.charCodeAt(0)));
  view.setUint16(4, 1, true);
  view.setUint32(8, transl.length / 3, true);
  view.setUint32(12, JOINTS, true);
  view.setFloat32(16, fps, true);
  view.setUint32(20, state.length, true);
  return new Blob([header, poses, transl, state]);
}

/** What the service answers for a motion: its own request, to be sent on in parts. */
export function decodeRequest(buffer) {
  const view = new DataView(buffer);
  if (magic(view) !== "CPHQ") throw new Error("the service did not answer with poses");
  const frames = view.getUint32(8, true);
  const poses = new Float32Array(buffer, 24, frames * JOINTS * 3);
  const transl = new Float32Array(buffer, 24 + poses.byteLength, frames * 3);
  return { frames, fps: view.getFloat32(16, true), poses, transl };
}

/** { frames, fps, garments: [{ name, vertices (T * V * 3), count, state }] } */
export function decodeAnswer(buffer) {
  const view = new DataView(buffer);
  if (magic(view) !== "CPHR") throw new Error("the service did not answer with frames");
  const count = view.getUint16(6, true), frames = view.getUint32(8, true);
  let offset = 20 + 48 * count;
  const garments = [];
  for (let i = 0; i < count; i++) {
    const record = 20 + 48 * i;
    const letters = new Uint8Array(buffer, record, 40);
    const name = String.fromCharCode(...letters.subarray(0, letters.indexOf(0)));
    const vertexCount = view.getUint32(record + 40, true), states = view.getUint32(record + 44, true);
    const vertices = new Float32Array(buffer, offset, frames * vertexCount * 3);
    offset += vertices.byteLength;
    garments.push({ name, count: vertexCount, vertices, state: new Float32Array(buffer, offset, states) });
    offset += 4 * states;
  }
  return { frames, fps: view.getFloat32(12, true), garments };
}

function magic(view) {
  return String.fromCharCode(...[0, 1, 2, 3].map((i) => view.getUint8(i)));
}
