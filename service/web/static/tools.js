// What can be done on the map besides looking: measure a distance, give the vehicle its pose.

import { dot, trace } from "./canvas.js";
import { degrees, metres } from "./format.js";
import { distance } from "./geometry.js";

const SHORTEST_DRAG_PIXELS = 12;
const DOT_PIXELS = 4;

/** What takes the clicks of the map, or its drags: down, move, up. */
export class MapTool {
  drags = false;
  area = ""; // to which a phone goes back when it is ended
  note = ""; // in place of what it asks for

  constructor(view, own = {}) {
    Object.assign(this, { view, ...own });
  }

  get hint() {
    return this.note || this.ask;
  }
}

/** What is drawn on the map by its corners, map points. changed(): they are others; done(): the person is content. */
export class ShapeTool extends MapTool {
  corners = [];
  colour = "measure";

  tell() {
    this.changed?.();
    this.view.invalidate();
  }

  draw(context, camera, colours) {
    const shown = this.corners.map((corner) => camera.toScreen(...corner)), isArea = this.isClosed && shown.length > 2;
    context.strokeStyle = context.fillStyle = colours[this.colour];
    context.lineWidth = 2;
    context.beginPath();
    trace(context, shown, isArea);
    if (isArea) {
      context.globalAlpha = 0.2;
      context.fill();
      context.globalAlpha = 1;
    }
    context.stroke();
    for (const corner of shown) dot(context, corner, DOT_PIXELS);
  }
}

/** Two clicks, a distance; a third starts over. */
export class MeasureTool extends ShapeTool {
  click(point) {
    this.corners = [...(this.corners.length < 2 ? this.corners : []), this.view.camera.toMap(...point)];
    this.tell();
  }

  get ask() {
    if (this.corners.length < 2) return "Click two points. Esc ends.";
    const [[x0, y0], [x1, y1]] = this.corners, dx = x1 - x0, dy = y1 - y0;
    return `${metres(Math.hypot(dx, dy))} (x ${metres(dx)}, y ${metres(dy)}), ${degrees(Math.atan2(dy, dx))}`;
  }
}

export class PoseTool extends ShapeTool {
  drags = true;
  area = "control";
  colour = "vehicle";
  ask = "Press where the vehicle stands, drag to where it looks, let go. Esc ends.";

  down(point) {
    this.corners = [this.view.camera.toMap(...point)];
    this.tell();
  }

  move(point) {
    this.corners = [...this.corners.slice(0, 1), this.view.camera.toMap(...point)];
    this.tell();
  }

  up() {
    const [from, to = from] = this.corners, { scale } = this.view.camera;
    this.corners = [];
    this.tell();
    if (!from || distance(from, to) * scale < SHORTEST_DRAG_PIXELS) return; // a click says nothing about the heading
    this.done({ x_m: from[0], y_m: from[1], theta_rad: Math.atan2(to[1] - from[1], to[0] - from[0]) });
  }
}
