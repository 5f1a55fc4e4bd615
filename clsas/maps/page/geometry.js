// The scene, and where its pixels are: on the plane of the screen, in space, and on Earth.
//
// A page on a disk can load no modules. Its scripts share one scope, and follow each other as in
// index.html: geometry, view, tiles, marks, controls, events.
"use strict";

const scene = window.clsasScene;
const $ = (id) => document.getElementById(id);

// Show why the page does not work, and end it.
function trouble(text) {
  const box = document.createElement("div");
  box.id = "trouble";
  box.setAttribute("role", "alert");
  box.textContent = text;
  document.body.append(box);
  throw new Error(text);
}

if (!scene) trouble("scene.js is missing: copy the whole folder, not only this page.");
if (!window.DecompressionStream) trouble("This browser is too old: any from 2023 on will do.");

const [ROWS, COLUMNS] = scene.shape;
const [COARSEST, FINEST] = scene.scales; // numbered as levels of Deep Zoom
const SIDE = scene.side;
// Rows and columns of the image that a pixel of a level covers.
const factorsOf = (level) => scene.factors[level - COARSEST];
const BRIGHTEST = scene.brightest; // level of 0 dB; 0 where nothing was received
const LOWEST_DB = -Math.floor((BRIGHTEST - 1) * scene.step_db);

// The plane of the screen has metres to the right and up: u and v.

const frame = scene.frame;
const [u0, v0] = frame.screen_origin;
const [cu, cv] = frame.screen_column_step;
const [ru, rv] = frame.screen_row_step;
const determinant = cu * rv - ru * cv;
const pixelM = Math.sqrt(Math.abs(determinant));
const sidesM = [Math.hypot(ru, rv), Math.hypot(cu, cv)]; // of a pixel, along rows and columns
const finestM = Math.min(...sidesM);
const AXES = ["x", "y", "z"];

const toPlane = (column, row) => [u0 + column * cu + row * ru, v0 + column * cv + row * rv];
const toPixel = (u, v) => {
  const [du, dv] = [u - u0, v - v0];
  return [(rv * du - ru * dv) / determinant, (cu * dv - cv * du) / determinant];
};
const toSpace = (column, row) => AXES.map((_, axis) =>
  frame.origin[axis] + column * frame.column_step[axis] + row * frame.row_step[axis]);

// The two coordinates that tell positions on the plane apart best, and all that vary on it.
const minor = (a, b) => Math.abs(
  frame.column_step[a] * frame.row_step[b] - frame.column_step[b] * frame.row_step[a]);
const pair = [[0, 1], [0, 2], [1, 2]].reduce((best, each) =>
  minor(...each) > minor(...best) * 1.0001 ? each : best);
const shownAxes = [0, 1, 2].filter((axis) => pair.includes(axis)
  || Math.max(Math.abs(frame.column_step[axis]), Math.abs(frame.row_step[axis])) > 1e-9 * pixelM);
const fromPair = (first, second) => {
  const [a, b] = pair;
  const [da, db] = [first - frame.origin[a], second - frame.origin[b]];
  const [ca, cb] = [frame.column_step[a], frame.column_step[b]];
  const [ra, rb] = [frame.row_step[a], frame.row_step[b]];
  const d = ca * rb - ra * cb;
  return toPlane((rb * da - ra * db) / d, (ca * db - cb * da) / d);
};
// The coordinate along each side of the screen, if there is one that rises along it.
const alongSide = frame.axes.map((direction) => {
  const axis = [0, 1, 2].find((a) => Math.abs(direction[a]) > 1 - 1e-9);
  return axis === undefined ? null : { name: AXES[axis], sign: Math.sign(direction[axis]) };
});

const decimals = Math.max(0, Math.ceil(-Math.log10(finestM)) + 1);
const inMetres = (value) => value.toFixed(decimals).replace(/^-(0(\.0*)?)$/, "$1");

function chebyshev(at, count) {
  const terms = [1, at];
  while (terms.length < count) terms.push(2 * at * terms.at(-1) - terms.at(-2));
  return terms;
}

// Index as the argument of a series: from -1 to 1 between the first and last pixel.
const inUnits = (index, count) => (2 * index - (count - 1)) / Math.max(count - 1, 1);

// Latitude and longitude of a pixel, degrees.
function geographic(column, row) {
  const sum = (table) => {
    const rows = chebyshev(inUnits(row, ROWS), table.length);
    const columns = chebyshev(inUnits(column, COLUMNS), table[0].length);
    return table.reduce((all, line, i) =>
      all + line.reduce((part, factor, j) => part + factor * rows[i] * columns[j], 0), 0);
  };
  const longitude = sum(scene.geographic.longitude);
  return [sum(scene.geographic.latitude), ((((longitude + 180) % 360) + 360) % 360) - 180];
}

const inDegrees = (value, positive, negative) =>
  `${Math.abs(value).toFixed(7)}° ${value < 0 ? negative : positive}`;

const minus = (text) => text.replace("-", "−");
