// Buttons, sliders, files: what they do is the viewer's business.

const find = (id) => document.getElementById(id);

export function listenToToolbar(viewer) {
  find("play").addEventListener("click", () => viewer.play(!viewer.playing));
  find("scrub").addEventListener("input", (event) => { viewer.play(false); viewer.seek(Number(event.target.value)); });
  find("speed").addEventListener("change", (event) => viewer.setSpeed(Number(event.target.value)));
  find("clip").addEventListener("click", () => viewer.goLive(false));
  find("go-live").addEventListener("click", () => viewer.goLive(true));
  find("shaded").addEventListener("click", () => viewer.colour(""));
  for (const id of ["strain", "depth"]) find(id).addEventListener("click", () => viewer.colour(id));
  for (const id of ["wireframe", "body"]) find(id).addEventListener("click", () => viewer.toggle(find(id)));
  find("open").addEventListener("click", () => find("file").click());
  find("file").addEventListener("change", (event) => {
    const [file] = event.target.files;
    event.target.value = ""; // so that the same file may be chosen again
    if (file) viewer.openFile(file);
  });
  find("camera").addEventListener("click", () => viewer.stage?.home());
  find("help").addEventListener("click", () => find("keys").showModal());
  find("avatar").addEventListener("change", () => viewer.start());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => viewer.model && viewer.appearance());
}

/** A button that shows and hides a garment; `key` is its number on the keyboard. */
export function addGarmentButton(viewer, name, key) {
  const button = document.createElement("button");
  Object.assign(button, { type: "button", textContent: name, title: `${name} (${key})` });
  button.dataset.garment = name;
  button.setAttribute("aria-pressed", "true");
  button.addEventListener("click", () => viewer.toggle(button));
  find("parts").append(button);
}

/** Pose files dropped anywhere on the page. */
export function listenToDrops(viewer) {
  let depth = 0;
  const hint = (by) => { depth = Math.max(0, depth + by); find("drop").hidden = depth === 0; };
  addEventListener("dragenter", (event) => { event.preventDefault(); hint(1); });
  addEventListener("dragleave", () => hint(-1));
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => {
    event.preventDefault();
    hint(-depth);
    const [file] = event.dataTransfer.files;
    if (file && viewer.avatar) viewer.openFile(file);
  });
}
