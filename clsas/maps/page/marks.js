// What is drawn over the image, and the line below it: patches, distances, axes, scale, readout.
"use strict";

function outlined(text, x, y, colour = "#fff") {
  draw.lineWidth = 3;
  draw.lineJoin = "round";
  draw.strokeStyle = "rgba(0,0,0,.75)";
  draw.strokeText(text, x, y);
  draw.fillStyle = colour;
  draw.fillText(text, x, y);
}

function stroked(path, colour, width) {
  for (const [style, extra] of [["rgba(0,0,0,.6)", 2], [colour, 0]]) {
    draw.strokeStyle = style;
    draw.lineWidth = width + extra;
    draw.beginPath();
    path();
    draw.stroke();
  }
}

function drawPatches() {
  draw.font = "12px system-ui, sans-serif";
  draw.textAlign = "left";
  draw.textBaseline = "top";
  for (const [row, column, rows, columns, predicted, measured, words] of scene.patches) {
    const [lastColumn, lastRow] = [column + columns, row + rows];
    const points = [[column, row], [lastColumn, row], [lastColumn, lastRow], [column, lastRow]]
      .map(([c, r]) => toScreen(...toPlane(c - 0.5, r - 0.5)));
    const [xs, ys] = [0, 1].map((axis) => points.map((point) => point[axis]));
    const [left, right] = [Math.min(...xs), Math.max(...xs)];
    const [top, bottom] = [Math.min(...ys), Math.max(...ys)];
    if (right < 0 || bottom < 0 || left > size.width || top > size.height) continue;
    const colour = words ? "#ffb454" : "#4fd1ff";
    stroked(() => {
      points.forEach(([x, y], i) => (i ? draw.lineTo(x, y) : draw.moveTo(x, y)));
      draw.closePath();
    }, colour, 1);
    const text = patchText(predicted, measured, words, false);
    const [x, y] = [left < 36 ? 42 : left + 6, Math.max(top, 30) + 5]; // beside numbers of the axis
    const fits = right - x > draw.measureText(text).width + 6 && bottom - y > 16;
    if (fits) outlined(text, x, y, colour);
  }
}

// Of a label, or of the `whole` line below the image.
function patchText(predicted, measured, words, whole) {
  const inDb = (name, error) => (error === null ? "" : `${name}${minus(error.toFixed(1))} dB`);
  const errors = [inDb(whole ? "predicted error " : "", predicted), inDb("measured ", measured)]
    .filter(Boolean).join(", ");
  return whole || !errors ? [errors, words].filter(Boolean).join(", ") : errors;
}

function drawMeasure() {
  const points = [...state.points];
  const at = state.measuring && points.length === 1 ? pointed() : null;
  if (at) points.push(at);
  if (!points.length) {
    $("distance").textContent = state.measuring ? "Distance: first point" : "";
    return;
  }
  const [a, b] = points.map((point) => toScreen(...point));
  stroked(() => {
    for (const [x, y] of b ? [a, b] : [a]) {
      draw.moveTo(x - 6, y); draw.lineTo(x + 6, y);
      draw.moveTo(x, y - 6); draw.lineTo(x, y + 6);
    }
    if (b) { draw.moveTo(...a); draw.lineTo(...b); }
  }, "#4fd1ff", 1.5);
  if (!b) {
    $("distance").textContent = "Distance: second point";
    return;
  }
  const length = Math.hypot(points[1][0] - points[0][0], points[1][1] - points[0][1]);
  const ends = points.map((point) => toSpace(...toPixel(...point)));
  const parts = shownAxes.map(
    (axis) => `Δ${AXES[axis]} ${minus(inMetres(ends[1][axis] - ends[0][axis]))}`);
  $("distance").textContent = `${inMetres(length)} m (${parts.join(", ")} m)`;
  draw.font = "600 13px system-ui, sans-serif";
  draw.textAlign = "center";
  draw.textBaseline = "bottom";
  outlined(`${inMetres(length)} m`, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 6, "#4fd1ff");
}

function drawCross() {
  const [x, y] = [size.width / 2, size.height / 2];
  stroked(() => {
    draw.moveTo(x - 10, y); draw.lineTo(x + 10, y);
    draw.moveTo(x, y - 10); draw.lineTo(x, y + 10);
  }, "#fff", 1);
}

function nice(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].find((digit) => digit * power <= length) * power;
}

// Numbers of one scale, with as many decimals as their steps need.
const ticked = (value, step) =>
  minus(value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))));

function drawAxes() {
  draw.font = "11px system-ui, sans-serif";
  const step = nice(110 / view.scale);
  const [[left, top], [right, bottom]] = [fromScreen(0, 0), fromScreen(size.width, size.height)];
  const ends = [[left, right], [bottom, top]];
  const spots = [];
  alongSide.forEach((along, side) => {
    if (!along) return;
    const [low, high] = ends[side].map((end) => along.sign * end).sort((a, b) => a - b);
    for (let k = Math.ceil(low / step); k <= high / step; k += 1) {
      const [x, y] = toScreen(along.sign * k * step, along.sign * k * step);
      spots.push({ side, x, y, text: ticked(k * step, step) });
    }
  });
  stroked(() => {
    for (const { side, x, y } of spots) {
      if (side) { draw.moveTo(0, y); draw.lineTo(7, y); }
      else { draw.moveTo(x, size.height); draw.lineTo(x, size.height - 7); }
    }
  }, "#fff", 1);
  const labelY = scene.geographic ? 78 : 40;
  for (const { side, x, y, text } of spots) {
    draw.textAlign = side ? "left" : "center";
    draw.textBaseline = side ? "middle" : "bottom";
    if (side ? y < labelY + 20 || y > size.height - 26 : x < 30 || x > size.width - 60) continue;
    if (side) outlined(text, 10, y);
    else outlined(text, x, size.height - 9);
  }
  draw.font = "600 11px system-ui, sans-serif";
  alongSide.forEach((along, side) => {
    if (!along) return;
    draw.textAlign = side ? "left" : "right";
    draw.textBaseline = side ? "top" : "bottom";
    outlined(`${along.name} (m)`, side ? 10 : size.width - 8, side ? labelY : size.height - 9);
  });
}

function showScale() {
  const length = nice(Math.min(160, size.width / 3) / view.scale);
  $("scale-bar").style.width = `${length * view.scale}px`;
  const [unit, perMetre] = [["km", 1e-3], ["m", 1], ["cm", 100], ["mm", 1000]].find(
    ([, factor]) => length * factor > 0.9999) ?? ["mm", 1000];
  const text = `${Number((length * perMetre).toPrecision(3))} ${unit}`;
  if ($("scale-length").textContent !== text) $("scale-length").textContent = text;
}

// Position that the pointer or, with keys, the cross in the middle is at.
const pointed = () => {
  if (state.keyboard) return [view.u, view.v];
  return state.pointer && fromScreen(...state.pointer);
};

const imageAt = () => {
  if (state.mode !== "swipe") return state.shown;
  const x = state.keyboard ? size.width / 2 : state.pointer?.[0] ?? 0;
  return x < state.split * size.width ? 0 : 1;
};

function showReadout() {
  const at = pointed();
  const [column, row] = at ? toPixel(...at) : [-1, -1];
  const [c, r] = [Math.round(column), Math.round(row)];
  const inside = at && c >= 0 && r >= 0 && c < COLUMNS && r < ROWS;
  const show = (id, text) => {
    if ($(id).textContent !== text) $(id).textContent = text;
  };
  const position = inside ? toSpace(column, row) : [];
  const parts = shownAxes.map((axis) => `${AXES[axis]} ${minus(inMetres(position[axis] ?? 0))} m`);
  show("cursor", inside ? parts.join(", ") : "");
  const db = inside ? levelAt(imageAt(), c, r) : null;
  const unknown = isMissing(imageAt(), c, r) ? "missing" : "loading";
  const level = db === undefined ? unknown : db === null ? "no data" : `${minus(db.toFixed(1))} dB`;
  show("level", inside ? level : "");
  show("missing", missing.size ? "tile missing: copy the whole folder" : "");
  let text = "";
  if (inside && scene.geographic) {
    const [latitude, longitude] = geographic(column, row);
    text = `${inDegrees(latitude, "N", "S")}, ${inDegrees(longitude, "E", "W")}`;
  }
  show("geographic", text);
  const patch = inside && state.patches && scene.patches.find(([top, left, rows, columns]) =>
    r >= top && c >= left && r < top + rows && c < left + columns);
  show("patch", patch ? patchText(...patch.slice(4), true) : "");
}

function showNorth() {
  $("north").hidden = !scene.geographic;
  if (!scene.geographic) return;
  // North is across the direction in which only longitude changes.
  const [column, row] = [COLUMNS / 2, ROWS / 2];
  const here = geographic(column, row)[0];
  const step = Math.max(1, Math.min(COLUMNS, ROWS) / 100);
  const slopes = [[column + step, row], [column, row + step]].map(
    (place) => geographic(...place)[0] - here);
  // Gradient of the latitude in metres to the right and up.
  const east = (slopes[0] * rv - slopes[1] * cv) / determinant;
  const north = (slopes[1] * cu - slopes[0] * ru) / determinant;
  const degrees = (Math.atan2(east, north) * 180) / Math.PI;
  $("north").firstElementChild.style.transform = `rotate(${degrees}deg)`;
}
