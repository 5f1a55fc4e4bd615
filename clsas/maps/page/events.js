// Pointers, keys and controls; then the start of the page.
"use strict";

function resize() {
  const box = canvas.getBoundingClientRect();
  size.width = box.width || 1;
  size.height = box.height || 1;
  size.ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(size.width * size.ratio);
  canvas.height = Math.round(size.height * size.ratio);
  const footer = document.querySelector("footer").offsetHeight;
  document.documentElement.style.setProperty("--footer", `${footer}px`);
  showNames();
  redraw();
}

const pointers = new Map();
let pressed = null;
const placeOf = (event) => {
  const box = canvas.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
};

canvas.addEventListener("pointerdown", (event) => {
  if (event.button > 1) return;
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, placeOf(event));
  pressed = pointers.size === 1 ? placeOf(event) : null;
  state.pointer = placeOf(event);
  state.keyboard = false;
  redraw();
});

canvas.addEventListener("pointermove", (event) => {
  const place = placeOf(event);
  const before = pointers.get(event.pointerId);
  state.pointer = place;
  state.keyboard = false;
  if (!before) return redraw();
  if (pointers.size === 1) {
    if (pressed && Math.hypot(place[0] - pressed[0], place[1] - pressed[1]) > 4) {
      move(place[0] - pressed[0], place[1] - pressed[1]);
      pressed = null;
      canvas.classList.add("moving");
    } else if (!pressed) {
      move(place[0] - before[0], place[1] - before[1]);
    }
  } else if (pointers.size === 2) {
    const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    const apart = (one) => Math.hypot(one[0] - other[0], one[1] - other[1]);
    const middle = [(place[0] + other[0]) / 2, (place[1] + other[1]) / 2];
    move((place[0] - before[0]) / 2, (place[1] - before[1]) / 2);
    zoom(apart(place) / Math.max(apart(before), 1), ...middle);
  }
  pointers.set(event.pointerId, place);
  redraw();
});

const released = (event) => {
  const click = event.type === "pointerup" && pressed && pointers.size === 1;
  pointers.delete(event.pointerId);
  pressed = null;
  canvas.classList.remove("moving");
  if (click && state.measuring) addPoint(fromScreen(...placeOf(event)));
};
canvas.addEventListener("pointerup", released);
canvas.addEventListener("pointercancel", released);
canvas.addEventListener("pointerleave", (event) => {
  if (event.pointerType === "mouse" && !pointers.size) state.pointer = null;
  redraw();
});
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const lines = event.deltaMode === 1 ? 30 : 1;
  zoom(2 ** (-event.deltaY * lines / 240), ...placeOf(event));
}, { passive: false });
canvas.addEventListener("dblclick", (event) => {
  if (!state.measuring) zoom(2, ...placeOf(event));
});

$("divider").addEventListener("pointerdown", (event) => {
  $("divider").setPointerCapture(event.pointerId);
});
$("divider").addEventListener("pointermove", (event) => {
  if ($("divider").hasPointerCapture(event.pointerId)) setSplit(placeOf(event)[0] / size.width);
});
$("divider").addEventListener("keydown", (event) => {
  const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
  if (!step) return;
  setSplit(state.split + step);
  event.stopPropagation();
  event.preventDefault();
});

for (const end of ["low", "high"]) {
  $(end).addEventListener("input", () => setLevel(end, Number($(end).value)));
}
for (const name of Object.keys(scene.colours)) $("colours").append(new Option(name, name));
$("colours").addEventListener("change", () => { levels.colours = $("colours").value; recolour(); });
$("auto").onclick = autoLevels;
$("reset").onclick = () => { Object.assign(levels, FIRST); recolour(); };
$("fit").onclick = fit;
const oneToOne = () => { zoom(1 / (pixelM * view.scale * size.ratio)); };
$("pixels").onclick = oneToOne;
$("measure").onclick = () => measure();
$("patches").onclick = () => toggle("patches", "patches");
$("axes").onclick = () => toggle("axes", "axes");
$("open").onclick = () => showPanel($("panel").hidden);
$("help").onclick = () => $("keys").showModal();
$("go").addEventListener("submit", (event) => { event.preventDefault(); go($("place").value); });
$("place").addEventListener("input", () => $("place").setCustomValidity(""));
document.querySelectorAll("[data-mode]").forEach((button) => {
  button.onclick = () => setMode(button.dataset.mode);
});

const nextColours = () => {
  const names = Object.keys(scene.colours);
  levels.colours = names[(names.indexOf(levels.colours) + 1) % names.length];
  recolour();
};
const KEYS = {
  ArrowLeft: () => move(size.width / 8, 0), ArrowRight: () => move(-size.width / 8, 0),
  ArrowUp: () => move(0, size.height / 8), ArrowDown: () => move(0, -size.height / 8),
  "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5), 0: fit, 9: oneToOne,
  "[": () => setLevel("low", levels.low - 1), "]": () => setLevel("low", levels.low + 1),
  "{": () => setLevel("high", levels.high - 1), "}": () => setLevel("high", levels.high + 1),
  a: autoLevels, r: () => $("reset").click(), m: nextColours,
  d: () => measure(), Escape: () => measure(false),
  Enter: () => state.measuring && addPoint([view.u, view.v]),
  x: () => $("axes").click(), p: () => scene.patches.length && $("patches").click(),
  1: () => setMode("0"), 2: () => setMode("1"),
  s: () => setMode("swipe"), b: () => setMode("blink"),
  ",": () => setSplit(state.split - 0.02), ".": () => setSplit(state.split + 0.02),
  c: () => $("open").click(), "?": () => $("keys").showModal(),
  g: () => { showPanel(true); $("place").focus(); },
};
const CENTRED = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "+", "=", "-", "Enter"];

window.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return;
  const tag = event.target.tagName;
  const typing = tag === "INPUT" && event.target.type === "text";
  const own = ["Enter", " ", "ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"].includes(event.key);
  if (typing || (own && ["BUTTON", "SELECT", "INPUT"].includes(tag))) {
    if (typing && event.key === "Escape") canvas.focus();
    return;
  }
  const run = KEYS[event.key] ?? KEYS[event.key.toLowerCase()];
  if (!run) return;
  event.preventDefault();
  if (CENTRED.includes(event.key)) state.keyboard = true;
  run();
  redraw();
});

// Start

document.title = `${scene.names.join(" / ")} – clsas`;
$("patches").hidden = !scene.patches.length;
$("compare").hidden = scene.names.length < 2;
scene.names.forEach((name, index) => {
  document.querySelector(`[data-mode="${index}"]`).title = `${name} (${index + 1})`;
});
$("place").placeholder = pair.map((axis) => AXES[axis]).join(", ");
showPanel(window.innerWidth > 640);
resize();
readAddress();
recolour();
new ResizeObserver(resize).observe(canvas);
new ResizeObserver(resize).observe(document.querySelector("footer"));
window.addEventListener("hashchange", () => { readAddress(); recolour(); });
