// Streams a motion by the JavaScript client: node --experimental-websocket stream_client.mjs URL MOTION ENCODING OUT
// MOTION: JSON of { fps, poses: [[165 numbers]], transl: [[3 numbers]], pause: frames, credits }. After `pause` frames it
// prints "paused" and waits for a line; then it sends the rest, and writes what it received to OUT as JSON.
import { readFileSync, writeFileSync } from "node:fs";
import { GarmentStream } from "../../service/clients/stream.js";

const [url, file, encoding, out] = process.argv.slice(2);
const motion = JSON.parse(readFileSync(file));
const stream = new GarmentStream(url, { encoding, fps: motion.fps, credits: 64 });
const received = [];
const errors = [];
stream.onmeshes = ({ number, tick, garments }) => {
  received.push({ number, tick, vertices: Object.fromEntries(Object.entries(garments).map(([k, g]) => [k, Array.from(g.vertices)])) });
};
stream.onerror = ({ code, text }) => errors.push({ code, text });
const welcomed = new Promise((resolve) => (stream.onwelcome = resolve));
const line = new Promise((resolve) => process.stdin.once("data", resolve));
const until = async (done) => {
  while (!done()) await new Promise((resolve) => setTimeout(resolve, 5));
};
const send = (frame) => stream.send(Float32Array.from(motion.poses[frame]), Float32Array.from(motion.transl[frame]));

await welcomed;
for (let frame = 0; frame < motion.pause; frame++) send(frame);
await until(() => received.length === motion.pause);
const state = await stream.state();
console.log("paused");
await line;
for (let frame = motion.pause; frame < motion.poses.length; frame++) send(frame);
await until(() => received.length === motion.poses.length);
const sizes = Object.fromEntries(Object.entries(state).map(([k, s]) => [k, s.length]));
writeFileSync(out, JSON.stringify({ received, errors, sizes, reconnections: stream.reconnections, latency: stream.latency }));
stream.close();
process.exit(0);
