// The map's cells in square blocks on several levels; a cell of level k covers 2^k x 2^k cells of level 0. A wall
// stays a wall on every level, so that it can be seen from far away.

const BLOCK = 256; // cells along a block
const LEVELS = 8;
const UNKNOWN = -1;
export const OCCUPIED = 65; // from here on a cell counts as a wall, as in ROS map_server

class Block {
  canvas = null; // made when it is first seen
  palette = null; // by which it was painted; null: not as it is now

  constructor(cells = new Int8Array(BLOCK * BLOCK).fill(UNKNOWN)) {
    this.cells = cells;
  }

  paint(palette) {
    this.canvas ??= new OffscreenCanvas(BLOCK, BLOCK);
    const context = this.canvas.getContext("2d"), image = context.createImageData(BLOCK, BLOCK);
    const pixels = new Uint32Array(image.data.buffer);
    for (let i = 0; i < pixels.length; i += 1) pixels[i] = palette[this.cells[i] & 255];
    context.putImageData(image, 0, 0);
    this.palette = palette;
  }
}

const blockKey = (column, row) => column * 2097152 + row; // both far below 2^20 in size

const within = (x, y) => (y & (BLOCK - 1)) * BLOCK + (x & (BLOCK - 1));

/** Of four cells: the most occupied wall, else the mean of what is known. */
const reduced = (a, b, c, d) => {
  const most = Math.max(a, b, c, d);
  if (most >= OCCUPIED || most < 0) return most;
  const known = (a >= 0) + (b >= 0) + (c >= 0) + (d >= 0); // what is not known is -1
  return Math.round((a + b + c + d + 4 - known) / known);
};

export const paletteOf = (free, occupied) => {
  const palette = new Uint32Array(256), bytes = new Uint8ClampedArray(palette.buffer); // unknown: transparent
  for (let value = 0; value <= 100; value += 1) {
    for (let i = 0; i < 4; i += 1) bytes[4 * value + i] = free[i] + (value / 100) * (occupied[i] - free[i]);
  }
  return palette;
};

export class TileMap {
  constructor() {
    this.clear();
  }

  clear() {
    this.cell_m = 0;
    this.levels = Array.from({ length: LEVELS }, () => new Map());
    this.tiles = new Set(); // "ix,iy" of those that are known
  }

  /** The same cells once more; later ones change only one of the two. */
  copy() {
    const made = new TileMap();
    const levels = this.levels.map((level) => new Map([...level].map(([key, { cells }]) => [key, new Block(cells.slice())])));
    return Object.assign(made, { cell_m: this.cell_m, edge: this.edge, tiles: new Set(this.tiles), levels });
  }

  /** A square tile at (ix, iy), counted in tiles. cells: Int8Array of edge x edge, row 0 lowest. */
  put({ ix, iy, cells }, edge, cell_m) {
    if (edge > BLOCK || BLOCK % edge !== 0) throw new Error(`a tile of ${edge} cells; expected a divisor of ${BLOCK}`);
    if (this.cell_m !== cell_m) {
      this.clear();
      this.cell_m = cell_m;
    }
    this.edge = edge;
    const x = ix * edge, y = iy * edge, block = this.#block(0, x, y);
    for (let row = 0; row < edge; row += 1) block.cells.set(cells.subarray(row * edge, (row + 1) * edge), within(x, y + row));
    if (cells.some((value) => value !== UNKNOWN)) this.tiles.add(`${ix},${iy}`);
    else this.tiles.delete(`${ix},${iy}`);
    this.#reduce(x, y, edge);
  }

  get bounds() {
    if (this.tiles.size === 0) return null;
    let x0 = Infinity, y0 = Infinity, x1 = -Infinity, y1 = -Infinity;
    for (const tile of this.tiles) {
      const [ix, iy] = tile.split(",").map(Number);
      [x0, y0, x1, y1] = [Math.min(x0, ix), Math.min(y0, iy), Math.max(x1, ix + 1), Math.max(y1, iy + 1)];
    }
    const edge_m = this.edge * this.cell_m;
    return { x_min_m: x0 * edge_m, y_min_m: y0 * edge_m, x_max_m: x1 * edge_m, y_max_m: y1 * edge_m };
  }

  /** Value of a cell, counted from the origin: -1 unknown, 0..100 per cent occupied. */
  cell(x, y) {
    const block = this.levels[0].get(blockKey(Math.floor(x / BLOCK), Math.floor(y / BLOCK)));
    return block ? block.cells[within(x, y)] : UNKNOWN;
  }

  valueAt(x_m, y_m) {
    return this.cell_m ? this.cell(Math.floor(x_m / this.cell_m), Math.floor(y_m / this.cell_m)) : UNKNOWN;
  }

  /** Draw what the camera sees; context draws in metres. pixels: device pixels a metre. */
  draw(context, seen, pixels, palette) {
    if (!this.cell_m) return;
    const level = Math.min(Math.max(0, Math.ceil(-Math.log2(pixels * this.cell_m))), LEVELS - 1);
    const block_m = BLOCK * this.cell_m * 2 ** level;
    const size_m = block_m + 0.5 / pixels; // closes the seam between two blocks that are turned
    context.imageSmoothingEnabled = false; // a cell is a pixel or more: a wall keeps its full darkness
    for (let row = Math.floor(seen.y_min_m / block_m); row <= Math.floor(seen.y_max_m / block_m); row += 1) {
      for (let column = Math.floor(seen.x_min_m / block_m); column <= Math.floor(seen.x_max_m / block_m); column += 1) {
        const block = this.levels[level].get(blockKey(column, row));
        if (!block) continue;
        if (block.palette !== palette) block.paint(palette);
        context.drawImage(block.canvas, column * block_m, row * block_m, size_m, size_m);
      }
    }
  }

  #block(level, x, y) {
    const key = blockKey(Math.floor(x / BLOCK), Math.floor(y / BLOCK)), block = this.levels[level].get(key) ?? new Block();
    block.palette = null;
    this.levels[level].set(key, block);
    return block;
  }

  /** Carry a square of level 0 up; it never crosses a block: its edge divides BLOCK. */
  #reduce(x, y, edge) {
    let { cells } = this.#block(0, x, y);
    for (let level = 1; level < LEVELS; level += 1) {
      const from = within(x & ~1, y & ~1);
      [x, y, edge] = [x >> 1, y >> 1, Math.max(1, edge >> 1)];
      const block = this.#block(level, x, y);
      for (let row = 0; row < edge; row += 1) {
        let at = from + 2 * row * BLOCK;
        for (let to = within(x, y + row), end = to + edge; to < end; to += 1, at += 2) {
          block.cells[to] = reduced(cells[at], cells[at + 1], cells[at + BLOCK], cells[at + BLOCK + 1]);
        }
      }
      cells = block.cells;
    }
  }
}
