// The part of the plane that is on the screen, and when and how it is drawn.
"use strict";

const FIRST = { low: Math.max(-scene.range_db, LOWEST_DB), high: 0 };

const canvas = $("view");
const draw = canvas.getContext("2d");
const view = { u: 0, v: 0, scale: 1 }; // middle of the screen, and CSS pixels per metre
const size = { width: 1, height: 1, ratio: 1 };
const levels = { ...FIRST, colours: Object.keys(scene.colours)[0] };
const state = {
  mode: "0", shown: 0, split: 0.5, patches: false, axes: true, measuring: false,
  points: [], pointer: null, keyboard: false,
};

const toScreen = (u, v) => [
  size.width / 2 + (u - view.u) * view.scale, size.height / 2 - (v - view.v) * view.scale];
const fromScreen = (x, y) => [
  view.u + (x - size.width / 2) / view.scale, view.v - (y - size.height / 2) / view.scale];

const corners = [-0.5, COLUMNS - 0.5].flatMap(
  (column) => [-0.5, ROWS - 0.5].map((row) => toPlane(column, row)));
const bounds = [0, 1].map((axis) => {
  const values = corners.map((corner) => corner[axis]);
  return [Math.min(...values), Math.max(...values)];
});

// Width that the controls cover, if they are beside the image.
const covered = () => (size.width > 640 && !$("panel").hidden ? $("panel").offsetWidth + 10 : 0);

function fitScale() {
  const margin = state.axes ? 1.1 : 1.02;
  const width = (size.width - covered()) / (bounds[0][1] - bounds[0][0]);
  return Math.min(width, size.height / (bounds[1][1] - bounds[1][0])) / margin;
}

function fit() {
  view.scale = fitScale();
  view.u = (bounds[0][0] + bounds[0][1]) / 2 + covered() / 2 / view.scale;
  view.v = (bounds[1][0] + bounds[1][1]) / 2;
  changed();
}

function zoom(factor, x = size.width / 2, y = size.height / 2) {
  const [u, v] = fromScreen(x, y);
  const most = 64 / finestM;
  view.scale = Math.min(Math.max(view.scale * factor, fitScale() / 4), Math.max(most, fitScale()));
  const [nu, nv] = fromScreen(x, y);
  view.u += u - nu;
  view.v += v - nv;
  changed();
}

function move(dx, dy) {
  view.u = Math.min(Math.max(view.u - dx / view.scale, bounds[0][0]), bounds[0][1]);
  view.v = Math.min(Math.max(view.v + dy / view.scale, bounds[1][0]), bounds[1][1]);
  changed();
}

let due = false, hashTimer = 0;

function redraw() {
  if (!due) {
    due = true;
    requestAnimationFrame(drawAll);
  }
}

function changed() {
  clearTimeout(hashTimer);
  hashTimer = setTimeout(writeAddress, 300);
  redraw();
}

function drawAll() {
  due = false;
  wanted = [];
  draw.setTransform(1, 0, 0, 1, 0, 0);
  draw.clearRect(0, 0, canvas.width, canvas.height);
  if (state.mode === "swipe") {
    const x = Math.round(state.split * canvas.width);
    [[0, 0, x], [1, x, canvas.width - x]].forEach(([image, left, width]) => {
      draw.save();
      draw.beginPath();
      draw.rect(left, 0, width, canvas.height);
      draw.clip();
      drawImage(image);
      draw.restore();
    });
  } else {
    if (state.mode === "blink") drawImage(1 - state.shown); // loads its tiles, and is drawn over
    if (state.mode === "blink") draw.clearRect(0, 0, canvas.width, canvas.height);
    drawImage(state.shown);
  }
  draw.setTransform(size.ratio, 0, 0, size.ratio, 0, 0);
  if (state.patches) drawPatches();
  drawMeasure();
  if (state.keyboard) drawCross();
  if (state.axes) drawAxes();
  showScale();
  showReadout();
  showNorth();
  forget();
  loadWanted();
  document.body.dataset.loading = String(loading + wanted.length);
}
