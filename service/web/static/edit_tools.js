// Tools of the area Edit on the map: an area, a wall, a moment of the path, points of two places.
// Each works by pointer, and by keys: a click may come from the cross-hair in the middle of the map.

import { cornerNear } from "./corners.js";

const CLOSE_PIXELS = 12; // a click so near to a corner means that corner
const SNAP_PIXELS = 30; // from a click to the point of a scan, or to the key frame, that is meant
const DOT_PIXELS = 3;

const trace = (context, points) => {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
};

const dot = (context, [x, y], radius) => {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
};

/** Corners one after the other. Closed: an area, done when the first is clicked again; else a wall, done at its last. */
export class CornersTool {
  drags = false;
  area = "edit";

  /** most: corners at most; changed(): the corners are others; done(): the person is content. */
  constructor(view, { isClosed, most, changed, done }) {
    this.view = view;
    this.isClosed = isClosed;
    this.most = most;
    this.changed = changed;
    this.done = done;
    this.corners = []; // map points
    this.note = "";
  }

  get least() {
    return this.isClosed ? 3 : 2;
  }

  get hint() {
    if (this.note) return this.note;
    const again = this.isClosed ? "the first one again when the area is complete" : "the last one again when the wall is complete";
    return `Click the ${this.isClosed ? "corners" : "points of the wall"}; ${again}. Backspace takes one back, Esc ends.`;
  }

  get text() {
    return this.hint;
  }

  click(point) {
    const { camera } = this.view, last = this.isClosed ? this.corners[0] : this.corners.at(-1);
    const isAgain = last && this.corners.length > 1 && distance(camera.toScreen(...last), point) < CLOSE_PIXELS;
    this.note = "";
    if (isAgain && this.corners.length >= this.least) this.done();
    else if (this.corners.length >= this.most) this.note = `${this.most} points at most; make several changes.`;
    else if (!isAgain) this.corners.push(camera.toMap(...point));
    this.#tell();
  }

  back() {
    this.corners.pop();
    this.note = "";
    this.#tell();
  }

  #tell() {
    this.changed();
    this.view.invalidate();
  }

  draw(context, camera, colours) {
    const shown = this.corners.map(([x, y]) => camera.toScreen(x, y));
    outline(context, shown, this.isClosed, colours.measure);
  }
}

/** Press at one corner, let go at the one across; by keys two clicks. Its sides are those of the screen. */
export class RectangleTool {
  drags = true;
  area = "edit";
  hint = "Press at one corner, let go at the one across. With keys: Enter at both. Esc ends.";

  constructor(view, { changed, done }) {
    this.view = view;
    this.changed = changed;
    this.done = done;
    this.from = this.to = null; // screen points, while it is drawn
    this.corners = []; // map points
  }

  down(point) {
    this.from = this.to = point;
    this.#shape();
  }

  move(point) {
    if (!this.from) return;
    this.to = point;
    this.#shape();
  }

  up() {
    if (!this.from) return;
    const isDrag = Math.abs(this.to[0] - this.from[0]) > 3 && Math.abs(this.to[1] - this.from[1]) > 3;
    this.from = null;
    if (!isDrag) this.corners = [];
    this.changed();
    if (isDrag) this.done();
  }

  /** From the cross-hair: the map has moved under it since the first corner. */
  click(point) {
    const first = this.first;
    this.first = first ? null : this.view.camera.toMap(...point);
    if (!first) return;
    this.from = this.view.camera.toScreen(...first);
    this.to = point;
    this.#shape();
    this.up();
  }

  back() {
    this.first = null;
    this.corners = [];
    this.changed();
    this.view.invalidate();
  }

  #shape() {
    const [x0, y0] = this.from, [x1, y1] = this.to;
    this.corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]].map(([x, y]) => this.view.camera.toMap(x, y));
    this.changed();
    this.view.invalidate();
  }

  draw(context, camera, colours) {
    outline(context, this.corners.map(([x, y]) => camera.toScreen(x, y)), true, colours.measure);
    if (!this.first) return;
    context.fillStyle = colours.measure;
    dot(context, camera.toScreen(...this.first), DOT_PIXELS + 1);
  }
}

/** One key frame of the path. chosen(number) of the nearest to a click. */
export class KeyframeTool {
  drags = false;
  area = "edit";

  constructor(view, keyframes, what, chosen) {
    this.view = view;
    this.keyframes = keyframes;
    this.hint = `Click the path: ${what}. Esc ends.`;
    this.chosen = chosen;
  }

  click(point) {
    const k = this.keyframes.nearest(this.view.camera, point, SNAP_PIXELS);
    if (k !== null) this.chosen(k);
    else this.text = "The path does not lead along there; click nearer to it, or move the map.";
    this.view.invalidate();
  }

  draw(context, camera, colours) {
    this.keyframes.draw(context, camera, colours.graph.keyFrames);
  }
}

/**
 * Points of two places: one of A and the same of B. picked(pointOfA, pointOfB), map points.
 * On one map first that of A, then that of B; in two panes each in its own, in any order.
 */
export class PairTool {
  drags = false;
  area = "edit";

  /** places: {a, b}, each {points: [x_m, y_m, ...]}; see PlacePicker. pane: PlacePane of place B, open or not. */
  constructor(view, places, pane, picked) {
    this.view = view;
    this.places = places;
    this.pane = pane;
    this.picked = picked;
    this.found = { a: null, b: null }; // {at: map point, isCorner}, until there is one of each
    this.aimed = null; // what a click would mean: {side, at, isCorner}
    this.note = "";
  }

  get hint() {
    if (this.note) return this.note;
    const { a, b } = this.found;
    if (a) return `Now the same point ${this.pane.isOpen ? "in the pane" : "among those"} of place B. Backspace takes the first back.`;
    if (b) return "Now the same point in the pane of place A. Backspace takes the first back.";
    return this.pane.isOpen ? "Click a point in one pane, a corner of a wall, say; then the same one in the other. Esc ends."
      : "Click a point of place A, a corner of a wall, say; then the same one of place B. Esc ends.";
  }

  get text() {
    return this.hint;
  }

  /** pane: in which it was; left out, in the first. */
  click(point, pane = null) {
    const side = this.#side(pane), found = this.#nearest(point, side, pane);
    this.note = found ? "" : `No point of place ${side.toUpperCase()} is near there; click nearer to one of its colour.`;
    if (found) this.found[side] = found;
    const { a, b } = this.found;
    if (a && b) {
      this.found = { a: null, b: null };
      this.picked(a.at, b.at);
    }
    this.aimed = null;
    this.view.invalidate();
  }

  back() {
    this.found = { a: null, b: null };
    this.note = "";
    this.view.invalidate();
  }

  hover(point, pane = null) {
    const side = this.#side(pane), found = this.#nearest(point, side, pane);
    this.aimed = found && { side, ...found };
    this.view.invalidate();
  }

  #side(pane) {
    if (this.pane.isOpen) return pane ? "b" : "a";
    return this.found.a ? "b" : "a";
  }

  /** The corner of two walls, where one is near; else the nearest point of the place. */
  #nearest(point, side, pane) {
    const { camera } = pane ?? this.view, { points } = this.places[side];
    let least = SNAP_PIXELS, nearest = null;
    for (let i = 0; i < points.length; i += 2) {
      const away = distance(camera.toScreen(points[i], points[i + 1]), point);
      if (away < least) [least, nearest] = [away, [points[i], points[i + 1]]];
    }
    if (!nearest) return null;
    const corner = cornerNear(points, nearest);
    const isCorner = corner !== null && distance(camera.toScreen(...corner), point) < SNAP_PIXELS;
    return { at: isCorner ? corner : nearest, isCorner };
  }

  /** In two panes only what is of the first one. */
  draw(context, camera, colours) {
    this.drawOf(this.pane.isOpen ? ["a"] : ["a", "b"], context, camera, colours);
  }

  drawOf(sides, context, camera, colours) {
    context.lineWidth = 2;
    for (const side of sides) {
      for (const found of [this.found[side], this.aimed?.side === side ? this.aimed : null]) {
        if (!found) continue;
        context.strokeStyle = colours.places[side];
        drawAimed(context, camera.toScreen(...found.at), found.isCorner);
      }
    }
  }
}

/** A ring about a point, a square about a corner. */
const drawAimed = (context, [x, y], isCorner) => {
  context.beginPath();
  if (isCorner) context.rect(x - 8, y - 8, 16, 16);
  else context.arc(x, y, 7, 0, 2 * Math.PI);
  context.stroke();
};

/** Where a click by keys goes. */
export const drawCrossHair = (context, camera, colours) => {
  const x = camera.width / 2, y = camera.height / 2;
  context.strokeStyle = colours.measure;
  context.lineWidth = 1.5;
  context.beginPath();
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + 4 * dx, y + 4 * dy);
    context.lineTo(x + 16 * dx, y + 16 * dy);
  }
  context.stroke();
};

export const distance = ([x0, y0], [x1, y1]) => Math.hypot(x1 - x0, y1 - y0);

/** Of a polygon that does not cross itself, m2. */
export const area = (corners) => {
  let twice = 0;
  corners.forEach(([x, y], i) => {
    const [nx, ny] = corners[(i + 1) % corners.length];
    twice += x * ny - y * nx;
  });
  return Math.abs(twice) / 2;
};

export const length = (corners) => corners.slice(1).reduce((sum, corner, i) => sum + distance(corners[i], corner), 0);

const outline = (context, shown, isClosed, colour) => {
  if (!shown.length) return;
  context.strokeStyle = context.fillStyle = colour;
  context.lineWidth = 2;
  trace(context, shown);
  if (isClosed && shown.length > 2) {
    context.closePath();
    context.globalAlpha = 0.2;
    context.fill();
    context.globalAlpha = 1;
  }
  context.stroke();
  for (const corner of shown) dot(context, corner, DOT_PIXELS + 1);
};
