// Drawings of figures: a Series over time, plots of it, and the newest scan of a laser.

import { colour, FONT, niceLength, strokeLine } from "./canvas.js";
import { element, setText, swatched } from "./dom.js";
import { clockTime, duration, fixed } from "./format.js";
import { leastIndex } from "./geometry.js";
import { RANGE_STEP_M } from "./protocol.js";

const KEPT_ROWS = 600; // of a running service: ten minutes
const GAP_PERIODS = 4; // rows that far apart are not joined
const LEFT = 58, RIGHT = 6, TOP = 6, BOTTOM = 18;

export class Series {
  rows = []; // {stamp_s, state, level, figures: {name: value or null}}
  events = null; // all of a recording; null: they come one by one

  put({ goes_on, stamp_s, state, level, figures, events }) {
    const at = (i) => Object.fromEntries(Object.entries(figures).map(([name, values]) => [name, values[i]]));
    const rows = stamp_s.map((s, i) => ({ stamp_s: s, state: state[i], level: level[i], figures: at(i) }));
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

  /** The row nearest to a time; null: the newest. undefined where there are no rows. */
  rowAt(stamp_s) {
    return stamp_s === null ? this.rows.at(-1) : this.rows[leastIndex(this.rows, (row) => Math.abs(row.stamp_s - stamp_s))];
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

/** A canvas as wide as its place, sharp on every screen; paint(context, width, height) fills it. */
export class Drawing {
  constructor(className) {
    this.node = element("canvas", { className, role: "img" });
    new ResizeObserver(() => this.draw()).observe(this.node);
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.node, ratio = window.devicePixelRatio || 1;
    if (!width || !height) return;
    this.node.width = width * ratio;
    this.node.height = height * ratio;
    const context = this.node.getContext("2d");
    context.scale(ratio, ratio);
    context.font = `12px ${FONT}`;
    this.paint(context, width, height);
  }
}

/** Where a time lies on a drawing, and back. */
export const timeAxis = ([first_s, last_s], width) => {
  const span_s = Math.max(last_s - first_s, 1), across = width - LEFT - RIGHT;
  return {
    x: (stamp_s) => LEFT + (across * (stamp_s - first_s)) / span_s,
    at: (x) => first_s + (Math.min(Math.max(x - LEFT, 0), across) * span_s) / across,
  };
};

/** One plot of a Series. lines: [{name, words, colour}] of figures by their names; digits: of a figure in words. */
export class Plot extends Drawing {
  marked_s = null; // a time that is pointed at, or shown

  constructor(own) {
    super("plot");
    Object.assign(this, own); // series, title, unit, digits, leastTop, lines
  }

  words(row) {
    const known = this.lines.filter(({ name }) => typeof row?.figures[name] === "number");
    return known.map(({ name, words }) => `${words ? `${words} ` : ""}${row.figures[name].toFixed(this.digits)}${this.unit}`).join(", ") || "\u2013";
  }

  paint(context, width, height) {
    const { rows, span } = this.series, values = rows.flatMap(({ figures }) => this.lines.map(({ name }) => figures[name] ?? 0));
    const top = niceLength(Math.max(this.leastTop, ...values)), lowest = Math.min(0, ...values);
    const bottom = lowest < -0.02 * top ? -niceLength(-lowest) : 0;
    const y = (value) => TOP + ((height - TOP - BOTTOM) * (top - value)) / (top - bottom);
    context.strokeStyle = colour("--line");
    context.fillStyle = colour("--text-2");
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const value of bottom < 0 ? [bottom, 0, top] : [0, top / 2, top]) {
      context.fillText(`${Number(value.toPrecision(3))}${this.unit}`, LEFT - 4, Math.max(y(value), 8));
      strokeLine(context, [LEFT, y(value)], [width - RIGHT, y(value)]);
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
      strokeLine(context, [x(this.marked_s), TOP], [x(this.marked_s), height - BOTTOM]);
    }
    const gap_s = GAP_PERIODS * Math.max(1, (span[1] - span[0]) / rows.length);
    context.lineWidth = 1.5;
    for (const { name, colour: line } of this.lines) {
      context.strokeStyle = colour(line);
      context.beginPath();
      let before_s = -Infinity;
      for (const { stamp_s, figures } of rows) {
        const value = figures[name];
        if (typeof value !== "number") continue;
        if (stamp_s - before_s > gap_s) context.moveTo(x(stamp_s), y(value));
        context.lineTo(x(stamp_s), y(value));
        before_s = stamp_s;
      }
      context.stroke();
    }
  }
}

const RINGS = 4, MARGIN = 12; // pixels
const NO_RETURN = 0; // in a message, see protocol.py
const CAUSE_COLOURS = ["--warn", "--error", "--laser-4", "--laser-3", "--laser-2", "--laser-1", "--laser-0"];

export class PolarView extends Drawing {
  returns = element("p");
  legend = element("p", { className: "key" });
  scan = null;

  /** colourOf(): of the laser, as on the map; causes: why a beam has no return, in words. */
  constructor(colourOf, causes) {
    super("polar");
    Object.assign(this, { colourOf, causes });
  }

  put(scan) {
    this.scan = scan;
    this.found = Array.from(scan.ranges).filter((steps) => steps !== NO_RETURN); // of beams that returned
    const counts = new Map();
    scan.causes.forEach((cause, i) => { if (scan.ranges[i] === NO_RETURN) counts.set(cause, (counts.get(cause) ?? 0) + 1); });
    this.legend.replaceChildren(...[...counts].sort(([a], [b]) => a - b).map(([cause, count]) =>
      swatched(`${this.causes[cause] ?? "no return"}: ${count}`, colour(CAUSE_COLOURS[cause % CAUSE_COLOURS.length]), "cause")));
    setText(this.returns, this.words);
    this.draw();
  }

  get #farthest_m() {
    return RANGE_STEP_M * Math.max(...this.found);
  }

  get words() {
    const { ranges: { length: beams } } = this.scan, { length: returns } = this.found;
    return `${beams} beams: ${returns} returns, ${fixed(RANGE_STEP_M * Math.min(...this.found), 2)} to ${fixed(this.#farthest_m, 2, " m")}; ${beams - returns} without a return`;
  }

  paint(context, width, height) {
    if (!this.scan) return;
    const { first_angle_rad, angle_step_rad, ranges, causes } = this.scan, colours = CAUSE_COLOURS.map(colour);
    const rim_m = RINGS * niceLength(Math.max(this.found.length ? this.#farthest_m : 1, 0.1) / RINGS);
    const [x, y] = [width / 2, height / 2], radius = Math.min(x, y) - MARGIN;
    const at = (angle_rad, pixels) => [x - pixels * Math.sin(angle_rad), y - pixels * Math.cos(angle_rad)];
    context.strokeStyle = colour("--line");
    context.fillStyle = colour("--text-2");
    for (let ring = 1; ring <= RINGS; ring += 1) {
      const share = ring / RINGS;
      context.beginPath();
      context.arc(x, y, radius * share, 0, 2 * Math.PI);
      context.stroke();
      context.fillText(`${Number((rim_m * share).toFixed(2))} m`, x + 3, y + radius * share - 3);
    }
    context.fillStyle = this.colourOf() ?? colour("--text");
    ranges.forEach((steps, i) => {
      const angle_rad = first_angle_rad + i * angle_step_rad;
      if (steps === NO_RETURN) {
        context.strokeStyle = colours[causes[i] % colours.length];
        strokeLine(context, at(angle_rad, radius + 3), at(angle_rad, radius + 9));
      } else {
        const [sx, sy] = at(angle_rad, (radius * steps * RANGE_STEP_M) / rim_m);
        context.fillRect(sx - 1, sy - 1, 2, 2);
      }
    });
    this.node.setAttribute("aria-label", `Newest scan, forward is up. ${this.words}`);
  }
}
