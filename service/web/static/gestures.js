// Mouse, fingers and keys on the map. A tool that is at work takes the clicks and drags instead.

const PAN_PIXELS = 60, ZOOM_STEP = 1.25, TURN_STEP_RAD = Math.PI / 12;
const CLICK_PIXELS = 5; // a press that moved less is a click

export class Gestures {
  /** tool(): what is at work, null where nothing is: {down, move, up}(point, event), points in CSS pixels. */
  constructor(canvas, view, tool, changed) {
    this.canvas = canvas;
    this.view = view;
    this.tool = tool;
    this.changed = changed; // called when the view was moved by hand
    this.pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    canvas.addEventListener("pointerup", (event) => this.#up(event));
    canvas.addEventListener("pointercancel", (event) => this.#up(event));
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  zoom(factor, at = this.#middle) {
    const centre = this.view.follows ? this.#middle : at;
    this.view.camera.zoomAt(centre[0], centre[1], factor);
    this.view.invalidate();
  }

  turn(steps) {
    const [x, y] = this.#middle;
    this.view.camera.zoomAt(x, y, 1, steps * TURN_STEP_RAD);
    this.view.invalidate();
  }

  north() {
    const [x, y] = this.#middle;
    this.view.camera.zoomAt(x, y, 1, -this.view.camera.rotation_rad);
    this.view.invalidate();
  }

  /** True where the key means something on the map. */
  key(name) {
    switch (name) {
      case "ArrowLeft": this.#pan(PAN_PIXELS, 0); return true;
      case "ArrowRight": this.#pan(-PAN_PIXELS, 0); return true;
      case "ArrowUp": this.#pan(0, PAN_PIXELS); return true;
      case "ArrowDown": this.#pan(0, -PAN_PIXELS); return true;
      case "+": case "=": this.zoom(ZOOM_STEP); return true;
      case "-": this.zoom(1 / ZOOM_STEP); return true;
      case "[": this.turn(1); return true;
      case "]": this.turn(-1); return true;
      case "n": case "N": this.north(); return true;
      default: return false;
    }
  }

  get #middle() {
    return [this.view.camera.width / 2, this.view.camera.height / 2];
  }

  #point(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  #pan(dx, dy) {
    this.view.follows = false;
    this.view.camera.panBy(dx, dy);
    this.view.invalidate();
    this.changed();
  }

  #down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const point = this.#point(event);
    this.pointers.set(event.pointerId, { point, start: point, turns: event.button === 2 || event.shiftKey });
    if (this.pointers.size === 1 && !this.pointers.get(event.pointerId).turns) this.tool()?.down?.(point);
  }

  #move(event) {
    const point = this.#point(event);
    this.onHover?.(point);
    const pressed = this.pointers.get(event.pointerId);
    if (!pressed) return;
    if (this.pointers.size === 2) this.#pinch(event.pointerId, point);
    else if (pressed.turns) this.#turnBy(point[0] - pressed.point[0]);
    else if (this.tool()?.drags) this.tool().move(point);
    else if (Math.hypot(point[0] - pressed.start[0], point[1] - pressed.start[1]) > CLICK_PIXELS || pressed.hasMoved) {
      pressed.hasMoved = true;
      this.#pan(point[0] - pressed.point[0], point[1] - pressed.point[1]);
    } else return; // the first pixels of what may become a click
    pressed.point = point;
  }

  #up(event) {
    const pressed = this.pointers.get(event.pointerId);
    this.pointers.delete(event.pointerId);
    if (!pressed || pressed.turns || event.type === "pointercancel") return;
    const point = this.#point(event);
    if (this.tool()?.drags) this.tool().up(point);
    else if (!pressed.hasMoved && this.pointers.size === 0) this.tool()?.click?.(point);
  }

  #turnBy(dx) {
    const [x, y] = this.#middle;
    this.view.camera.zoomAt(x, y, 1, -dx * 0.01);
    this.view.invalidate();
  }

  /** Two fingers: the points of the map under them stay under them. */
  #pinch(id, point) {
    const moved = this.pointers.get(id);
    const other = [...this.pointers].find(([key]) => key !== id)[1];
    const before = [moved.point[0] - other.point[0], moved.point[1] - other.point[1]];
    const after = [point[0] - other.point[0], point[1] - other.point[1]];
    const factor = Math.hypot(...after) / Math.max(Math.hypot(...before), 1);
    const turn_rad = Math.atan2(before[1], before[0]) - Math.atan2(after[1], after[0]);
    moved.hasMoved = other.hasMoved = true;
    this.view.follows = false;
    this.view.camera.zoomAt(other.point[0], other.point[1], factor, turn_rad);
    this.view.invalidate();
    this.changed();
    moved.point = point;
  }

  #wheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    this.zoom(Math.exp(-event.deltaY * lines * 0.0015), this.#point(event));
  }
}
