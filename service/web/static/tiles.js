// The map's cells in square blocks on several levels; a cell of level k covers 2^k x 2^k cells of level 0. A wall
// stays a wall on every level, so that it can be seen from far away.

const BLOCK = 256; // cells along a block
const LEVELS = 8;
const UNKNOWN = -1;
export const OCCUPIED = 65; // from here on a cell counts as a wall, as in ROS map_server

class Block {
  constructor(column, row) {
    this.column = column; // in blocks, of its level
    this.row = row;
    this.cells = new Int8Array(BLOCK * BLOCK).fill(UNKNOWN);
    this.canvas = null; // made when it is first seen
    this.isStale = true;
  }
}

const blockKey = (column, row) => column * 2097152 + row; // both far below 2^20 in size

/** Of four cells: the most occupied wall, else the mean of what is known. */
const reduced = (a, b, c, d) => {
  const most = Math.max(a, b, c, d);
  if (most >= OCCUPIED || most < 0) return most;
  const known = (a >= 0) + (b >= 0) + (c >= 0) + (d >= 0); // what is not known is -1
  return Math.round((a + b + c + d + 4 - known) / known);
};

export class TileMap {
  constructor() {
    this.clear();
    this.palette = new Uint32Array(256);
  }

  clear() {
    this.cell_m = 0;
    this.tileCount = 0;
    this.levels = Array.from({ length: LEVELS }, () => new Map());
    this.tiles = new Set();
  }

  /** The same cells once more; later ones change only one of the two. */
  copy() {
    const made = new TileMap();
    Object.assign(made, { cell_m: this.cell_m, edge: this.edge, tiles: new Set(this.tiles), palette: this.palette.slice() });
    made.levels = this.levels.map((level) => new Map([...level].map(([key, { column, row, cells }]) => {
      const block = new Block(column, row);
      block.cells.set(cells);
      return [key, block];
    })));
    return made;
  }

  /** colours: {unknown, free, occupied} as [red, green, blue, alpha], 0..255. */
  setColours({ unknown, free, occupied }) {
    const bytes = new Uint8ClampedArray(this.palette.buffer);
    bytes.set(unknown, 4 * 255); // -1
    for (let value = 0; value <= 100; value += 1) {
      const share = value / 100;
      for (let i = 0; i < 4; i += 1) bytes[4 * value + i] = free[i] + share * (occupied[i] - free[i]);
    }
    for (const level of this.levels) for (const block of level.values()) block.isStale = true;
  }

  /** A square tile at (ix, iy), counted in tiles. cells: Int8Array of edge x edge, row 0 lowest. */
  put(ix, iy, edge, cell_m, cells) {
    if (edge > BLOCK || BLOCK % edge !== 0) throw new Error(`a tile of ${edge} cells; expected a divisor of ${BLOCK}`);
    if (this.cell_m !== cell_m) {
      this.clear();
      this.cell_m = cell_m;
    }
    const x = ix * edge, y = iy * edge;
    const block = this.#block(0, Math.floor(x / BLOCK), Math.floor(y / BLOCK));
    const left = x - block.column * BLOCK, low = y - block.row * BLOCK;
    for (let row = 0; row < edge; row += 1) {
      block.cells.set(cells.subarray(row * edge, (row + 1) * edge), (low + row) * BLOCK + left);
    }
    block.isStale = true;
    const key = blockKey(ix, iy);
    if (cells.some((value) => value !== UNKNOWN)) this.tiles.add(`${ix},${iy}`);
    else this.tiles.delete(`${ix},${iy}`);
    this.edge = edge;
    this.#reduce(x, y, edge);
    return key;
  }

  /** Rectangle around all known tiles, map frame; null while there is none. */
  get bounds() {
    if (this.tiles.size === 0) return null;
    let x0 = Infinity, y0 = Infinity, x1 = -Infinity, y1 = -Infinity;
    for (const tile of this.tiles) {
      const [ix, iy] = tile.split(",").map(Number);
      x0 = Math.min(x0, ix);
      y0 = Math.min(y0, iy);
      x1 = Math.max(x1, ix + 1);
      y1 = Math.max(y1, iy + 1);
    }
    const edge_m = this.edge * this.cell_m;
    return { x_min_m: x0 * edge_m, y_min_m: y0 * edge_m, x_max_m: x1 * edge_m, y_max_m: y1 * edge_m };
  }

  /** callback(key, cells) of each known tile: "ix,iy" and a copy of its cells, row 0 lowest. */
  forEachTile(callback) {
    const { edge } = this;
    for (const tile of this.tiles) {
      const [x, y] = tile.split(",").map((index) => Number(index) * edge);
      const block = this.#block(0, Math.floor(x / BLOCK), Math.floor(y / BLOCK));
      const left = x - block.column * BLOCK, low = y - block.row * BLOCK;
      const cells = new Int8Array(edge * edge);
      for (let row = 0; row < edge; row += 1) {
        const from = (low + row) * BLOCK + left;
        cells.set(block.cells.subarray(from, from + edge), row * edge);
      }
      callback(tile, cells);
    }
  }

  /** Value of the cell at a map point: -1 unknown, 0..100 per cent occupied. */
  valueAt(x_m, y_m) {
    if (!this.cell_m) return UNKNOWN;
    const x = Math.floor(x_m / this.cell_m), y = Math.floor(y_m / this.cell_m);
    const block = this.levels[0].get(blockKey(Math.floor(x / BLOCK), Math.floor(y / BLOCK)));
    return block ? block.cells[(y - block.row * BLOCK) * BLOCK + (x - block.column * BLOCK)] : UNKNOWN;
  }

  /** Draw what the camera sees; context draws in metres. pixels: device pixels a metre. */
  draw(context, seen, pixels) {
    if (!this.cell_m) return 0;
    const level = Math.min(Math.max(0, Math.ceil(-Math.log2(pixels * this.cell_m))), LEVELS - 1);
    const cell_m = this.cell_m * 2 ** level, block_m = BLOCK * cell_m;
    context.imageSmoothingEnabled = false; // a cell is a pixel or more: a wall keeps its full darkness
    const overlap_m = 0.5 / pixels; // closes the seam between two blocks that are turned
    const first = [Math.floor(seen.x_min_m / block_m), Math.floor(seen.y_min_m / block_m)];
    const last = [Math.floor(seen.x_max_m / block_m), Math.floor(seen.y_max_m / block_m)];
    let drawn = 0;
    for (let row = first[1]; row <= last[1]; row += 1) {
      for (let column = first[0]; column <= last[0]; column += 1) {
        const block = this.levels[level].get(blockKey(column, row));
        if (!block) continue;
        if (block.isStale) this.#paint(block);
        const size_m = block_m + overlap_m;
        context.drawImage(block.canvas, column * block_m, row * block_m, size_m, size_m);
        drawn += 1;
      }
    }
    return drawn;
  }

  #block(level, column, row) {
    const key = blockKey(column, row);
    let block = this.levels[level].get(key);
    if (!block) {
      block = new Block(column, row);
      this.levels[level].set(key, block);
    }
    return block;
  }

  /** Carry a square of level 0 up; it never crosses a block: its edge divides BLOCK. */
  #reduce(x, y, edge) {
    for (let level = 1; level < LEVELS; level += 1) {
      const below = this.#block(level - 1, Math.floor(x / BLOCK), Math.floor(y / BLOCK));
      const fromX = x - below.column * BLOCK, fromY = y - below.row * BLOCK;
      const evenX = fromX - (fromX % 2), evenY = fromY - (fromY % 2);
      const size = Math.max(1, edge >> 1);
      const toX = Math.floor(x / 2), toY = Math.floor(y / 2);
      const block = this.#block(level, Math.floor(toX / BLOCK), Math.floor(toY / BLOCK));
      const left = toX - block.column * BLOCK, low = toY - block.row * BLOCK;
      const { cells } = below, made = block.cells;
      for (let row = 0; row < size; row += 1) {
        let at = (evenY + 2 * row) * BLOCK + evenX;
        for (let to = (low + row) * BLOCK + left, end = to + size; to < end; to += 1, at += 2) {
          made[to] = reduced(cells[at], cells[at + 1], cells[at + BLOCK], cells[at + BLOCK + 1]);
        }
      }
      block.isStale = true;
      x = toX;
      y = toY;
      edge = size;
    }
  }

  #paint(block) {
    block.canvas ??= new OffscreenCanvas(BLOCK, BLOCK);
    const context = block.canvas.getContext("2d");
    const image = context.createImageData(BLOCK, BLOCK);
    const pixels = new Uint32Array(image.data.buffer);
    for (let i = 0; i < pixels.length; i += 1) pixels[i] = this.palette[block.cells[i] & 255];
    context.putImageData(image, 0, 0);
    block.isStale = false;
  }
}
