// Mouse, fingers and keys on the map. A tool that is at work takes the clicks and drags instead.

const PAN_PIXELS = 60, ZOOM_STEP = 1.25, TURN_STEP_RAD = Math.PI / 12;
const CLICK_PIXELS = 5; // a press that moved less is a click

export const hasModifier = ({ ctrlKey, metaKey, altKey }) => ctrlKey || metaKey || altKey;

export class Gestures {
  /** view: MapCanvas. tool(): what is at work, null where nothing is: {drags, down, move, up, click, back}, points in CSS pixels. */
  constructor(view, tool, ownKeys = {}) {
    const { canvas } = view;
    this.view = view;
    this.tool = tool;
    this.pointers = new Map();
    this.keys = {
      ArrowLeft: () => this.#pan(PAN_PIXELS, 0), ArrowRight: () => this.#pan(-PAN_PIXELS, 0),
      ArrowUp: () => this.#pan(0, PAN_PIXELS), ArrowDown: () => this.#pan(0, -PAN_PIXELS),
      "+": () => this.#zoom(ZOOM_STEP), "=": () => this.#zoom(ZOOM_STEP), "-": () => this.#zoom(1 / ZOOM_STEP),
      "[": () => this.#turn(TURN_STEP_RAD), "]": () => this.#turn(-TURN_STEP_RAD), n: () => this.#turn(-view.camera.rotation_rad),
      Enter: () => tool()?.click?.(view.camera.middle), Backspace: () => tool()?.back?.(), ...ownKeys,
    };
    const listen = (kinds, act) => { for (const kind of kinds) canvas.addEventListener(kind, act, { passive: false }); };
    listen(["pointerdown"], (event) => this.#down(event));
    listen(["pointermove"], (event) => this.#move(event));
    listen(["pointerup", "pointercancel"], (event) => this.#up(event));
    listen(["wheel"], (event) => this.#wheel(event));
    listen(["contextmenu"], (event) => event.preventDefault());
    listen(["keydown"], (event) => {
      if (!hasModifier(event) && !(event.repeat && event.key === "Enter") && this.key(event.key)) event.preventDefault();
    });
    listen(["focus", "blur"], () => view.invalidate()); // the cross-hair
  }

  key(name) {
    const act = this.keys[name.length === 1 ? name.toLowerCase() : name];
    act?.();
    return act !== undefined;
  }

  #point(event) {
    const box = this.view.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  #pan(dx, dy) {
    this.view.camera.panBy(dx, dy);
    this.view.follow(false);
  }

  #zoom(factor, at = this.view.camera.middle) {
    this.view.camera.zoomAt(this.view.follows ? this.view.camera.middle : at, factor);
    this.view.invalidate();
  }

  #turn(turn_rad) {
    this.view.camera.zoomAt(this.view.camera.middle, 1, turn_rad);
    this.view.invalidate();
  }

  #down(event) {
    this.view.canvas.setPointerCapture(event.pointerId);
    const point = this.#point(event), turns = event.button === 2 || event.shiftKey;
    this.pointers.set(event.pointerId, { point, start: point, turns });
    if (this.pointers.size === 1 && !turns) this.tool()?.down?.(point);
  }

  #move(event) {
    const point = this.#point(event), [x, y] = point;
    this.onHover?.(point);
    const pressed = this.pointers.get(event.pointerId);
    if (!pressed) return;
    const dx = x - pressed.point[0], dy = y - pressed.point[1];
    if (this.pointers.size === 2) this.#pinch(event.pointerId, point);
    else if (pressed.turns) this.#turn(-dx * 0.01);
    else if (this.tool()?.drags) this.tool().move(point);
    else if (pressed.hasMoved || Math.hypot(x - pressed.start[0], y - pressed.start[1]) > CLICK_PIXELS) {
      pressed.hasMoved = true;
      this.#pan(dx, dy);
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

  /** Two fingers: the points of the map under them stay under them. */
  #pinch(id, [x, y]) {
    const moved = this.pointers.get(id), other = [...this.pointers].find(([key]) => key !== id)[1], [x0, y0] = other.point;
    const before = [moved.point[0] - x0, moved.point[1] - y0], after = [x - x0, y - y0];
    const factor = Math.hypot(...after) / Math.max(Math.hypot(...before), 1);
    const turn_rad = Math.atan2(before[1], before[0]) - Math.atan2(after[1], after[0]);
    moved.hasMoved = other.hasMoved = true;
    this.view.camera.zoomAt(other.point, factor, turn_rad);
    this.view.follow(false);
  }

  #wheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    this.#zoom(Math.exp(-event.deltaY * lines * 0.0015), this.#point(event));
  }
}
