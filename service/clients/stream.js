/**
 * The stream's client for browsers and node: poses in, meshes out, and a new connection with the old state where one
 * breaks. An ES module without dependencies; docs/stream.md is the protocol.
 *
 *   const stream = new GarmentStream("ws://127.0.0.1:8000/avatars/default/stream", { encoding: "uint16" });
 *   stream.onwelcome = (welcome) => ...;   // { fps, garments: [{ name, count, stateSize }], maxFrames, maxCredits }
 *   stream.onmeshes = (answer) => ...;     // { number, tick, frames, skipped, time, garments: { tshirt: { vertices } } }
 *   stream.send(poses, transl);            // Float32Array of 165 and of 3 for every frame
 *
 * With { conditioning: {} }, or settings in it, the service makes noisy poses calm first (docs/conditioning.md):
 *
 *   stream.send(poses, transl, times, confidence);  // seconds, one for every frame; 0 to 1, 55 for every frame
 *   stream.onmeshes = ({ did, shown }) => ...;       // what was done to each frame; the first one's moment [s]
 */

export const VERSION = 1;
export const JOINTS = 55;
export const HEADER_BYTES = 24;
export const Kind = Object.freeze({
  HELLO: 1, POSES: 2, CREDIT: 3, RESET: 4, RATE: 5, GET_STATE: 6, SEEN: 7, WELCOME: 129, MESHES: 130, STATE: 131, ERROR: 132,
});
export const Encoding = Object.freeze({ float32: 0, float16: 1, uint16: 2, weights: 3 });
const MAGIC = 0x53485043; // "CPHS" read as a little-endian number
const NORMALS = 1;
const NAME_BYTES = 40;
const GARMENT_BYTES = 48;
const FRAME_FLOATS = 3 * JOINTS + 3;
const SAVE_EVERY = 30;
/** Frames per second that a service takes poses at. */
const RATES = [1, 1000];
/** Close codes after which the same again would fail again. */
const FINAL = new Set([4400, 4404, 4409, 4413, 4422, 1008]);

function start(kind, bytes, { count = 0, number = 0, extra = 0, time = 0 } = {}) {
  const view = new DataView(new ArrayBuffer(HEADER_BYTES + bytes));
  view.setUint32(0, MAGIC, true);
  view.setUint8(4, VERSION);
  view.setUint8(5, kind);
  view.setUint16(6, count, true);
  view.setUint32(8, number, true);
  view.setUint32(12, extra, true);
  view.setFloat64(16, time, true);
  return view;
}

/** Floats after the header; float by float, because the machine may not be little-endian. */
function putFloats(view, offset, floats) {
  for (let i = 0; i < floats.length; i++) view.setFloat32(offset + 4 * i, floats[i], true);
}

export function encodeHello({ garments = [], fps = 30, encoding = "float32", normals = false, credits = 2, state = [], conditioning } = {}) {
  if (!(encoding in Encoding)) throw new RangeError(`encoding must be one of ${Object.keys(Encoding).join(", ")}, got ${encoding}`);
  const text = new TextEncoder().encode(conditioning ? JSON.stringify(conditioning) : "");
  const counts = { count: garments.length, number: text.length, extra: state.length };
  const view = start(Kind.HELLO, 8 + NAME_BYTES * garments.length + 4 * state.length + text.length, counts);
  view.setFloat32(24, fps, true);
  view.setUint16(28, credits, true);
  view.setUint8(30, Encoding[encoding]);
  view.setUint8(31, normals ? NORMALS : 0);
  garments.forEach((name, i) => {
    if (name.length > NAME_BYTES) throw new RangeError(`a garment's name may have ${NAME_BYTES} letters, got ${name}`);
    for (let j = 0; j < name.length; j++) view.setUint8(32 + NAME_BYTES * i + j, name.charCodeAt(j));
  });
  putFloats(view, 32 + NAME_BYTES * garments.length, state);
  new Uint8Array(view.buffer).set(text, view.byteLength - text.length);
  return view.buffer;
}

/** Poses of T frames: 165 T floats [rad] and 3 T floats [m]; number is that of the first. */
export function encodePoses(number, time, poses, transl) {
  const frames = transl.length / 3;
  if (!Number.isInteger(frames) || frames < 1 || poses.length !== 3 * JOINTS * frames) {
    throw new RangeError(`poses must hold ${3 * JOINTS} floats and transl 3 for every frame, got ${poses.length} and ${transl.length}`);
  }
  const view = start(Kind.POSES, 4 * FRAME_FLOATS * frames, { count: frames, number, time });
  putFloats(view, HEADER_BYTES, poses);
  putFloats(view, HEADER_BYTES + 4 * poses.length, transl);
  return view.buffer;
}

/** Poses for a conditioned stream: T times [s], and 55 T confidences; 0 throughout where nobody was seen. */
export function encodeSeen(number, time, poses, transl, times, confidence) {
  const frames = times.length;
  if (poses.length !== 3 * JOINTS * frames || transl.length !== 3 * frames || confidence.length !== JOINTS * frames) {
    throw new RangeError(`for ${frames} times there must be ${3 * JOINTS * frames} floats of poses, ${3 * frames} of transl and `
      + `${JOINTS * frames} of confidence, got ${poses.length}, ${transl.length} and ${confidence.length}`);
  }
  const view = start(Kind.SEEN, frames * (8 + 4 * (FRAME_FLOATS + JOINTS)), { count: frames, number, time });
  for (let i = 0; i < frames; i++) view.setFloat64(HEADER_BYTES + 8 * i, times[i], true);
  const at = HEADER_BYTES + 8 * frames;
  putFloats(view, at, poses);
  putFloats(view, at + 4 * poses.length, transl);
  putFloats(view, at + 4 * (poses.length + transl.length), confidence);
  return view.buffer;
}

export const encodeCredit = (count) => start(Kind.CREDIT, 0, { extra: count }).buffer;
export const encodeReset = () => start(Kind.RESET, 0).buffer;
export const encodeGetState = (time = 0) => start(Kind.GET_STATE, 0, { time }).buffer;
export function encodeRate(fps) {
  const view = start(Kind.RATE, 4);
  view.setFloat32(24, fps, true);
  return view.buffer;
}

/** Takes arrays off a message one after another, each padded to four bytes; RangeError where it ends too early. */
class Reader {
  constructor(buffer, offset) {
    this.buffer = buffer;
    this.offset = offset;
  }

  take(Kind, count) {
    const array = new Kind(this.buffer, this.offset, count);
    this.offset += Math.ceil(array.byteLength / 4) * 4;
    if (this.offset > this.buffer.byteLength) throw new RangeError("the message is cut short");
    return array;
  }
}

let halves = null;

/** All half floats, by their bits. */
function halfTable() {
  if (halves) return halves;
  halves = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    if (exponent === 31) halves[bits] = fraction ? NaN : sign * Infinity;
    else if (exponent === 0) halves[bits] = sign * fraction * 2 ** -24;
    else halves[bits] = sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  }
  return halves;
}

function readHalves(reader, count) {
  const table = halfTable();
  const bits = reader.take(Uint16Array, count);
  return Float32Array.from(bits, (value) => table[value]);
}

const READERS = {
  float32: (reader, frames, count) => reader.take(Float32Array, 3 * frames * count),
  float16: (reader, frames, count) => {
    const centre = reader.take(Float32Array, 3 * frames);
    const vertices = readHalves(reader, 3 * frames * count);
    for (let i = 0; i < vertices.length; i++) vertices[i] += centre[3 * Math.floor(i / (3 * count)) + (i % 3)];
    return vertices;
  },
  uint16: (reader, frames, count) => {
    const low = reader.take(Float32Array, 3 * frames);
    const step = reader.take(Float32Array, 3 * frames);
    const steps = reader.take(Uint16Array, 3 * frames * count);
    const vertices = new Float32Array(steps.length);
    for (let frame = 0, i = 0; frame < frames; frame++) {
      const at = 3 * frame;
      for (let vertex = 0; vertex < count; vertex++, i += 3) {
        vertices[i] = low[at] + step[at] * steps[i];
        vertices[i + 1] = low[at + 1] + step[at + 1] * steps[i + 1];
        vertices[i + 2] = low[at + 2] + step[at + 2] * steps[i + 2];
      }
    }
    return vertices;
  },
};

/** Reads the server's messages; what the client chose and the welcome said tells how meshes are packed. */
export class ServerDecoder {
  constructor(encoding = "float32", normals = false, conditioned = false) {
    this.encoding = encoding;
    this.normals = normals;
    this.conditioned = conditioned;
    this.garments = [];
  }

  /** The message in an ArrayBuffer: { kind, ... }; throws RangeError or TypeError where it is none. */
  decode(buffer) {
    const view = new DataView(buffer);
    if (buffer.byteLength < HEADER_BYTES || view.getUint32(0, true) !== MAGIC || view.getUint8(4) !== VERSION) {
      throw new RangeError("a message starts with CPHS and version 1");
    }
    const kind = view.getUint8(5);
    const count = view.getUint16(6, true);
    const number = view.getUint32(8, true);
    const extra = view.getUint32(12, true);
    const time = view.getFloat64(16, true);
    if (kind === Kind.WELCOME) return this.#welcome(view, count, time);
    if (kind === Kind.MESHES) return this.#meshes(view, { kind, frames: count, number, skipped: extra, time });
    if (kind === Kind.STATE) return { kind, number, time, state: new Float32Array(buffer, HEADER_BYTES, extra) };
    if (kind === Kind.ERROR) {
      return { kind, number, code: extra, text: new TextDecoder().decode(new Uint8Array(buffer, HEADER_BYTES)) };
    }
    throw new RangeError(`a server sends no message of type ${kind}`);
  }

  #welcome(view, count, latency) {
    this.garments = Array.from({ length: count }, (_, i) => {
      const at = 32 + GARMENT_BYTES * i;
      const name = String.fromCharCode(...new Uint8Array(view.buffer, at, NAME_BYTES)).replace(/\0+$/, "");
      return { name, count: view.getUint32(at + NAME_BYTES, true), stateSize: view.getUint32(at + NAME_BYTES + 4, true) };
    });
    const fps = view.getFloat32(24, true);
    const maxFrames = view.getUint16(28, true);
    return { kind: Kind.WELCOME, fps, maxFrames, maxCredits: view.getUint16(30, true), garments: this.garments, latency };
  }

  #meshes(view, message) {
    const reader = new Reader(view.buffer, 32);
    const answer = { ...message, tick: view.getUint32(24, true), milliseconds: view.getFloat32(28, true), garments: {} };
    if (this.conditioned) {
      answer.shown = view.getFloat64(32, true);
      reader.offset = 40;
      answer.did = reader.take(Uint8Array, message.frames);
    }
    if (this.encoding === "weights") {
      answer.root = reader.take(Float32Array, 3 * message.frames);
      answer.rotations = reader.take(Float32Array, 4 * JOINTS * message.frames);
    }
    for (const { name, count } of this.garments) {
      if (this.encoding === "weights") {
        answer.garments[name] = { weights: readHalves(reader, message.frames * count) };
        reader.offset = Math.ceil(reader.offset / 4) * 4;
        continue;
      }
      answer.garments[name] = { vertices: READERS[this.encoding](reader, message.frames, count) };
      if (this.normals) answer.garments[name].normals = reader.take(Int8Array, 4 * message.frames * count);
    }
    return answer;
  }
}

/**
 * One stream that stays: where its connection breaks, it is made again with the last state the service told and all
 * poses sent since; meshes received already are not given twice.
 *
 * Set onwelcome, onmeshes, onerror ({ code, text }: a message was refused, the stream goes on), onstatus ("connecting",
 * "open", "closed"). `key` is an API key, `state` what state() said of a motion to continue, or its floats in the order
 * of the welcome. A credit goes back with every answer, after onmeshes has returned.
 */
export class GarmentStream {
  onwelcome = () => {};
  onmeshes = () => {};
  onerror = () => {};
  onstatus = () => {};
  skipped = 0;
  reconnections = 0;
  /** Milliseconds from the last answered poses' departure to their meshes' arrival. */
  latency = NaN;
  welcome = null;

  #url; #options; #socket = null; #closed = false; #wait = 50; #timer = null;
  #number = 0; #received = 0; #unsaved = []; #sinceSaved = 0; #state = new Float32Array(0); #asked = [];
  #named = null; // states by name, until a welcome says in which order they go
  #settled = 0; // the pose after which #state is
  #motion = 0; // goes with every request for the state and comes back, to tell states from before a reset

  constructor(url, { key, state, ...options } = {}) {
    this.#url = String(url).replace(/^http/, "ws");
    this.#options = { fps: 30, encoding: "float32", normals: false, credits: 2, garments: [], ...options, key };
    const kind = Object.prototype.toString.call(state);
    if (ArrayBuffer.isView(state) || Array.isArray(state)) this.#state = Float32Array.from(state);
    else if (kind === "[object Object]") this.#named = Object.keys(state).length ? state : null;
    else if (state != null) throw new TypeError(`state must be what state() said, or its floats, got ${kind}`);
    this.#connect();
  }

  get open() {
    return this.welcome !== null && this.#socket?.readyState === 1;
  }

  /** Send frames of poses (165 floats each) and transl (3 floats each); returns the last one's number. On a conditioned
   * stream `times` [s] are when they were seen, and `confidence` (55 for each, or none: all sure) how surely. Of a
   * closed stream nothing is sent or kept. */
  send(poses, transl, times, confidence) {
    if (this.#closed) return this.#number;
    const number = this.#number + 1;
    const body = times
      ? encodeSeen(number, now(), poses, transl, times, confidence ?? new Float32Array(JOINTS * times.length).fill(1))
      : encodePoses(number, now(), poses, transl);
    this.#number += transl.length / 3;
    this.#unsaved.push({ first: number, last: this.#number, body });
    if (this.open) this.#socket.send(body);
    if (++this.#sinceSaved >= SAVE_EVERY) {
      this.#sinceSaved = 0;
      if (this.open) this.#socket.send(encodeGetState(this.#motion));
    }
    return this.#number;
  }

  /** The state of every garment after all poses sent so far: a promise of { tshirt: Float32Array }, rejected where the
   * stream is closed first. */
  state() {
    return new Promise((resolve, reject) => {
      if (this.#closed) throw new Error("the stream is closed");
      this.#asked.push({ motion: this.#motion, after: this.#lastUpTo(Infinity), resolve, reject });
      if (this.open) this.#socket.send(encodeGetState(this.#motion));
    });
  }

  /** The next pose starts a new motion; of the old one no meshes are given any more. */
  reset() {
    this.#motion++;
    this.#settled = this.#received = this.#number;
    this.#forgetSettled();
    this.#state = new Float32Array(0);
    this.#named = null;
    if (this.open) this.#socket.send(encodeReset());
  }

  /** The poses from here on come at this rate. */
  setFps(fps) {
    if (!(fps >= RATES[0] && fps <= RATES[1])) throw new RangeError(`fps must lie between ${RATES.join(" and ")}, got ${fps}`);
    const body = encodeRate(fps);
    this.#unsaved.push({ fps, body });
    if (this.open) this.#socket.send(body);
  }

  close() {
    this.#closed = true;
    clearTimeout(this.#timer);
    this.#rejectAsked("the stream is closed");
    this.#socket?.close(1000);
  }

  #connect() {
    this.onstatus("connecting");
    const { key, ...hello } = this.#options;
    const socket = new WebSocket(this.#url, protocolsOf(key));
    const decoder = new ServerDecoder(hello.encoding, hello.normals, Boolean(hello.conditioning));
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => socket.send(encodeHello({ ...hello, state: this.#state }));
    socket.onmessage = (event) => this.#take(decoder.decode(event.data));
    socket.onclose = (event) => this.#lost(event);
    socket.onerror = () => {}; // onclose follows and says more
  }

  #take(message) {
    switch (message.kind) {
      case Kind.WELCOME:
        if (this.#named) return this.#continueNamed(message.garments);
        this.welcome = message;
        this.#wait = 50;
        for (const { body } of this.#unsaved) this.#socket.send(body);
        if (this.#unsaved.length || this.#asked.length) this.#socket.send(encodeGetState(this.#motion));
        this.onstatus("open"); // after what was sent before: either of these may send poses
        this.onwelcome(message);
        break;
      case Kind.MESHES:
        this.skipped = message.skipped;
        if (message.number > this.#received) {
          this.#received = message.number;
          this.latency = now() * 1e3 - message.time * 1e3;
          this.onmeshes(message);
        }
        if (this.open) this.#socket.send(encodeCredit(1));
        break;
      case Kind.STATE:
        this.#settle(message);
        break;
      case Kind.ERROR:
        this.#unsaved = this.#unsaved.filter(({ first }) => first !== message.number);
        for (const asked of this.#asked) {
          if (asked.motion === this.#motion) asked.after = this.#lastUpTo(asked.after); // the refused are in no state
        }
        this.onerror(message);
    }
  }

  /** Connect anew with the states given by name, now that the garments' order is known. */
  #continueNamed(garments) {
    const named = this.#named, said = (name, size) => `${name} (${size} floats)`;
    this.#named = null;
    this.#socket.onclose = null;
    this.#socket.close(1000);
    const wanted = garments.map(({ name, stateSize }) => said(name, stateSize)).sort().join(", ");
    const got = Object.entries(named).map(([name, part]) => said(name, part?.length)).sort().join(", ");
    if (wanted !== got) return this.#end(422, `state: must hold ${wanted}, got ${got}`);
    this.#state = Float32Array.from(garments.flatMap(({ name }) => Array.from(named[name])));
    this.#connect();
  }

  #settle({ number, time: motion, state }) {
    if (motion === this.#motion) {
      this.#state = state;
      number = this.#settled = Math.max(this.#settled, number); // a new connection counts no poses before its own
      this.#forgetSettled();
    }
    const waiting = [];
    for (const asked of this.#asked) {
      if (asked.motion > motion || (asked.motion === motion && asked.after > number)) {
        waiting.push(asked);
        continue;
      }
      let at = 0;
      const parts = this.welcome.garments.map(({ name, stateSize }) => [name, state.slice(at, (at += stateSize))]);
      asked.resolve(Object.fromEntries(parts));
    }
    this.#asked = waiting;
  }

  /** The last pose, up to a number, that is or will be in the state; the refused are not. */
  #lastUpTo(number) {
    return this.#unsaved.reduce((most, { last }) => (last <= number ? last : most), this.#settled);
  }

  /** Forget the poses that the state has in it, and the rates before those that it has not. */
  #forgetSettled() {
    while (this.#unsaved.length && !(this.#unsaved[0].last > this.#settled)) {
      const { fps } = this.#unsaved.shift();
      if (fps) this.#options.fps = fps; // the rate where the state is
    }
  }

  #rejectAsked(text) {
    for (const { reject } of this.#asked) reject(new Error(text));
    this.#asked = [];
  }

  #end(code, text) {
    this.#closed = true;
    this.#rejectAsked(`${text} (${code})`);
    this.onerror({ code, text, number: 0 });
    this.onstatus("closed");
  }

  #lost({ code, reason }) {
    this.welcome = null;
    if (FINAL.has(code)) return this.#end(code >= 4000 ? code - 4000 : 403, reason);
    if (this.#closed) return this.onstatus("closed");
    this.onstatus("connecting");
    this.reconnections++;
    this.#timer = setTimeout(() => this.#connect(), this.#wait);
    this.#wait = Math.min(5000, 2 * this.#wait);
  }
}

/** Seconds of a clock that only goes forward. */
const now = () => performance.now() / 1e3;

/** How a browser, which cannot set headers of a WebSocket, sends an API key. */
export const protocolsOf = (key) => (key ? ["caphy", `caphy.key.${base64url(key)}`] : []);

function base64url(text) {
  const bytes = String.fromCharCode(...new TextEncoder().encode(text));
  return btoa(bytes).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}
