// The page: loads an avatar and a motion, plays it from a clip or a live stream, and shows what it is told to.
import { AvatarModel } from "./avatar.js";
import { Clip } from "./clip.js";
import { Feed } from "./feed.js";
import { listenToKeys } from "./keys.js";
import { Legend } from "./legend.js";
import { Live } from "./live.js";
import { apiKey, avatarGlb, listAvatars, madeUpMotion, Refusal, uploadedMotion } from "./service.js";
import { Stage } from "./stage.js";
import { PageState } from "./state.js";
import { addGarmentButton, listenToDrops, listenToToolbar } from "./toolbar.js";

const find = (id) => document.getElementById(id);
const asked = new URLSearchParams(location.search); // ?avatar=ID&feed=NAME
const SPEEDS = [0.1, 0.25, 0.5, 1, 2];

class Viewer {
  constructor() {
    this.time = 0; // in frames, with fractions
    this.playing = false;
    this.speed = 1;
    this.wire = false;
    this.heat = ""; // "strain", "depth" or nothing
    this.shown = null; // the frame that is seen
    this.state = new PageState({
      again: () => this.start(),
      dismiss: () => this.state.clear(),
      key: (value) => { apiKey.set(value); this.start(); },
    });
    this.legend = new Legend();
    listenToToolbar(this);
    listenToDrops(this);
    listenToKeys(this);
  }

  async start() {
    try {
      this.state.loading("Loading the avatar…");
      this.stage ??= openStage();
      const avatars = await listAvatars();
      if (!avatars.length) throw new Refusal("The service is still loading its avatars.", 503);
      this.choices(avatars);
      const named = asked.get("avatar"), there = avatars.map(({ id }) => id);
      if (named && !there.includes(named)) {
        throw new Refusal(`There is no avatar '${named}'; there is ${there.join(", ")}.`, 404);
      }
      await this.dress(find("avatar").value);
      if (asked.has("feed")) return this.follow(asked.get("feed"));
      await this.run(await this.fetched(() => madeUpMotion(this.avatar.id)));
    } catch (error) {
      this.failed(error, () => this.start());
    }
  }

  choices(avatars) {
    this.avatars = avatars;
    const select = find("avatar"), before = select.value || asked.get("avatar");
    select.replaceChildren(...avatars.map(({ id, name }) => new Option(name === id ? id : `${name} (${id})`, id)));
    if (avatars.some(({ id }) => id === before)) select.value = before;
    find("avatar-choice").hidden = avatars.length < 2;
  }

  async dress(id) {
    this.undress();
    this.avatar = this.avatars.find((avatar) => avatar.id === id);
    const model = await AvatarModel.load(await avatarGlb(id));
    if (this.model) this.stage.scene.remove(this.model.root);
    this.model = model;
    this.stage.scene.add(model.root);
    for (const button of document.querySelectorAll("#parts [data-garment]")) button.remove();
    [...model.garments.keys()].forEach((name, i) => addGarmentButton(this, name, i + 1));
    this.appearance();
  }

  /** Lets go of the motion: its meshes are another avatar's. */
  undress() {
    this.loading?.abort();
    this.play(false);
    this.goLive(false);
    this.unfollow();
    this.clip = null;
    this.shown = null;
  }

  async fetched(ask) {
    this.state.loading("Loading the motion…");
    return ask();
  }

  /** Takes up a motion: its first frames are shown as soon as they are here, the others follow. */
  async run(motion) {
    this.loading?.abort();
    const loading = (this.loading = new AbortController());
    this.unfollow();
    const clip = (this.clip = new Clip(motion));
    this.live?.close();
    this.time = 0;
    this.shown = null;
    find("scrub").max = clip.frames - 1;
    find("source").textContent = this.describe(clip);
    find("source").title = clip.notes.join("; ");
    if (this.live) this.openLive();
    this.state.loading("Dressing the first frames…");
    await this.fill(clip, loading.signal);
  }

  describe(clip) {
    const cut = clip.frames < clip.whole ? `the first ${Math.round(clip.seconds)} s of ` : "";
    return `${cut}${clip.source} · ${clip.frames} frames at ${clip.fps} per second`;
  }

  /** Fetches the clip's meshes, and goes on by itself where the service was away. */
  async fill(clip, signal) {
    for (let wait = 1; clip === this.clip && clip.ready < clip.frames; wait = Math.min(2 * wait, 8)) {
      try {
        await clip.load(this.avatar.id, () => { wait = 1; this.arrived(clip); }, signal);
      } catch (error) {
        if (error.name === "AbortError") return;
        if (!(error instanceof Refusal) || ![0, 429, 503].includes(error.status)) throw error;
        const seconds = error.wait ?? wait;
        this.state.gone(`Disconnected: ${error.message} Trying again in ${seconds} s.`);
        await new Promise((done) => setTimeout(done, 1000 * seconds));
      }
    }
  }

  arrived(clip) {
    if (clip !== this.clip) return;
    find("ready").style.width = `${(100 * clip.ready) / clip.frames}%`;
    if (["loading", "gone"].includes(this.state.kind) && !this.live?.away) this.state.clear();
    if (this.shown === null) {
      this.show();
      this.stage.home();
      if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.play(true);
    }
  }

  failed(error, again) {
    if (error instanceof Refusal && error.status === 401) return this.state.askForKey(error.message);
    if (error instanceof Refusal && [0, 429, 503].includes(error.status)) {
      this.state.gone(`Disconnected: ${error.message} Trying again in ${error.wait ?? 2} s.`);
      return setTimeout(again, 1000 * (error.wait ?? 2));
    }
    this.play(false);
    this.state.error(error.message, { back: this.shown !== null });
    if (!(error instanceof Refusal)) console.error(error);
  }

  /** Reads a pose file; `fps` is its true frame rate where the file does not say. */
  async openFile(file, fps = null) {
    try {
      await this.run(await this.fetched(() => uploadedMotion(this.avatar.id, file, fps)));
    } catch (error) {
      if (error instanceof Refusal && ![0, 401, 429, 503].includes(error.status)) {
        this.play(false);
        this.state.error(error.message, { back: Boolean(this.clip), again: false });
        if (/frame rate|frames per second/.test(error.message)) this.state.offerRate((rate) => this.openFile(file, rate));
      } else this.failed(error, () => this.openFile(file, fps));
    }
  }

  // Time

  play(on) {
    this.playing = on && Boolean(this.clip);
    find("play").classList.toggle("playing", this.playing);
    find("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
    if (this.playing && !this.ticking) {
      this.before = performance.now();
      this.ticking = requestAnimationFrame((now) => this.tick(now));
    }
  }

  tick(now) {
    this.ticking = 0;
    if (!this.playing) return;
    const { clip } = this, elapsed = Math.max(0, Math.min((now - this.before) / 1000, 0.25));
    this.before = now;
    let time = this.time + elapsed * clip.fps * this.speed;
    if (time >= clip.frames - 1) time = clip.frames > 1 ? time % (clip.frames - 1) : 0;
    this.time = this.live ? time : Math.min(time, Math.max(clip.ready - 1, 0));
    this.show();
    this.ticking = requestAnimationFrame((then) => this.tick(then));
  }

  /** Goes to a frame, in whole frames. */
  seek(frame) {
    if (!this.clip) return;
    this.time = Math.max(0, Math.min(frame, this.clip.frames - 1));
    if (!this.live) this.time = Math.min(this.time, Math.max(this.clip.ready - 1, 0));
    this.show();
  }

  step(frames) {
    this.play(false);
    this.seek(Math.round(this.time) + frames);
  }

  setSpeed(speed) {
    this.speed = speed;
    find("speed").value = String(speed);
  }

  faster(by) {
    this.setSpeed(SPEEDS[Math.max(0, Math.min(SPEEDS.indexOf(this.speed) + by, SPEEDS.length - 1))]);
  }

  // What is seen

  show() {
    const { clip } = this, frame = Math.floor(this.time);
    find("scrub").value = frame;
    const seconds = (this.time / clip.fps).toFixed(2);
    find("clock").textContent = `${seconds} / ${clip.seconds.toFixed(2)} s`;
    find("scrub").setAttribute("aria-valuetext", `frame ${frame}, ${seconds} seconds`);
    if (this.live) this.live.send(frame);
    else if (clip.ready) this.showClip(frame, this.time - frame);
  }

  showClip(frame, share) {
    const { clip, model } = this;
    for (const [name, garment] of model.garments) {
      if (garment.mesh.visible) clip.vertices(name, frame, share, garment.vertices);
    }
    this.posed(frame, share);
  }

  posed(frame, share) {
    const { clip, model } = this, other = Math.min(frame + 1, clip.frames - 1);
    model.pose(clip.pose(frame), clip.place(frame), clip.pose(other), clip.place(other), share);
    this.drawn(frame);
  }

  /** What the model wears and how it stands is seen as `frame`. */
  drawn(frame) {
    const { model } = this;
    model.update();
    const { x, z } = model.bones[0].position;
    this.stage.follow(x, z);
    this.shown = frame;
    if (this.heat) this.legend.read(model, this.playing);
    this.stage.draw();
  }

  appearance() {
    const on = (button) => button.getAttribute("aria-pressed") === "true";
    this.model.body.visible = on(find("body"));
    for (const button of document.querySelectorAll("#parts [data-garment]")) {
      const shown = { visible: on(button), wire: this.wire, heat: this.heat };
      this.model.garments.get(button.dataset.garment).show(shown);
    }
    const ink = getComputedStyle(document.body).color;
    for (const { wire } of this.model.garments.values()) wire.material.color.set(ink);
    this.model.seeThrough(this.heat === "depth"); // what lies inside would not be seen
    this.legend.show(this.heat);
    this.stage.flatten(Boolean(this.heat));
    if (this.shown === null) return;
    if (this.feed) this.drawn(this.shown);
    else if (this.live) this.posed(this.shown, 0);
    else this.show();
  }

  toggle(button) {
    button.setAttribute("aria-pressed", String(button.getAttribute("aria-pressed") !== "true"));
    this.wire = find("wireframe").getAttribute("aria-pressed") === "true";
    if (this.model) this.appearance();
  }

  /** Colours the garments by a heat map, "strain" or "depth", or not at all. */
  colour(heat) {
    this.heat = heat;
    for (const [id, kind] of [["shaded", ""], ["strain", "strain"], ["depth", "depth"]]) {
      find(id).setAttribute("aria-pressed", String(kind === heat));
    }
    if (this.model) this.appearance();
  }

  // The live stream

  goLive(on) {
    if ((on && !this.clip) || on === Boolean(this.live)) return;
    find("clip").setAttribute("aria-pressed", String(!on));
    find("go-live").setAttribute("aria-pressed", String(on));
    find("live").hidden = !on;
    find("ready").hidden = on;
    if (on) this.openLive();
    else {
      this.live.close();
      this.live = null;
      if (this.state.kind === "gone") this.state.clear();
      this.seek(this.time);
    }
  }

  openLive() {
    const away = () => {
      this.live.away = true;
      this.state.gone("Disconnected: the live stream broke off. Trying again…");
    };
    this.live = new Live(this.avatar.id, this.clip, {
      heard: (frame, garments) => this.heardLive(frame, garments),
      lost: away,
      back: () => {
        this.live.away = false;
        if (this.state.kind === "gone") this.state.clear();
        queueMicrotask(() => this.live?.send(Math.floor(this.time))); // after what the stream has left to send
      },
      refused: (text) => { this.goLive(false); this.play(false); this.state.error(text, { back: true, again: false }); },
    });
  }

  heardLive(frame, garments) {
    for (const [name, vertices] of garments) this.model.garments.get(name)?.vertices.set(vertices);
    this.posed(frame, 0);
    this.tell(this.live.figures);
  }

  tell(figures) {
    const now = performance.now();
    if (now - (this.figuresRead ?? 0) < 250) return;
    this.figuresRead = now;
    const { median, most, service, dropped, due, rate } = figures.read();
    find("latency").textContent = `${brief(median)}, ${brief(most)} ms`;
    find("service").textContent = `${brief(service)} ms`;
    find("dropped").textContent = `${dropped} of ${due}`;
    find("rate").textContent = `${rate} / s`;
  }

  // A feed: somebody else's poses

  follow(name) {
    document.body.classList.add("feed");
    find("source").textContent = `feed ${name}`;
    this.model.root.visible = false; // nobody is there yet
    this.feed = new Feed(this.avatar.id, name, {
      heard: (pose, place, garments) => this.heardFeed(pose, place, garments),
      waiting: (text) => { find("live").hidden = true; this.state.gone(text); },
      refused: (text) => this.state.error(text),
    });
  }

  unfollow() {
    if (!this.feed) return;
    this.feed.close();
    this.feed = null;
    document.body.classList.remove("feed");
    find("live").hidden = true;
    this.model.root.visible = true;
  }

  heardFeed(pose, place, garments) {
    if (this.state.kind === "gone") this.state.clear();
    find("live").hidden = false;
    this.model.root.visible = true;
    for (const [name, vertices] of garments) this.model.garments.get(name)?.vertices.set(vertices);
    this.model.pose(pose, place, pose, place, 0);
    const isFirst = this.shown === null;
    this.drawn((this.shown ?? -1) + 1);
    if (isFirst) this.stage.home();
    this.tell(this.feed.figures);
  }
}

const brief = (milliseconds) => milliseconds.toFixed(milliseconds < 20 ? 1 : 0);

function openStage() {
  try {
    return new Stage(find("view"));
  } catch (error) {
    throw new Error(`This page needs WebGL, which this browser does not offer (${error.message}).`);
  }
}

const viewer = new Viewer();
globalThis.caphy = viewer; // to look at from the browser's console
viewer.start();
