// A small plot over time: the last minutes, two lines, a scale that moves only when it must.

import { niceLength } from "./map_view.js";

const SHOWN_S = 300, LEFT = 40, BOTTOM = 18, TOP = 8;

export class LatencyPlot {
  constructor() {
    this.points = []; // [stamp_s, median_ms, longest_ms, scans]
    this.node = document.createElement("canvas");
    this.node.className = "plot";
    this.node.setAttribute("role", "img");
    new ResizeObserver(() => this.draw()).observe(this.node);
  }

  set(points) {
    this.points = points;
    this.draw();
  }

  add(point) {
    this.points.push(point);
    while (this.points[0][0] < point[0] - SHOWN_S) this.points.shift();
    this.draw();
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.node;
    if (!width || !height) return;
    const ratio = window.devicePixelRatio || 1;
    this.node.width = width * ratio;
    this.node.height = height * ratio;
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const context = this.node.getContext("2d");
    context.scale(ratio, ratio);
    context.clearRect(0, 0, width, height);
    const top_ms = niceLength(Math.max(5, ...this.points.map((p) => p[2])));
    const newest_s = this.points.at(-1)?.[0] ?? 0;
    const x = (stamp_s) => LEFT + ((width - LEFT - 4) * (stamp_s - newest_s + SHOWN_S)) / SHOWN_S;
    const y = (ms) => TOP + (height - TOP - BOTTOM) * (1 - ms / top_ms);
    context.font = "12px system-ui, sans-serif";
    context.fillStyle = colour("--text-2");
    context.strokeStyle = colour("--line");
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const ms of [0, top_ms / 2, top_ms]) {
      context.fillText(`${ms} ms`, LEFT - 4, Math.max(y(ms), 8));
      context.beginPath();
      context.moveTo(LEFT, y(ms));
      context.lineTo(width - 4, y(ms));
      context.stroke();
    }
    context.textBaseline = "alphabetic";
    context.fillText("now", width - 4, height - 4);
    context.textAlign = "left";
    context.fillText("5 min ago", LEFT, height - 4);
    this.#line(context, x, y, 2, colour("--warn"), 1);
    this.#line(context, x, y, 1, colour("--accent"), 2);
    const last = this.points.at(-1);
    this.node.setAttribute("aria-label", last
      ? `Milliseconds from a scan to its pose over five minutes; now median ${last[1].toFixed(1)}, longest ${last[2].toFixed(1)}.`
      : "Milliseconds from a scan to its pose: none yet.");
  }

  #line(context, x, y, column, colour, width) {
    context.beginPath();
    for (const point of this.points) context.lineTo(x(point[0]), y(point[column]));
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.stroke();
  }
}
