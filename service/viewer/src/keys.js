// The keyboard. Keys belong to the control that has the focus first: sliders move, buttons press, the picture turns.

const find = (id) => document.getElementById(id);

export function listenToKeys(viewer) {
  const picture = {
    ArrowLeft: () => viewer.stage.turn(-0.12, 0), ArrowRight: () => viewer.stage.turn(0.12, 0),
    ArrowUp: () => viewer.stage.turn(0, 0.08), ArrowDown: () => viewer.stage.turn(0, -0.08),
  };
  const second = () => Math.round(viewer.clip?.fps ?? 30);
  const page = {
    " ": () => viewer.play(!viewer.playing),
    ArrowLeft: (event) => viewer.step(event.shiftKey ? -second() : -1),
    ArrowRight: (event) => viewer.step(event.shiftKey ? second() : 1),
    Home: () => viewer.step(-Infinity), End: () => viewer.step(Infinity),
    "[": () => viewer.faster(-1), "]": () => viewer.faster(1),
    "+": () => viewer.stage.zoom(0.9), "=": () => viewer.stage.zoom(0.9), "-": () => viewer.stage.zoom(1.1),
    l: () => viewer.goLive(!viewer.live), h: () => viewer.colour(viewer.heat === "strain" ? "" : "strain"),
    p: () => viewer.colour(viewer.heat === "depth" ? "" : "depth"),
    w: () => find("wireframe").click(), b: () => find("body").click(),
    o: () => find("open").click(), c: () => find("camera").click(), "?": () => find("help").click(),
  };
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || find("keys").open || !viewer.stage) return;
    const { target } = event, key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (target.matches("select, input:not([type=range])")) return;
    if (target.matches("button") && key === " ") return;
    if (target.matches("input[type=range]") && /^(Arrow|Home|End)/.test(key) && !event.shiftKey) return;
    const garment = /^[1-9]$/.test(key) && document.querySelectorAll("#parts [data-garment]")[key - 1];
    const action = garment ? () => garment.click() : (target === find("view") && picture[key]) || page[key];
    if (!action) return;
    event.preventDefault();
    action(event);
  });
}
