// Tools of the area Edit on the map: an area, a wall, a moment of the path, points of two places.
// Each works by pointer, and by keys: a click may come from the cross-hair in the middle of the map.

import { cornerNear } from "./corners.js";
import { distance, leastIndex } from "./geometry.js";
import { MapTool, ShapeTool } from "./tools.js";

const CLOSE_PIXELS = 12; // a click so near to a corner means that corner
const SNAP_PIXELS = 30; // from a click to the point of a scan, or to the key frame, that is meant
const SHORTEST_DRAG_PIXELS = 3;

/** Corners one after the other. Closed: an area, done when the first is clicked again; else a wall, done at its last. */
export class CornersTool extends ShapeTool {
  area = "edit";

  get ask() {
    const [what, again] = this.isClosed ? ["corners", "the first one again when the area is complete"]
      : ["points of the wall", "the last one again when the wall is complete"];
    return `Click the ${what}; ${again}. Backspace takes one back, Esc ends.`;
  }

  click(point) {
    const { camera } = this.view, { length: count } = this.corners, last = this.corners.at(this.isClosed ? 0 : -1);
    const isAgain = count > 1 && distance(camera.toScreen(...last), point) < CLOSE_PIXELS;
    this.note = "";
    if (isAgain && count >= (this.isClosed ? 3 : 2)) this.done();
    else if (count >= this.most) this.note = `${this.most} points at most; make several changes.`;
    else if (!isAgain) this.corners.push(camera.toMap(...point));
    this.tell();
  }

  back() {
    this.corners.pop();
    this.note = "";
    this.tell();
  }
}

/** Press at one corner, let go at the one across; by keys two clicks. Its sides are those of the screen. */
export class RectangleTool extends ShapeTool {
  area = "edit";
  isClosed = true;
  drags = true;
  ask = "Press at one corner, let go at the one across. With keys: Enter at both. Esc ends.";
  from = null; // screen points, while it is drawn
  to = null;

  down(point) {
    this.from = point;
    this.move(point);
  }

  move(point) {
    if (!this.from) return;
    this.to = point;
    const [x0, y0] = this.from, [x1, y1] = point;
    this.corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]].map(([x, y]) => this.view.camera.toMap(x, y));
    this.tell();
  }

  up() {
    if (!this.from) return;
    const isDrag = [0, 1].every((axis) => Math.abs(this.to[axis] - this.from[axis]) > SHORTEST_DRAG_PIXELS);
    this.from = null;
    if (!isDrag) this.corners = [];
    this.changed();
    if (isDrag) this.done();
  }

  /** From the cross-hair: the map has moved under it since the first corner. */
  click(point) {
    const { corners, view: { camera } } = this;
    if (corners.length !== 1) this.corners = [camera.toMap(...point)];
    else {
      this.down(camera.toScreen(...corners[0]));
      this.move(point);
      this.up();
    }
    this.tell();
  }

  back() {
    this.corners = [];
    this.tell();
  }
}

/** One key frame of the path: chosen(number) of the nearest to a click. what: that is looked for. */
export class KeyframeTool extends MapTool {
  area = "edit";

  get ask() {
    return `Click the path: ${this.what}. Esc ends.`;
  }

  click(point) {
    const k = this.keyframes.nearest(this.view.camera, point, SNAP_PIXELS);
    if (k !== null) this.chosen(k);
    else this.note = "The path does not lead along there; click nearer to it, or move the map.";
    this.view.invalidate();
  }

  draw(context, camera, colours) {
    this.keyframes.draw(context, camera, colours.graph.keyFrames);
  }
}

/** Points of two places: one of A and the same of B. On one map first that of A, then that of B; in two panes each in its
 * own, in any order. places: {a, b} of PlacePicker; pane: PlacePane of place B; picked(pointOfA, pointOfB), map points. */
export class PairTool extends MapTool {
  area = "edit";
  found = { a: null, b: null }; // {at: map point, isCorner}, until there is one of each
  aimed = null; // what a click would mean: {side, at, isCorner}

  get ask() {
    const { found: { a, b }, pane: { isOpen } } = this;
    if (a) return `Now the same point ${isOpen ? "in the pane" : "among those"} of place B. Backspace takes the first back.`;
    if (b) return "Now the same point in the pane of place A. Backspace takes the first back.";
    return isOpen ? "Click a point in one pane, a corner of a wall, say; then the same one in the other. Esc ends."
      : "Click a point of place A, a corner of a wall, say; then the same one of place B. Esc ends.";
  }

  /** pane: in which it was; left out, in the first. */
  click(point, pane = null) {
    const { side, ...meant } = this.#nearest(point, pane);
    this.note = meant.at ? "" : `No point of place ${side.toUpperCase()} is near there; click nearer to one of its colour.`;
    if (meant.at) this.found[side] = meant;
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
    this.aimed = this.#nearest(point, pane);
    this.view.invalidate();
  }

  /** {side, at, isCorner}: the corner of two walls, where one is near; else the nearest point of the place; `at` is null where there is none. */
  #nearest(point, pane) {
    const side = (this.pane.isOpen ? pane : this.found.a) ? "b" : "a";
    const { camera } = pane ?? this.view, { points } = this.places[side];
    const away = (at) => distance(camera.toScreen(...at), point);
    const nearest = points[leastIndex(points, away, SNAP_PIXELS)] ?? null, corner = nearest && cornerNear(points, nearest);
    const isCorner = corner !== null && away(corner) < SNAP_PIXELS;
    return { side, at: isCorner ? corner : nearest, isCorner };
  }

  /** In two panes only what is of the first one. */
  draw(context, camera, colours) {
    this.drawOf(this.pane.isOpen ? ["a"] : ["a", "b"], context, camera, colours);
  }

  drawOf(sides, context, camera, { places }) {
    const marks = ["a", "b"].map((side) => ({ side, ...this.found[side] }));
    context.lineWidth = 2;
    for (const { side, at, isCorner } of [...marks, this.aimed ?? {}]) {
      if (!at || !sides.includes(side)) continue;
      const [x, y] = camera.toScreen(...at);
      context.strokeStyle = places[side];
      context.beginPath();
      if (isCorner) context.rect(x - 8, y - 8, 16, 16);
      else context.arc(x, y, 7, 0, 2 * Math.PI);
      context.stroke();
    }
  }
}

export const area = (corners) => Math.abs(corners.reduce((twice, [x, y], i) => {
  const [nx, ny] = corners[(i + 1) % corners.length];
  return twice + x * ny - y * nx;
}, 0)) / 2;

export const length = (corners) => corners.slice(1).reduce((sum, corner, i) => sum + distance(corners[i], corner), 0);
