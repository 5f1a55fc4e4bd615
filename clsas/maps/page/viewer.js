// Viewer of sonar images: pans and zooms tiles of 8-bit levels, and colours them here.
//
// A page opened from a disk may not fetch files, and may not read pictures that it has drawn. Tiles
// are therefore scripts that call clsasTile, and their levels are colours only once they are drawn.
"use strict";

(() => {
  const scene = window.clsasScene;
  const $ = (id) => document.getElementById(id);
  const trouble = (text) => {
    const box = document.createElement("div");
    box.id = "trouble";
    box.setAttribute("role", "alert");
    box.textContent = text;
    document.body.append(box);
  };
  if (!scene) return trouble("scene.js is missing: copy the whole folder, not only this page.");
  if (!window.DecompressionStream) return trouble("This browser is too old: any from 2023 on will do.");

  const [ROWS, COLUMNS] = scene.shape;
  const [COARSEST, FINEST] = scene.levels;
  const SIDE = scene.side;
  const BRIGHTEST = 255; // level of 0 dB; 0 where nothing was received
  const LOWEST_DB = -Math.floor((BRIGHTEST - 1) * scene.step_db);
  const AT_ONCE = 8; // scripts that are loaded at the same time
  const MOST_TILES = 300; // that are kept: 1.3 MB each
  const BLINK_MS = 700;
  const FIRST = { low: Math.max(-scene.range_db, LOWEST_DB), high: 0 };

  // Geometry -------------------------------------------------------------------------------------
  // The plane of the screen has metres to the right and up: u and v.

  const frame = scene.frame;
  const [u0, v0] = frame.screen_origin;
  const [cu, cv] = frame.screen_column_step;
  const [ru, rv] = frame.screen_row_step;
  const determinant = cu * rv - ru * cv;
  const pixelM = Math.sqrt(Math.abs(determinant));
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
    const [ca, cb, ra, rb] = [frame.column_step[a], frame.column_step[b], frame.row_step[a], frame.row_step[b]];
    const d = ca * rb - ra * cb;
    return toPlane((rb * da - ra * db) / d, (ca * db - cb * da) / d);
  };
  // The coordinate along each side of the screen, if there is one that rises along it.
  const alongSide = frame.axes.map((direction) => {
    const axis = [0, 1, 2].find((a) => Math.abs(direction[a]) > 1 - 1e-9);
    return axis === undefined ? null : { name: AXES[axis], sign: Math.sign(direction[axis]) };
  });

  const decimals = Math.max(0, Math.ceil(-Math.log10(pixelM)) + 1);
  const inMetres = (value) => value.toFixed(decimals).replace(/^-(0(\.0*)?)$/, "$1");

  function chebyshev(at, count) {
    const terms = [1, at];
    while (terms.length < count) terms.push(2 * at * terms.at(-1) - terms.at(-2));
    return terms;
  }

  // Latitude and longitude of a pixel, degrees.
  function geographic(column, row) {
    const sum = (table) => {
      const rows = chebyshev(ROWS > 1 ? (2 * row) / (ROWS - 1) - 1 : 0, table.length);
      const columns = chebyshev(COLUMNS > 1 ? (2 * column) / (COLUMNS - 1) - 1 : 0, table[0].length);
      return table.reduce((all, line, i) =>
        all + line.reduce((part, factor, j) => part + factor * rows[i] * columns[j], 0), 0);
    };
    const longitude = sum(scene.geographic.longitude);
    return [sum(scene.geographic.latitude), ((((longitude + 180) % 360) + 360) % 360) - 180];
  }

  const inDegrees = (value, positive, negative) =>
    `${Math.abs(value).toFixed(7)}° ${value < 0 ? negative : positive}`;

  // View -----------------------------------------------------------------------------------------

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

  const corners = [[-0.5, -0.5], [COLUMNS - 0.5, -0.5], [-0.5, ROWS - 0.5], [COLUMNS - 0.5, ROWS - 0.5]]
    .map((corner) => toPlane(...corner));
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
    const most = 64 / pixelM;
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

  // Tiles ----------------------------------------------------------------------------------------

  const tiles = new Map(); // by "image/level/column_row", oldest use first
  let wanted = [], loading = 0, palette = null, paletteVersion = 0;

  const levelShape = (level) => {
    const factor = 2 ** (FINEST - level);
    return [Math.ceil(ROWS / factor), Math.ceil(COLUMNS / factor)];
  };

  window.clsasTile = async (name, text) => {
    const tile = tiles.get(name);
    if (!tile) return;
    const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const unpacked = new Uint8Array(await new Response(stream).arrayBuffer());
    if (unpacked.length === tile.width * tile.height) tile.levels = unpacked;
    redraw();
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

  function loadWanted() {
    while (loading < AT_ONCE && wanted.length) {
      const { name, level, column, row } = wanted.shift();
      if (tiles.has(name)) continue;
      const [rows, columns] = levelShape(level);
      tiles.set(name, {
        width: Math.min(SIDE, columns - column * SIDE), height: Math.min(SIDE, rows - row * SIDE),
        levels: null, canvas: null, version: -1,
      });
      const script = document.createElement("script");
      const done = () => {
        script.remove();
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
      tile.canvas ??= Object.assign(document.createElement("canvas"), { width: tile.width, height: tile.height });
      const context = tile.canvas.getContext("2d");
      const colours = new Uint32Array(tile.levels.length);
      for (let i = 0; i < colours.length; i += 1) colours[i] = palette[tile.levels[i]];
      context.putImageData(new ImageData(new Uint8ClampedArray(colours.buffer), tile.width, tile.height), 0, 0);
      tile.version = paletteVersion;
    }
    return tile.canvas;
  }

  // The level whose pixels are just as fine as those of the screen.
  function levelInView() {
    const perPixel = pixelM * view.scale * size.ratio; // pixels of the screen per pixel of the image
    const coarser = Math.floor(Math.log2(1.25 / perPixel));
    return Math.min(Math.max(FINEST - coarser, COARSEST), FINEST);
  }

  // Columns and rows of a level that are in view: first, and one past the last.
  function windowInView(level) {
    const factor = 2 ** (FINEST - level);
    const [rows, columns] = levelShape(level);
    const seen = [[0, 0], [size.width, 0], [0, size.height], [size.width, size.height]]
      .map(([x, y]) => toPixel(...fromScreen(x, y)).map((at) => (at + 0.5) / factor));
    const clamp = (value, most) => Math.min(Math.max(value, 0), most);
    return [0, 1].map((axis) => {
      const most = axis ? rows : columns;
      const along = seen.map((each) => each[axis]);
      return [clamp(Math.floor(Math.min(...along)), most), clamp(Math.ceil(Math.max(...along)), most)];
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
    tileAt(image, COARSEST, 0, 0); // always at hand
    const factor = 2 ** (FINEST - level);
    const scale = view.scale * size.ratio;
    const [u, v] = toPlane(left * factor - 0.5, top * factor - 0.5);
    const [x, y] = toScreen(u, v);
    draw.save();
    draw.transform(
      cu * factor * scale, -cv * factor * scale, ru * factor * scale, -rv * factor * scale,
      x * size.ratio, y * size.ratio);
    draw.imageSmoothingEnabled = pixelM * factor * scale < 3;
    draw.imageSmoothingQuality = "medium";
    draw.drawImage(sheet, 0, 0, width, height, 0, 0, width, height);
    draw.restore();
  }

  // Until a tile is loaded, draw the part of a coarser one that covers it.
  function drawCoarser(paper, image, level, column, row, x, y) {
    for (let coarser = level - 1; coarser >= COARSEST; coarser -= 1) {
      const times = 2 ** (level - coarser);
      const [c, r] = [Math.floor(column / times), Math.floor(row / times)];
      const tile = tileAt(image, coarser, c, r, false);
      if (!tile) continue;
      const part = SIDE / times;
      const [sx, sy] = [(column % times) * part, (row % times) * part];
      const [w, h] = [Math.min(part, tile.width - sx), Math.min(part, tile.height - sy)];
      if (w > 0 && h > 0) paper.drawImage(painted(tile), sx, sy, w, h, x, y, w * times, h * times);
      return;
    }
  }

  // Level of a pixel in the finest loaded tile that has it, dB; null if it is unknown or nothing.
  function levelAt(image, column, row) {
    for (let level = levelInView(); level >= COARSEST; level -= 1) {
      const factor = 2 ** (FINEST - level);
      const [c, r] = [Math.floor(column / factor), Math.floor(row / factor)];
      const tile = tileAt(image, level, Math.floor(c / SIDE), Math.floor(r / SIDE), false);
      if (!tile) continue;
      const value = tile.levels[(r % SIDE) * tile.width + (c % SIDE)];
      return value ? (value - BRIGHTEST) * scene.step_db : null;
    }
    return null;
  }

  // Drawing --------------------------------------------------------------------------------------

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

  function recolour() {
    palette = colourTable();
    paletteVersion += 1;
    showLevels();
    changed();
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
    for (const [row, column, rows, columns, error, words] of scene.patches) {
      const points = [[column, row], [column + columns, row], [column + columns, row + rows], [column, row + rows]]
        .map(([c, r]) => toScreen(...toPlane(c - 0.5, r - 0.5)));
      const [left, right] = [Math.min(...points.map((p) => p[0])), Math.max(...points.map((p) => p[0]))];
      const [top, bottom] = [Math.min(...points.map((p) => p[1])), Math.max(...points.map((p) => p[1]))];
      if (right < 0 || bottom < 0 || left > size.width || top > size.height) continue;
      const colour = words ? "#ffb454" : "#4fd1ff";
      stroked(() => {
        points.forEach(([x, y], i) => (i ? draw.lineTo(x, y) : draw.moveTo(x, y)));
        draw.closePath();
      }, colour, 1);
      const text = patchText(error, words, false);
      const [x, y] = [left < 36 ? 42 : left + 6, Math.max(top, 30) + 5]; // beside numbers of the axis
      if (right - x > draw.measureText(text).width + 6 && bottom - y > 16) outlined(text, x, y, colour);
    }
  }

  function patchText(error, words, whole) {
    const start = error === null ? "" : `${whole ? "predicted error " : ""}${minus(error.toFixed(1))} dB`;
    return whole || !start ? [start, words].filter(Boolean).join(", ") : start;
  }

  const minus = (text) => text.replace("-", "−");

  function drawMeasure() {
    const points = [...state.points];
    const at = state.measuring && points.length === 1 ? pointed() : null;
    if (at) points.push(at);
    if (!points.length) return void ($("distance").textContent = state.measuring ? "Distance: first point" : "");
    const [a, b] = points.map((point) => toScreen(...point));
    stroked(() => {
      for (const [x, y] of b ? [a, b] : [a]) {
        draw.moveTo(x - 6, y); draw.lineTo(x + 6, y);
        draw.moveTo(x, y - 6); draw.lineTo(x, y + 6);
      }
      if (b) { draw.moveTo(...a); draw.lineTo(...b); }
    }, "#4fd1ff", 1.5);
    if (!b) return void ($("distance").textContent = "Distance: second point");
    const length = Math.hypot(points[1][0] - points[0][0], points[1][1] - points[0][1]);
    const ends = points.map((point) => toSpace(...toPixel(...point)));
    const parts = shownAxes.map((axis) => `Δ${AXES[axis]} ${minus(inMetres(ends[1][axis] - ends[0][axis]))}`);
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
  const ticked = (value, step) => minus(value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))));

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
        spots.push(side ? { side, y, text: ticked(k * step, step) } : { side, x, text: ticked(k * step, step) });
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
    const text = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m`
      : length >= 0.01 ? `${Math.round(length * 1000) / 10} cm` : `${Math.round(length * 1e5) / 100} mm`;
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
    show("cursor", inside
      ? shownAxes.map((axis) => `${AXES[axis]} ${minus(inMetres(position[axis]))} m`).join(", ") : "");
    const db = inside ? levelAt(imageAt(), c, r) : null;
    show("level", !inside ? "" : db === null ? "no data" : `${minus(db.toFixed(1))} dB`);
    let text = "";
    if (inside && scene.geographic) {
      const [latitude, longitude] = geographic(column, row);
      text = `${inDegrees(latitude, "N", "S")}, ${inDegrees(longitude, "E", "W")}`;
    }
    show("geographic", text);
    const patch = inside && state.patches && scene.patches.find(([top, left, rows, columns]) =>
      r >= top && c >= left && r < top + rows && c < left + columns);
    show("patch", patch ? patchText(patch[4], patch[5], true) : "");
  }

  function showNorth() {
    $("north").hidden = !scene.geographic;
    if (!scene.geographic) return;
    // North is across the direction in which only longitude changes.
    const [column, row] = [COLUMNS / 2, ROWS / 2];
    const here = geographic(column, row)[0];
    const step = Math.max(1, Math.min(COLUMNS, ROWS) / 100);
    const slopes = [geographic(column + step, row)[0] - here, geographic(column, row + step)[0] - here];
    // Gradient of the latitude in metres to the right and up.
    const east = (slopes[0] * rv - slopes[1] * cv) / determinant;
    const north = (slopes[1] * cu - slopes[0] * ru) / determinant;
    const degrees = (Math.atan2(east, north) * 180) / Math.PI;
    $("north").firstElementChild.style.transform = `rotate(${degrees}deg)`;
  }

  // Controls -------------------------------------------------------------------------------------

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
      if (levels.low < LOWEST_DB) Object.assign(levels, { low: LOWEST_DB, high: LOWEST_DB + LEAST_DB });
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
    const [low, high] = [percentile(0.005), percentile(0.9995)].map((at) => (at - BRIGHTEST) * scene.step_db);
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
    const numbers = text.replaceAll("−", "-").match(/[-+]?\d*\.?\d+(e[-+]?\d+)?/gi)?.map(Number) ?? [];
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
    const at = { u: view.u.toFixed(decimals), v: view.v.toFixed(decimals), scale: view.scale.toPrecision(5) };
    const parts = { ...at, low: levels.low, high: levels.high, colours: levels.colours };
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
      Object.assign(levels, { low: Math.max(number("low"), LOWEST_DB), high: Math.min(number("high"), 0) });
    }
    if (parts.get("colours") in scene.colours) levels.colours = parts.get("colours");
    if (number("scale") > 0 && Number.isFinite(number("u")) && Number.isFinite(number("v"))) {
      Object.assign(view, { u: number("u"), v: number("v"), scale: number("scale") });
      zoom(1); // within limits
    } else {
      fit();
    }
    const mode = parts.get("mode");
    setMode(["1", "swipe", "blink"].includes(mode) ? mode : "0");
  }

  // Events ---------------------------------------------------------------------------------------

  function resize() {
    const box = canvas.getBoundingClientRect();
    Object.assign(size, { width: box.width || 1, height: box.height || 1, ratio: window.devicePixelRatio || 1 });
    canvas.width = Math.round(size.width * size.ratio);
    canvas.height = Math.round(size.height * size.ratio);
    document.documentElement.style.setProperty("--footer", `${document.querySelector("footer").offsetHeight}px`);
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

  $("divider").addEventListener("pointerdown", (event) => $("divider").setPointerCapture(event.pointerId));
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

  for (const end of ["low", "high"]) $(end).addEventListener("input", () => setLevel(end, Number($(end).value)));
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
  document.querySelectorAll("[data-mode]").forEach((button) => { button.onclick = () => setMode(button.dataset.mode); });

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
    1: () => setMode("0"), 2: () => setMode("1"), s: () => setMode("swipe"), b: () => setMode("blink"),
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

  // Start ----------------------------------------------------------------------------------------

  document.title = `${scene.names.join(" / ")} – clsas`;
  $("patches").hidden = !scene.patches.length;
  $("compare").hidden = scene.names.length < 2;
  scene.names.forEach((name, index) => { document.querySelector(`[data-mode="${index}"]`).title = `${name} (${index + 1})`; });
  $("place").placeholder = pair.map((axis) => AXES[axis]).join(", ");
  showPanel(window.innerWidth > 640);
  resize();
  readAddress();
  recolour();
  new ResizeObserver(resize).observe(canvas);
  new ResizeObserver(resize).observe(document.querySelector("footer"));
  window.addEventListener("hashchange", () => { readAddress(); recolour(); });
})();
