// Layers of the map besides its cells. Each message makes a new one, but for ChangeLayer. Contexts draw in metres.

import { drawArrow, FONT, haloed, square, trace } from "./canvas.js";
import { pointsOf } from "./geometry.js";
import { OCCUPIED } from "./tiles.js";

const LINES = { borders: [1.5, [6, 4]], keyFrames: [1, []], refused: [1.5, [5, 4]], accepted: [2, []] }; // pixels, dash
const NODE_PIXELS = 3, VEHICLE_PIXELS = 22;
const FREE = 35; // per cent; from here down a cell counts as free
const APPEARED = 100, GONE = 0; // in the message of what is not as stored
const MIN_PIXELS = 2; // a changed cell can be seen from far away

/** The pose graph: key frames along the path, loops between them, borders of sub-maps. */
export class GraphLayer {
  constructor({ paths = [], borders = [], accepted = [], refused = [] } = {}) {
    const loops = (ends) => Array.from({ length: ends.length / 4 }, (_, i) => pointsOf(ends.slice(4 * i, 4 * i + 4)));
    this.lines = { borders: borders.map(pointsOf), keyFrames: paths.map(pointsOf), refused: loops(refused), accepted: loops(accepted) };
  }

  get counts() {
    const { borders, keyFrames, refused, accepted } = this.lines;
    return { keyFrames: keyFrames.flat().length, borders: borders.length, accepted: accepted.length, refused: refused.length };
  }

  draw(context, scale, colours) {
    for (const [kind, [pixels, dash]] of Object.entries(LINES)) {
      context.strokeStyle = colours[kind];
      context.lineWidth = pixels / scale;
      context.setLineDash(dash.map((part) => part / scale));
      context.beginPath();
      for (const line of this.lines[kind]) trace(context, line, kind === "borders");
      context.stroke();
    }
    context.setLineDash([]);
    context.fillStyle = colours.keyFrames;
    for (const point of this.lines.keyFrames.flat()) square(context, point, NODE_PIXELS / scale);
  }
}

/** The static score: for how long cells around the vehicle have been occupied, which separates moving from static objects. */
export class StandingLayer {
  /** cells: by rows, row 0 lowest; -1 nothing stands, else per cent of the time from which on it counts in full. */
  constructor({ cell_m = 1, column = 0, row = 0, width = 0, height = 0, cells = [] } = {}) {
    Object.assign(this, { cell_m, column, row, width, height, cells, isKnown: cells.length > 0 });
  }

  valueAt(x_m, y_m) {
    const x = Math.floor(x_m / this.cell_m) - this.column, y = Math.floor(y_m / this.cell_m) - this.row;
    return x >= 0 && y >= 0 && x < this.width && y < this.height ? this.cells[y * this.width + x] : -1;
  }

  draw(context, colours) {
    if (!this.isKnown) return;
    if (this.colours !== colours) this.#paint(colours);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.canvas, this.column * this.cell_m, this.row * this.cell_m, this.width * this.cell_m, this.height * this.cell_m);
  }

  #paint(colours) {
    const { fresh, full } = this.colours = colours;
    this.canvas = new OffscreenCanvas(this.width, this.height);
    const context = this.canvas.getContext("2d"), image = context.createImageData(this.width, this.height);
    this.cells.forEach((percent, i) => {
      if (percent < 0) return;
      for (let k = 0; k < 4; k += 1) image.data[4 * i + k] = fresh[k] + (percent / 100) * (full[k] - fresh[k]);
    });
    context.putImageData(image, 0, 0);
  }
}

/** Cells that are occupied and were free (appeared), or free and were occupied (gone). */
class ChangedCells {
  cell_m = 0;

  get counts() {
    return { appeared: this.corners("appeared").length / 2, gone: this.corners("gone").length / 2 };
  }

  draw(context, seen, scale, colours) {
    const size_m = Math.max(this.cell_m, MIN_PIXELS / scale), off_m = (this.cell_m - size_m) / 2;
    for (const kind of ["appeared", "gone"]) {
      const corners = this.corners(kind);
      context.fillStyle = colours[kind];
      for (let i = 0; i < corners.length; i += 2) {
        const x = corners[i] + off_m, y = corners[i + 1] + off_m;
        const isSeen = x < seen.x_max_m && x + size_m > seen.x_min_m && y < seen.y_max_m && y + size_m > seen.y_min_m;
        if (isSeen) context.fillRect(x, y, size_m, size_m);
      }
    }
  }
}

/** What changed since a moment that a person chose. */
export class ChangeLayer extends ChangedCells {
  since = new Date();
  changed = new Map(); // tile -> {appeared, gone}: each [x_m, y_m, ...], lower left corners of cells

  /** before: TileMap that is compared with, and not changed any more; null: none. */
  constructor(before = null) {
    super();
    this.before = before;
  }

  put({ ix, iy, cells }, edge, cell_m) {
    if (!this.before) return;
    this.cell_m = cell_m;
    const appeared = [], gone = [];
    cells.forEach((is, i) => {
      const x = ix * edge + (i % edge), y = iy * edge + Math.floor(i / edge), was = this.before.cell(x, y);
      if (was < 0 || is < 0) return;
      const side = was <= FREE && is >= OCCUPIED ? appeared : was >= OCCUPIED && is <= FREE ? gone : null;
      side?.push(x * cell_m, y * cell_m);
    });
    this.changed.set(`${ix},${iy}`, { appeared, gone });
  }

  corners(kind) {
    return [...this.changed.values()].flatMap((tile) => tile[kind]);
  }
}

/** What is not as the stored map says in which the vehicle is localised. */
export class StoredChangeLayer extends ChangedCells {
  /** isKnown: whether the vehicle is only localised in a stored map. cells: by rows, row 0 lowest; APPEARED, GONE, or -1 as stored. */
  constructor({ isKnown = false, cell_m = 1, column = 0, row = 0, width = 0, cells = [] } = {}) {
    super();
    const found = { appeared: [], gone: [] };
    cells.forEach((value, i) => {
      const side = value === APPEARED ? found.appeared : value === GONE ? found.gone : null;
      side?.push((column + (i % width)) * cell_m, (row + Math.floor(i / width)) * cell_m);
    });
    Object.assign(this, { isKnown, cell_m, found });
  }

  corners(kind) {
    return this.found[kind];
  }
}

/** The vehicles of a site, each with its name, and why it is not well; context draws in pixels. vehicles: [{name, x_m, y_m, theta_rad, is_well, state}] */
export const drawFleet = (context, camera, colours, vehicles) => {
  context.font = `13px ${FONT}`;
  context.textBaseline = "middle";
  for (const { name, x_m, y_m, theta_rad, is_well, state } of vehicles) {
    const [x, y] = camera.toScreen(x_m, y_m);
    context.save();
    context.translate(x, y);
    context.rotate(-theta_rad - camera.rotation_rad);
    context.lineWidth = 1.5;
    drawArrow(context, VEHICLE_PIXELS, is_well ? colours.vehicle : colours.stale, colours.paper);
    context.restore();
    context.strokeStyle = colours.paper;
    context.fillStyle = colours.text;
    haloed(context, is_well ? name : `${name}: ${state}`, x + VEHICLE_PIXELS, y);
  }
};
