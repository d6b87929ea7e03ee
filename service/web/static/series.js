// Figures over time, a row a second, as service/web/series.py makes them; and a plot of some of them.

import { clockTime, duration } from "./format.js";
import { niceLength } from "./map_view.js";

const KEPT_ROWS = 600; // of a running service: ten minutes
const GAP_PERIODS = 4; // rows that far apart are not joined
const LEFT = 58, RIGHT = 6, TOP = 6, BOTTOM = 18;

export class Series {
  constructor() {
    this.clear();
  }

  clear() {
    this.rows = []; // {stamp_s, state, level, figures: {name: value or null}}
    this.events = null; // all of a recording; null: they come one by one
  }

  put({ goes_on, stamp_s, state, level, figures, events }) {
    const names = Object.keys(figures);
    const rows = stamp_s.map((s, i) => ({ stamp_s: s, state: state[i], level: level[i],
      figures: Object.fromEntries(names.map((name) => [name, figures[name][i]])) }));
    this.rows = goes_on ? this.rows.concat(rows).slice(-KEPT_ROWS) : rows;
    if (!goes_on) this.events = events;
  }

  get names() {
    return [...new Set(this.rows.flatMap(({ figures }) => Object.keys(figures)))].sort();
  }

  /** [first, last], Unix time, s; null where there are no rows. */
  get span() {
    return this.rows.length ? [this.rows[0].stamp_s, this.rows.at(-1).stamp_s] : null;
  }

  /** The row nearest to a time. */
  rowAt(stamp_s) {
    return this.rows.reduce((best, row) => (Math.abs(row.stamp_s - stamp_s) < Math.abs(best.stamp_s - stamp_s) ? row : best));
  }

  /** Stretches of one state: {from_s, to_s, state, level}. */
  get states() {
    const found = [];
    for (const { stamp_s, state, level } of this.rows) {
      const last = found.at(-1);
      if (last) last.to_s = stamp_s;
      if (!last || last.state !== state) found.push({ from_s: stamp_s, to_s: stamp_s, state, level });
    }
    return found;
  }
}

/** A canvas as wide as its place, sharp on every screen. draw(context, width, height) fills it. */
export class Drawing {
  constructor(className, draw) {
    this.node = document.createElement("canvas");
    this.node.className = className;
    this.node.setAttribute("role", "img");
    this.fill = draw;
    new ResizeObserver(() => this.draw()).observe(this.node);
  }

  /** Nothing while it is hidden. */
  draw() {
    const { clientWidth: width, clientHeight: height } = this.node;
    if (!width || !height) return;
    const ratio = window.devicePixelRatio || 1;
    this.node.width = width * ratio;
    this.node.height = height * ratio;
    const context = this.node.getContext("2d");
    context.scale(ratio, ratio);
    context.font = "12px system-ui, sans-serif";
    this.fill(context, width, height);
  }
}

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Where a time lies on a drawing, and back. */
export const timeAxis = ([first_s, last_s], width) => {
  const span_s = Math.max(last_s - first_s, 1), across = width - LEFT - RIGHT;
  return {
    x: (stamp_s) => LEFT + (across * (stamp_s - first_s)) / span_s,
    at: (x) => first_s + (Math.min(Math.max(x - LEFT, 0), across) * span_s) / across,
  };
};

/** One plot of a Series.
 *
 * lines    [{name, words, colour}] of figures by their names; colours of the style sheet
 * digits   of a figure in words */
export class Plot extends Drawing {
  constructor(series, title, unit, lines, digits, leastTop) {
    super("plot", (...sheet) => this.#draw(...sheet));
    Object.assign(this, { series, title, unit, lines, digits, leastTop });
    this.marked_s = null; // a time that is pointed at, or shown
  }

  words(row) {
    const known = this.lines.filter(({ name }) => typeof row?.figures[name] === "number");
    return known.map(({ name, words }) => `${words ? `${words} ` : ""}${row.figures[name].toFixed(this.digits)}${this.unit}`).join(", ") || "\u2013";
  }

  #draw(context, width, height) {
    const { rows, span } = this.series;
    const values = rows.flatMap(({ figures }) => this.lines.map(({ name }) => figures[name] ?? 0));
    const top = niceLength(values.reduce((most, value) => Math.max(most, value), this.leastTop));
    const lowest = values.reduce((least, value) => Math.min(least, value), 0), bottom = lowest < -0.02 * top ? -niceLength(-lowest) : 0;
    const y = (value) => TOP + ((height - TOP - BOTTOM) * (top - value)) / (top - bottom);
    context.strokeStyle = colour("--line");
    context.fillStyle = colour("--text-2");
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const value of bottom < 0 ? [bottom, 0, top] : [0, top / 2, top]) {
      context.fillText(`${Number(value.toPrecision(3))}${this.unit}`, LEFT - 4, Math.max(y(value), 8));
      strokeLine(context, LEFT, y(value), width - RIGHT, y(value));
    }
    this.node.setAttribute("aria-label", `${this.title}: ${rows.length ? `${duration(span[1] - span[0])}, at last ${this.words(rows.at(-1))}` : "not known"}`);
    if (!rows.length) return;
    const { x } = timeAxis(span, width);
    context.textBaseline = "alphabetic";
    context.fillText(clockTime(span[1]), width - RIGHT, height - 4);
    context.textAlign = "left";
    context.fillText(clockTime(span[0]), LEFT, height - 4);
    if (this.marked_s !== null) {
      context.strokeStyle = colour("--text-2");
      strokeLine(context, x(this.marked_s), TOP, x(this.marked_s), height - BOTTOM);
    }
    const gap_s = GAP_PERIODS * Math.max(1, (span[1] - span[0]) / rows.length);
    for (const line of this.lines) {
      context.strokeStyle = colour(line.colour);
      context.lineWidth = 1.5;
      context.beginPath();
      let before_s = -Infinity;
      for (const { stamp_s, figures } of rows) {
        const value = figures[line.name];
        if (typeof value !== "number") continue;
        if (stamp_s - before_s > gap_s) context.moveTo(x(stamp_s), y(value));
        context.lineTo(x(stamp_s), y(value));
        before_s = stamp_s;
      }
      context.stroke();
    }
  }
}

const strokeLine = (context, x1, y1, x2, y2) => {
  context.beginPath();
  context.moveTo(x1, y1);
  context.lineTo(x2, y2);
  context.stroke();
};
