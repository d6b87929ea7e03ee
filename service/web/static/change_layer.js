// What stands where it was free, and what is free where something stood, since a moment that a person chose.

import { OCCUPIED } from "./tiles.js";

const FREE = 35; // per cent; from here down a cell counts as free
const MIN_PIXELS = 2; // a changed cell can be seen from far away

export class ChangeLayer {
  constructor() {
    this.clear();
  }

  clear() {
    this.before = new Map(); // tile -> cells as they were
    this.changed = new Map(); // tile -> {appeared, gone}: each [x_m, y_m, ...], lower left corners of cells
    this.since = null; // Date; null: nothing is compared
    this.cell_m = 0;
  }

  /** Compare with the map as it is now. tiles: TileMap. */
  start(tiles) {
    this.clear();
    this.since = new Date();
    tiles.forEachTile((key, cells) => this.before.set(key, cells.slice()));
  }

  put(ix, iy, edge, cell_m, cells) {
    if (!this.since) return;
    this.cell_m = cell_m;
    const key = `${ix},${iy}`, before = this.before.get(key);
    if (!before) return; // was not known then
    const appeared = [], gone = [];
    for (let i = 0; i < cells.length; i += 1) {
      const was = before[i], is = cells[i];
      if (was < 0 || is < 0) continue;
      const side = was <= FREE && is >= OCCUPIED ? appeared : was >= OCCUPIED && is <= FREE ? gone : null;
      side?.push((ix * edge + (i % edge)) * cell_m, (iy * edge + Math.floor(i / edge)) * cell_m);
    }
    if (appeared.length || gone.length) this.changed.set(key, { appeared, gone });
    else this.changed.delete(key);
  }

  /** Cells of each kind. */
  get counts() {
    const count = (kind) => [...this.changed.values()].reduce((sum, tile) => sum + tile[kind].length / 2, 0);
    return { appeared: count("appeared"), gone: count("gone") };
  }

  draw(context, seen, scale, colours) {
    for (const kind of ["appeared", "gone"]) {
      for (const tile of this.changed.values()) drawCells(context, tile[kind], this.cell_m, seen, scale, colours[kind]);
    }
  }
}

/** corners: [x_m, y_m, ...], lower left ones of cells; none smaller than can be seen. */
export const drawCells = (context, corners, cell_m, seen, scale, colour) => {
  const size_m = Math.max(cell_m, MIN_PIXELS / scale), off_m = (cell_m - size_m) / 2;
  context.fillStyle = colour;
  for (let i = 0; i < corners.length; i += 2) {
    const x = corners[i] + off_m, y = corners[i + 1] + off_m;
    const isSeen = x < seen.x_max_m && x + size_m > seen.x_min_m && y < seen.y_max_m && y + size_m > seen.y_min_m;
    if (isSeen) context.fillRect(x, y, size_m, size_m);
  }
};
