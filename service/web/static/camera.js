// Which part of the map is on the screen, and the canvas that shows it. Map: metres, y up. Screen: CSS pixels, y down.

const SMALLEST_SCALE = 0.2, LARGEST_SCALE = 4000; // pixels a metre; 4000: a cell of 5 cm is 200 wide

class Camera {
  x_m = 0; // map point in the middle of the screen
  y_m = 0;
  scale = 40; // pixels a metre
  rotation_rad = 0; // of the map on the screen, counter-clockwise
  width = 1;
  height = 1;

  clear(context, ground, dpr) {
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = ground;
    context.fillRect(0, 0, context.canvas.width, context.canvas.height);
    const [c, s] = this.#turn.map((share) => share * this.scale * dpr);
    const e = (this.width / 2) * dpr - c * this.x_m + s * this.y_m;
    const f = (this.height / 2) * dpr + s * this.x_m + c * this.y_m;
    context.setTransform(c, -s, -s, -c, e, f);
  }

  toScreen(x_m, y_m) {
    const [c, s] = this.#turn, dx = x_m - this.x_m, dy = y_m - this.y_m;
    return [this.width / 2 + this.scale * (c * dx - s * dy), this.height / 2 - this.scale * (s * dx + c * dy)];
  }

  toMap(sx, sy) {
    const [c, s] = this.#turn, u = (sx - this.width / 2) / this.scale, v = (this.height / 2 - sy) / this.scale;
    return [this.x_m + c * u + s * v, this.y_m - s * u + c * v];
  }

  get #turn() {
    return [Math.cos(this.rotation_rad), Math.sin(this.rotation_rad)];
  }

  get middle() {
    return [this.width / 2, this.height / 2];
  }

  get place() {
    return [this.x_m, this.y_m, this.scale, this.rotation_rad].join();
  }

  panBy(dx, dy) {
    this.centreOn(...this.toMap(this.width / 2 - dx, this.height / 2 - dy));
  }

  /** Zoom and turn about a point of the screen, which stays where it is. */
  zoomAt([sx, sy], factor, turn_rad = 0) {
    const point = this.toMap(sx, sy);
    this.#setScale(this.scale * factor);
    this.rotation_rad += turn_rad;
    const [nx, ny] = this.toScreen(...point);
    this.panBy(sx - nx, sy - ny);
  }

  centreOn(x_m, y_m) {
    this.x_m = x_m;
    this.y_m = y_m;
  }

  #setScale(scale) {
    this.scale = Math.min(Math.max(scale, SMALLEST_SCALE), LARGEST_SCALE);
  }

  /** Show a rectangle of the map, with a margin, in the turn that is set. */
  fit({ x_min_m, y_min_m, x_max_m, y_max_m }) {
    this.centreOn((x_min_m + x_max_m) / 2, (y_min_m + y_max_m) / 2);
    const [c, s] = this.#turn.map(Math.abs), w = x_max_m - x_min_m, h = y_max_m - y_min_m;
    this.#setScale(0.9 * Math.min(this.width / (c * w + s * h), this.height / (s * w + c * h)));
  }

  /** Smallest rectangle of the map, along its axes, that holds the screen. */
  get seen() {
    const corners = [[0, 0], [this.width, 0], [0, this.height], [this.width, this.height]];
    const points = corners.map(([sx, sy]) => this.toMap(sx, sy));
    const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
    return { x_min_m: Math.min(...xs), y_min_m: Math.min(...ys), x_max_m: Math.max(...xs), y_max_m: Math.max(...ys) };
  }
}

export class MapCanvas {
  needsPicture = false;
  frames = 0;
  follows = false; // the vehicle
  dpr = 1; // device pixels a CSS pixel

  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.camera = new Camera();
    new ResizeObserver(() => this.#resize()).observe(canvas);
  }

  get isOpen() {
    return !this.canvas.hidden;
  }

  invalidate() {
    if (this.needsPicture || !this.isOpen) return;
    this.needsPicture = true;
    requestAnimationFrame(() => {
      this.needsPicture = false;
      if (this.isOpen) this.#draw();
    });
  }

  follow(isOn) {
    this.follows = isOn;
    this.invalidate();
  }

  /** Bring a place into the middle, and keep it there. Pose: [x_m, y_m, theta_rad], map frame. */
  show([x_m, y_m]) {
    this.camera.centreOn(x_m, y_m);
    this.follow(false);
  }

  #resize() {
    if (!this.isOpen) return;
    const { canvas } = this, [width, height] = [Math.max(1, canvas.clientWidth), Math.max(1, canvas.clientHeight)];
    this.dpr = window.devicePixelRatio || 1;
    Object.assign(this.camera, { width, height });
    [canvas.width, canvas.height] = [Math.round(width * this.dpr), Math.round(height * this.dpr)];
    this.#draw(); // at once: an emptied canvas would flash
  }

  #draw() {
    this.paint();
    this.frames += 1;
  }
}
