// What is not as the stored map says in which the vehicle is localised.

import { drawCells } from "./change_layer.js";

const NEW = 100, GONE = 0;

export class StoredChangeLayer {
  constructor() {
    this.clear();
  }

  clear() {
    this.put({ isKnown: false, cell_m: 1, column: 0, row: 0, width: 0, cells: new Int8Array(0) });
  }

  /** isKnown: whether somebody watches. cells: by rows, row 0 lowest; NEW, GONE, or -1 as stored. */
  put({ isKnown, cell_m, column, row, width, cells }) {
    const corners = (kind) => {
      const found = [];
      cells.forEach((value, i) => {
        if (value === kind) found.push((column + (i % width)) * cell_m, (row + Math.floor(i / width)) * cell_m);
      });
      return found;
    };
    Object.assign(this, { isKnown, cell_m, appeared: corners(NEW), gone: corners(GONE) });
  }

  /** Cells of each kind. */
  get counts() {
    return { appeared: this.appeared.length / 2, gone: this.gone.length / 2 };
  }

  draw(context, seen, scale, colours) {
    for (const kind of ["appeared", "gone"]) drawCells(context, this[kind], this.cell_m, seen, scale, colours[kind]);
  }
}
