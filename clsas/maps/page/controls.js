// What the controls do: levels, colours, the two images, distances, going to a position.
"use strict";

const BLINK_MS = 700;

function recolour() {
  palette = colourTable();
  paletteVersion += 1;
  showLevels();
  changed();
}

function showLevels() {
  for (const end of ["low", "high"]) {
    $(end).min = LOWEST_DB;
    $(end).max = 0;
    $(end).value = levels[end];
    $(`${end}-db`).textContent = `${minus(levels[end].toFixed(1))} dB`;
    $(end).setAttribute("aria-valuetext", `${levels[end].toFixed(1)} dB`);
  }
  $("colours").value = levels.colours;
  const bar = $("bar"), bytes = scene.colours[levels.colours];
  bar.width = 256;
  const context = bar.getContext("2d");
  for (let x = 0; x < 256; x += 1) {
    const db = LOWEST_DB * (1 - x / 255);
    const share = Math.min(Math.max((db - levels.low) / (levels.high - levels.low), 0), 1);
    context.fillStyle = `#${bytes.substr(6 * Math.round(255 * share), 6)}`;
    context.fillRect(x, 0, 1, 14);
  }
}

const LEAST_DB = 1; // between the ends of the colours

function setLevel(end, db) {
  const other = end === "low" ? "high" : "low";
  levels[end] = Math.min(Math.max(db, LOWEST_DB), 0);
  if (levels.high - levels.low < LEAST_DB) {
    levels[other] = end === "low" ? levels.low + LEAST_DB : levels.high - LEAST_DB;
    if (levels.high > 0) Object.assign(levels, { high: 0, low: -LEAST_DB });
    if (levels.low < LOWEST_DB) {
      Object.assign(levels, { low: LOWEST_DB, high: LOWEST_DB + LEAST_DB });
    }
  }
  recolour();
}

// Levels between which 99.45 % of the pixels in view lie.
function autoLevels() {
  const level = levelInView();
  const [[left, right], [top, bottom]] = windowInView(level);
  const counts = new Float64Array(256);
  for (let row = Math.floor(top / SIDE); row * SIDE < bottom; row += 1) {
    for (let column = Math.floor(left / SIDE); column * SIDE < right; column += 1) {
      const tile = tileAt(imageAt(), level, column, row, false);
      if (!tile) continue;
      const [x0, y0] = [column * SIDE, row * SIDE];
      for (let y = Math.max(top - y0, 0); y < Math.min(bottom - y0, tile.height); y += 1) {
        for (let x = Math.max(left - x0, 0); x < Math.min(right - x0, tile.width); x += 1) {
          counts[tile.levels[y * tile.width + x]] += 1;
        }
      }
    }
  }
  counts[0] = 0;
  const total = counts.reduce((sum, count) => sum + count, 0);
  if (!total) return;
  const percentile = (share) => {
    let sum = 0;
    return counts.findIndex((count) => (sum += count) >= share * total);
  };
  const [low, high] = [0.005, 0.9995].map(
    (share) => (percentile(share) - BRIGHTEST) * scene.step_db);
  levels.low = Math.max(Math.round(2 * low) / 2, LOWEST_DB);
  levels.high = Math.max(Math.min(Math.round(2 * high) / 2, 0), levels.low + LEAST_DB);
  recolour();
}

function setMode(mode) {
  if (scene.names.length < 2) return;
  state.mode = mode;
  if (mode === "0" || mode === "1") state.shown = Number(mode);
  $("divider").hidden = mode !== "swipe";
  document.querySelectorAll("[data-mode]").forEach((button) =>
    button.setAttribute("aria-pressed", String(button.dataset.mode === mode)));
  showNames();
  changed();
}

function showNames() {
  const swiping = state.mode === "swipe";
  $("name-0").textContent = scene.names[swiping ? 0 : state.shown];
  $("name-1").textContent = swiping ? scene.names[1] : "";
  const shown = swiping ? scene.formed : [scene.formed[state.shown]];
  $("formed").textContent = shown.filter((words) => words).join(" / ");
  $("divider").style.left = `${state.split * 100}%`;
  $("divider").style.height = `${size.height}px`;
  $("divider").setAttribute("aria-valuenow", String(Math.round(state.split * 100)));
}

function setSplit(share) {
  state.split = Math.min(Math.max(share, 0), 1);
  showNames();
  changed();
}

setInterval(() => {
  if (state.mode !== "blink" || document.hidden) return;
  state.shown = 1 - state.shown;
  showNames();
  redraw();
}, BLINK_MS);

function toggle(name, button, value = !state[name]) {
  state[name] = value;
  $(button).setAttribute("aria-pressed", String(value));
  changed();
}

function measure(on = !state.measuring) {
  state.points = [];
  toggle("measuring", "measure", on);
}

function addPoint(point) {
  if (!point) return;
  if (state.points.length > 1) state.points = [];
  state.points.push(point);
  redraw();
}

function showPanel(open) {
  $("panel").hidden = !open;
  $("open").setAttribute("aria-expanded", String(open));
}

function go(text) {
  const found = text.replaceAll("−", "-").match(/[-+]?\d*\.?\d+(e[-+]?\d+)?/gi);
  const numbers = (found ?? []).map(Number);
  if (numbers.length !== 2 || !numbers.every(Number.isFinite)) {
    $("place").setCustomValidity(`Two numbers, such as ${$("place").placeholder}`);
    $("place").reportValidity();
    return;
  }
  [view.u, view.v] = fromPair(...numbers);
  view.scale = Math.max(view.scale, 4 / pixelM / size.ratio);
  move(0, 0);
  state.keyboard = true; // shows the cross at the position
  canvas.focus({ preventScroll: true });
  changed();
}

// The address keeps the view, so that a page that is loaded again, or a link, shows the same.
function writeAddress() {
  const parts = {
    u: view.u.toFixed(decimals), v: view.v.toFixed(decimals), scale: view.scale.toPrecision(5),
    ...levels,
  };
  if (state.mode !== "0") parts.mode = state.mode;
  try {
    history.replaceState(null, "", `#${new URLSearchParams(parts)}`);
  } catch {
    // Some browsers refuse this for pages on a disk; the view is then not kept.
  }
}

function readAddress() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const number = (name) => (parts.get(name) === null ? NaN : Number(parts.get(name)));
  if ([number("low"), number("high")].every(Number.isFinite) && number("high") > number("low")) {
    levels.high = Math.min(Math.max(number("high"), LOWEST_DB + LEAST_DB), 0);
    levels.low = Math.min(Math.max(number("low"), LOWEST_DB), levels.high - LEAST_DB);
  }
  if (Object.hasOwn(scene.colours, parts.get("colours"))) levels.colours = parts.get("colours");
  if (number("scale") > 0 && Number.isFinite(number("u")) && Number.isFinite(number("v"))) {
    Object.assign(view, { u: number("u"), v: number("v"), scale: number("scale") });
    // Within limits. The middle of the view may be beside the image, where controls cover a part.
    const most = Math.max(...bounds.map(([low, high]) => high - low));
    ["u", "v"].forEach((name, axis) => {
      const [low, high] = bounds[axis];
      view[name] = Math.min(Math.max(view[name], low - most), high + most);
    });
    zoom(1);
  } else {
    fit();
  }
  const mode = parts.get("mode");
  setMode(["1", "swipe", "blink"].includes(mode) ? mode : "0");
}
