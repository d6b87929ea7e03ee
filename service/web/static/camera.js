// Which part of the map is on the screen. Map: metres, y up. Screen: CSS pixels, y down.

const SMALLEST_SCALE = 0.2, LARGEST_SCALE = 4000; // pixels a metre; 4000: a cell of 5 cm is 200 wide

export class Camera {
  constructor() {
    this.x_m = 0; // map point in the middle of the screen
    this.y_m = 0;
    this.scale = 40; // pixels a metre
    this.rotation_rad = 0; // of the map on the screen, counter-clockwise
    this.width = 1;
    this.height = 1;
  }

  /** Make a canvas the screen, as large as its place and sharp; device pixels a CSS pixel. */
  sizeTo(canvas) {
    const dpr = window.devicePixelRatio || 1;
    this.width = Math.max(1, canvas.clientWidth);
    this.height = Math.max(1, canvas.clientHeight);
    canvas.width = Math.round(this.width * dpr);
    canvas.height = Math.round(this.height * dpr);
    return dpr;
  }

  /** Fill the screen, and draw in metres from now on. */
  clear(context, ground, dpr) {
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = ground;
    context.fillRect(0, 0, context.canvas.width, context.canvas.height);
    this.applyTo(context, dpr);
  }

  toScreen(x_m, y_m) {
    const c = Math.cos(this.rotation_rad), s = Math.sin(this.rotation_rad);
    const dx = x_m - this.x_m, dy = y_m - this.y_m;
    return [this.width / 2 + this.scale * (c * dx - s * dy), this.height / 2 - this.scale * (s * dx + c * dy)];
  }

  toMap(sx, sy) {
    const c = Math.cos(this.rotation_rad), s = Math.sin(this.rotation_rad);
    const u = (sx - this.width / 2) / this.scale, v = (this.height / 2 - sy) / this.scale;
    return [this.x_m + c * u + s * v, this.y_m - s * u + c * v];
  }

  /** Draw in metres from now on. dpr: device pixels a CSS pixel. */
  applyTo(context, dpr) {
    const c = Math.cos(this.rotation_rad) * this.scale * dpr, s = Math.sin(this.rotation_rad) * this.scale * dpr;
    const e = (this.width / 2) * dpr - c * this.x_m + s * this.y_m;
    const f = (this.height / 2) * dpr + s * this.x_m + c * this.y_m;
    context.setTransform(c, -s, -s, -c, e, f);
  }

  /** What it looks at, to be compared. */
  get place() {
    return [this.x_m, this.y_m, this.scale, this.rotation_rad].join();
  }

  panBy(dx, dy) {
    const [x_m, y_m] = this.toMap(this.width / 2 - dx, this.height / 2 - dy);
    this.x_m = x_m;
    this.y_m = y_m;
  }

  /** Zoom and turn about a point of the screen, which stays where it is. */
  zoomAt(sx, sy, factor, turn_rad = 0) {
    const [x_m, y_m] = this.toMap(sx, sy);
    this.scale = Math.min(Math.max(this.scale * factor, SMALLEST_SCALE), LARGEST_SCALE);
    this.rotation_rad += turn_rad;
    const [nx, ny] = this.toScreen(x_m, y_m);
    this.panBy(sx - nx, sy - ny);
  }

  centreOn(x_m, y_m) {
    this.x_m = x_m;
    this.y_m = y_m;
  }

  /** Show a rectangle of the map, with a margin, in the turn that is set. */
  fit({ x_min_m, y_min_m, x_max_m, y_max_m }) {
    this.centreOn((x_min_m + x_max_m) / 2, (y_min_m + y_max_m) / 2);
    const c = Math.abs(Math.cos(this.rotation_rad)), s = Math.abs(Math.sin(this.rotation_rad));
    const w = x_max_m - x_min_m, h = y_max_m - y_min_m;
    const fits = Math.min(this.width / (c * w + s * h), this.height / (s * w + c * h));
    this.scale = Math.min(Math.max(0.9 * fits, SMALLEST_SCALE), LARGEST_SCALE);
  }

  /** Smallest rectangle of the map, along its axes, that holds the screen. */
  get seen() {
    const corners = [[0, 0], [this.width, 0], [0, this.height], [this.width, this.height]];
    const points = corners.map(([sx, sy]) => this.toMap(sx, sy));
    const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
    return { x_min_m: Math.min(...xs), y_min_m: Math.min(...ys), x_max_m: Math.max(...xs), y_max_m: Math.max(...ys) };
  }
}
