// Tiles: loaded, coloured, and put together for the part in view.
//
// A page on a disk may not fetch files, and may not look into pictures that it has drawn. Tiles are
// therefore scripts that call clsasTile, and their levels become colours only when they are drawn.
"use strict";

const AT_ONCE = 8; // scripts that are loaded at the same time
const MOST_TILES = 300; // that are kept: 1.3 MB each

const tiles = new Map(); // by "image/level/column_row", oldest use first
const missing = new Set(); // names of tiles that could not be loaded
let wanted = [], loading = 0, palette = null, paletteVersion = 0;

const levelShape = (level) => {
  const [down, across] = factorsOf(level);
  return [Math.ceil(ROWS / down), Math.ceil(COLUMNS / across)];
};

window.clsasTile = async (name, text) => {
  const tile = tiles.get(name);
  if (!tile) return;
  tile.received = true;
  loading += 1; // until it is unpacked
  try {
    const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const unpacked = new Uint8Array(await new Response(stream).arrayBuffer());
    if (unpacked.length === tile.width * tile.height) tile.levels = unpacked;
  } catch {
    // A damaged tile is a missing one.
  } finally {
    if (!tile.levels) missing.add(name);
    loading -= 1;
    redraw();
  }
};

// Return a tile that is loaded, or undefined after putting it on the list.
function tileAt(image, level, column, row, load = true) {
  const name = `${image}/${level}/${column}_${row}`;
  const tile = tiles.get(name);
  if (tile?.levels) {
    tiles.delete(name);
    tiles.set(name, tile);
    return tile;
  }
  if (!tile && load) wanted.push({ name, level, column, row });
  return undefined;
}

// Load what the last drawing lacked, a few scripts at a time.
function loadWanted() {
  while (loading < AT_ONCE && wanted.length) {
    const { name, level, column, row } = wanted.shift();
    if (tiles.has(name)) continue;
    const [rows, columns] = levelShape(level);
    tiles.set(name, {
      width: Math.min(SIDE, columns - column * SIDE), height: Math.min(SIDE, rows - row * SIDE),
      levels: null, canvas: null, version: -1, received: false,
    });
    const script = document.createElement("script");
    const done = () => {
      script.remove();
      if (!tiles.get(name)?.received) missing.add(name);
      loading -= 1;
      redraw();
    };
    script.onload = done;
    script.onerror = done;
    script.src = `tiles/${name}.js`;
    loading += 1;
    document.head.append(script);
  }
}

// Drop tiles that have not been in view for the longest time.
function forget() {
  for (const [name, tile] of tiles) {
    if (tiles.size <= MOST_TILES) break;
    if (tile.levels) tiles.delete(name);
  }
}

// Colours of all levels, as numbers that an image buffer stores as red, green, blue, opacity.
function colourTable() {
  const bytes = scene.colours[levels.colours];
  const table = new Uint8ClampedArray(4 * 256);
  for (let level = 1; level < 256; level += 1) {
    const db = (level - BRIGHTEST) * scene.step_db;
    const share = (db - levels.low) / (levels.high - levels.low);
    const index = Math.round(255 * Math.min(Math.max(share, 0), 1));
    for (let part = 0; part < 3; part += 1) {
      table[4 * level + part] = parseInt(bytes.substr(6 * index + 2 * part, 2), 16);
    }
    table[4 * level + 3] = 255;
  }
  return new Uint32Array(table.buffer);
}

function painted(tile) {
  if (tile.version !== paletteVersion) {
    const { width, height } = tile;
    tile.canvas ??= Object.assign(document.createElement("canvas"), { width, height });
    const context = tile.canvas.getContext("2d");
    const colours = new Uint32Array(tile.levels.length);
    for (let i = 0; i < colours.length; i += 1) colours[i] = palette[tile.levels[i]];
    const bytes = new Uint8ClampedArray(colours.buffer);
    context.putImageData(new ImageData(bytes, width, height), 0, 0);
    tile.version = paletteVersion;
  }
  return tile.canvas;
}

// The coarsest level whose pixels are as fine as those of the screen, along the sides that it reduces.
function levelInView() {
  const onScreen = view.scale * size.ratio; // pixels per metre
  const isFine = (factor, axis) => factor === 1 || factor * sidesM[axis] * onScreen <= 1.25;
  let level = COARSEST;
  while (level < FINEST && !factorsOf(level).every(isFine)) level += 1;
  return level;
}

// Columns and rows of a level that are in view: first, and one past the last.
function windowInView(level) {
  const [down, across] = factorsOf(level);
  const [rows, columns] = levelShape(level);
  const seen = [[0, 0], [size.width, 0], [0, size.height], [size.width, size.height]]
    .map(([x, y]) => toPixel(...fromScreen(x, y)))
    .map(([column, row]) => [(column + 0.5) / across, (row + 0.5) / down]);
  const clamp = (value, most) => Math.min(Math.max(value, 0), most);
  return [0, 1].map((axis) => {
    const most = axis ? rows : columns;
    const along = seen.map((each) => each[axis]);
    return [Math.floor(Math.min(...along)), Math.ceil(Math.max(...along))].map(
      (value) => clamp(value, most));
  });
}

const sheet = document.createElement("canvas");

// Put the tiles in view together on a sheet, where they meet exactly, and draw it at once.
function drawImage(image) {
  const level = levelInView();
  const [[left, right], [top, bottom]] = windowInView(level);
  const width = right - left, height = bottom - top;
  if (width <= 0 || height <= 0) return;
  if (sheet.width < width || sheet.height < height) {
    sheet.width = Math.max(sheet.width, width);
    sheet.height = Math.max(sheet.height, height);
  }
  const paper = sheet.getContext("2d");
  paper.clearRect(0, 0, width, height);
  tileAt(image, COARSEST, 0, 0); // the first to be loaded, and shown until others are
  const list = [];
  for (let row = Math.floor(top / SIDE); row * SIDE < bottom; row += 1) {
    for (let column = Math.floor(left / SIDE); column * SIDE < right; column += 1) {
      list.push([column, row]);
    }
  }
  const middle = [(left + right) / 2 / SIDE - 0.5, (top + bottom) / 2 / SIDE - 0.5];
  const away = ([column, row]) => Math.hypot(column - middle[0], row - middle[1]);
  list.sort((one, other) => away(one) - away(other));
  for (const [column, row] of list) {
    const [x, y] = [column * SIDE - left, row * SIDE - top];
    const tile = tileAt(image, level, column, row);
    if (tile) paper.drawImage(painted(tile), x, y);
    else drawCoarser(paper, image, level, column, row, x, y);
  }
  const [down, across] = factorsOf(level);
  const scale = view.scale * size.ratio;
  const [u, v] = toPlane(left * across - 0.5, top * down - 0.5);
  const [x, y] = toScreen(u, v);
  draw.save();
  draw.transform(
    cu * across * scale, -cv * across * scale, ru * down * scale, -rv * down * scale,
    x * size.ratio, y * size.ratio);
  draw.imageSmoothingEnabled = Math.min(sidesM[0] * down, sidesM[1] * across) * scale < 3;
  draw.imageSmoothingQuality = "medium";
  draw.drawImage(sheet, 0, 0, width, height, 0, 0, width, height);
  draw.restore();
}

// Until a tile is loaded, draw the part of a coarser one that covers it.
function drawCoarser(paper, image, level, column, row, x, y) {
  for (let coarser = level - 1; coarser >= COARSEST; coarser -= 1) {
    const [timesDown, timesAcross] = factorsOf(coarser).map(
      (factor, axis) => factor / factorsOf(level)[axis]);
    const [c, r] = [Math.floor(column / timesAcross), Math.floor(row / timesDown)];
    const tile = tileAt(image, coarser, c, r, false);
    if (!tile) continue;
    const [width, height] = [SIDE / timesAcross, SIDE / timesDown];
    const [sx, sy] = [(column % timesAcross) * width, (row % timesDown) * height];
    const [w, h] = [Math.min(width, tile.width - sx), Math.min(height, tile.height - sy)];
    if (w > 0 && h > 0) {
      paper.drawImage(painted(tile), sx, sy, w, h, x, y, w * timesAcross, h * timesDown);
    }
    return;
  }
}

// Level of a pixel in the finest loaded tile that has it, dB; null if nothing was received there,
// and undefined if no tile is loaded.
function levelAt(image, column, row) {
  for (let level = levelInView(); level >= COARSEST; level -= 1) {
    const [down, across] = factorsOf(level);
    const [c, r] = [Math.floor(column / across), Math.floor(row / down)];
    const tile = tileAt(image, level, Math.floor(c / SIDE), Math.floor(r / SIDE), false);
    if (!tile) continue;
    const value = tile.levels[(r % SIDE) * tile.width + (c % SIDE)];
    return value ? (value - BRIGHTEST) * scene.step_db : null;
  }
  return undefined;
}

// Whether the tile of a pixel, in the level that is drawn, could not be loaded.
function isMissing(image, column, row) {
  const level = levelInView();
  const [down, across] = factorsOf(level);
  const [c, r] = [Math.floor(column / across / SIDE), Math.floor(row / down / SIDE)];
  return missing.has(`${image}/${level}/${c}_${r}`);
}
