// What the page asks of the service over HTTP. Refusals carry the service's own words.
import { MEDIA_TYPE, decodeAnswer, decodeRequest, encodeRequest } from "./wire.js";

/** The service said no (status > 0) or cannot be reached (status 0). */
export class Refusal extends Error {
  constructor(message, status, wait = null) {
    super(message);
    this.status = status;
    this.wait = wait; // seconds to wait before asking again, where it said so
  }
}

const key = { get: () => sessionStorage.getItem("caphy-key"), set: (value) => sessionStorage.setItem("caphy-key", value) };
export const apiKey = key;

export const listAvatars = async () => (await ask("/avatars")).json();
export const avatarGlb = async (id) => (await ask(`/avatars/${encodeURIComponent(id)}/mesh?format=glb`)).arrayBuffer();

/** The bundled motion of an avatar. */
export async function madeUpMotion(id) {
  return motion(await ask(`/avatars/${encodeURIComponent(id)}/poses`));
}

/** A pose file as poses of an avatar; `fps` where the file does not say its frame rate. */
export async function uploadedMotion(id, file, fps) {
  const query = new URLSearchParams({ name: file.name, ...(fps ? { fps } : {}) });
  const path = `/avatars/${encodeURIComponent(id)}/poses?${query}`;
  return motion(await ask(path, { method: "POST", body: file, headers: { "content-type": MEDIA_TYPE } }));
}

/** Garment meshes for a part of a motion that goes on from `state`. */
export async function framesOf(id, part, signal) {
  const path = `/avatars/${encodeURIComponent(id)}/frames`;
  const answer = await ask(path, { method: "POST", body: encodeRequest(part), headers: { "content-type": MEDIA_TYPE }, signal });
  return decodeAnswer(await answer.arrayBuffer());
}

async function motion(answer) {
  const header = (name, missing) => JSON.parse(answer.headers.get(name) ?? missing);
  return { ...decodeRequest(await answer.arrayBuffer()), source: header("caphy-source", '""'), notes: header("caphy-notes", "[]") };
}

async function ask(path, options = {}) {
  const headers = { ...options.headers, ...(key.get() ? { "x-api-key": key.get() } : {}) };
  let answer;
  try {
    answer = await fetch(path, { ...options, headers });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refusal("The service cannot be reached.", 0);
  }
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({}));
  throw new Refusal(problem.detail ?? `The service answered ${answer.status}.`, answer.status, Number(answer.headers.get("retry-after")) || null);
}
