// For how long things stand around the vehicle: the static score, by which moving objects are told from what stays.

export class StandingLayer {
  constructor() {
    this.clear();
  }

  clear() {
    this.put({ cell_m: 1, column: 0, row: 0, width: 0, height: 0, cells: new Int8Array(0) });
  }

  /** cells: by rows, row 0 lowest; -1 nothing stands, else per cent of the time from which on it counts in full. */
  put({ cell_m, column, row, width, height, cells }) {
    Object.assign(this, { cell_m, column, row, width, height, cells, canvas: null });
  }

  get isKnown() {
    return this.cells.length > 0;
  }

  /** Per cent at a map point; -1 where nothing stands. */
  valueAt(x_m, y_m) {
    const x = Math.floor(x_m / this.cell_m) - this.column, y = Math.floor(y_m / this.cell_m) - this.row;
    return x >= 0 && y >= 0 && x < this.width && y < this.height ? this.cells[y * this.width + x] : -1;
  }

  /** Again after the theme has changed. */
  repaint() {
    this.canvas = null;
  }

  /** context draws in metres. colours: {fresh, full} as [red, green, blue, alpha]. */
  draw(context, colours) {
    if (!this.isKnown) return;
    this.canvas ??= this.#painted(colours);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.canvas, this.column * this.cell_m, this.row * this.cell_m, this.width * this.cell_m, this.height * this.cell_m);
  }

  #painted({ fresh, full }) {
    const canvas = new OffscreenCanvas(this.width, this.height), context = canvas.getContext("2d");
    const image = context.createImageData(this.width, this.height);
    this.cells.forEach((percent, i) => {
      if (percent < 0) return;
      for (let k = 0; k < 4; k += 1) image.data[4 * i + k] = fresh[k] + (percent / 100) * (full[k] - fresh[k]);
    });
    context.putImageData(image, 0, 0);
    return canvas;
  }
}
