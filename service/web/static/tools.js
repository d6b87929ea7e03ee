// What can be done on the map besides looking: measure a distance, give the vehicle its pose.

import { degrees, metres } from "./format.js";

const SHORTEST_DRAG_PIXELS = 12;

const drawLine = (context, from, to, colour) => {
  context.strokeStyle = colour;
  context.fillStyle = colour;
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
  for (const [x, y] of [from, to]) {
    context.beginPath();
    context.arc(x, y, 4, 0, 2 * Math.PI);
    context.fill();
  }
};

/** Two clicks, a distance; a third starts over. */
export class MeasureTool {
  drags = false;
  hint = "Click two points. Esc ends.";

  constructor(view) {
    this.view = view;
    this.points = []; // map points
  }

  click([sx, sy]) {
    if (this.points.length === 2) this.points = [];
    this.points.push(this.view.camera.toMap(sx, sy));
    this.view.invalidate();
  }

  get text() {
    if (this.points.length < 2) return "";
    const [[x0, y0], [x1, y1]] = this.points;
    const dx = x1 - x0, dy = y1 - y0;
    return `${metres(Math.hypot(dx, dy))} (x ${metres(dx)}, y ${metres(dy)}), ${degrees(Math.atan2(dy, dx))}`;
  }

  draw(context, camera, colours) {
    const shown = this.points.map(([x, y]) => camera.toScreen(x, y));
    if (shown.length === 1) drawLine(context, shown[0], shown[0], colours.measure);
    if (shown.length === 2) drawLine(context, shown[0], shown[1], colours.measure);
  }
}

/** Press where the vehicle stands, drag to where it looks, let go. done(pose_map_base) */
export class PoseTool {
  drags = true;
  area = "control";
  hint = "Press where the vehicle stands, drag to where it looks, let go. Esc ends.";

  constructor(view, done) {
    this.view = view;
    this.done = done;
    this.from = this.to = null; // map points
  }

  down([sx, sy]) {
    this.from = this.to = this.view.camera.toMap(sx, sy);
    this.view.invalidate();
  }

  move([sx, sy]) {
    this.to = this.view.camera.toMap(sx, sy);
    this.view.invalidate();
  }

  up() {
    if (!this.from) return;
    const dx = this.to[0] - this.from[0], dy = this.to[1] - this.from[1];
    const pose = { x_m: this.from[0], y_m: this.from[1], theta_rad: Math.atan2(dy, dx) };
    const isDrag = Math.hypot(dx, dy) * this.view.camera.scale >= SHORTEST_DRAG_PIXELS;
    this.from = this.to = null;
    this.view.invalidate();
    if (isDrag) this.done(pose); // a click says nothing about the heading
  }

  draw(context, camera, colours) {
    if (!this.from) return;
    drawLine(context, camera.toScreen(...this.from), camera.toScreen(...this.to), colours.vehicle);
  }
}
