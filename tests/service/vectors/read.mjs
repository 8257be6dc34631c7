// What the JavaScript client makes of the vectors: node read.mjs, JSON on standard output.
import { readFileSync } from "node:fs";
import * as stream from "../../../service/clients/stream.js";

const file = (name) => {
  const bytes = readFileSync(new URL(name, import.meta.url));
  return bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
};
const hex = (buffer) => Buffer.from(buffer).toString("hex");
const plain = (key, value) => (ArrayBuffer.isView(value) ? Array.from(value) : value);
const meaning = JSON.parse(readFileSync(new URL("vectors.json", import.meta.url)));

const encode = {
  hello: (m) => stream.encodeHello(m),
  poses: (m) => stream.encodePoses(m.number, m.time, m.poses, m.transl),
  seen: (m) => stream.encodeSeen(m.number, m.time, m.poses, m.transl, m.times, m.confidence),
  credit: (m) => stream.encodeCredit(m.count),
  reset: () => stream.encodeReset(),
  rate: (m) => stream.encodeRate(m.fps),
  get_state: (m) => stream.encodeGetState(m.time),
};

const found = { encoded: {}, decoded: {}, refused: {} };
for (const [name, meant] of Object.entries(meaning)) {
  if (name.startsWith("client_")) {
    found.encoded[name] = hex(encode[meant.kind](meant));
    continue;
  }
  const decoder = new stream.ServerDecoder(meant.encoding, meant.normals, meant.conditioned);
  decoder.garments = [{ name: "hat", count: meant.count ?? 2, stateSize: 3 }];
  const body = file(`${name}.bin`);
  found.decoded[name] = decoder.decode(body);
  found.refused[name] = 0;
  const cuts = meant.kind === "error" ? 24 : body.byteLength;
  for (let end = 0; end < cuts; end++) {
    try {
      decoder.decode(body.slice(0, end));
    } catch (error) {
      if (!(error instanceof RangeError)) throw error;
      found.refused[name]++;
    }
  }
}
console.log(JSON.stringify(found, plain));
