// The area History: states and events over time, and figures; a click on any of them shows that moment.

import { colour, dot } from "./canvas.js";
import { card, element, setText, swatched } from "./dom.js";
import { eventLines } from "./events.js";
import { clockTime, duration } from "./format.js";
import { LEVELS } from "./health.js";
import { Drawing, Plot, Series, timeAxis } from "./plots.js";

const line = (name, colour = "--accent", words = "") => ({ name, colour, words });
const PLOTS = [
  { title: "Speed", unit: " m/s", digits: 2, leastTop: 0.2, lines: [line("speed_mps")] },
  { title: "Sigma of the position", unit: " m", digits: 3, leastTop: 0.02, lines: [line("sigma_m")] },
  { title: "Inlier ratio", unit: "", digits: 2, leastTop: 1, lines: [line("inlier_ratio")] },
  { title: "From a scan to its pose", unit: " ms", digits: 1, leastTop: 5, lines: [line("latency_max_ms", "--warn", "longest"), line("latency_p50_ms", "--accent", "median")] },
  { title: "Rates", unit: " Hz", digits: 1, leastTop: 10, lines: [] }, // of the sensors that there are
  { title: "Scans not mapped", unit: "", digits: 0, leastTop: 2, lines: [line("dropped", "--error")] },
];
const RATE_COLOURS = ["--laser-0", "--laser-1", "--laser-2", "--laser-3", "--laser-4", "--accent"];
const MAX_EVENTS = 300; // that stand in the list
const EVENT_HEIGHT = 12;

export class History {
  series = new Series();
  events = []; // {stamp_s, text}, as they came
  shown_s = null; // the time that was chosen; null: the newest
  marked_s = null; // the same, or that under the pointer

  /** goTo(stamp_s): show that moment of a recording; false where nothing can be gone to. */
  constructor(root, goTo) {
    Object.assign(this, { root, goTo });
    this.band = new Drawing("plot band");
    this.band.paint = (...sheet) => this.#drawBand(...sheet);
    this.list = element("ul", { className: "events timeline", tabIndex: 0, "aria-label": "States and events, the newest first" });
    this.timeline = card("States and events", this.band.node, this.list);
    this.plots = PLOTS.map((described) => {
      const plot = new Plot({ ...described, series: this.series }), key = element("p", { className: "note key" });
      return { plot, key, card: card(described.title, plot.node, key) };
    });
    root.append(this.timeline, ...this.plots.map((one) => one.card));
    for (const { node } of [this.band, ...this.plots.map(({ plot }) => plot)]) {
      node.addEventListener("pointermove", (event) => this.#mark(this.#at(event)));
      node.addEventListener("pointerleave", () => this.#mark(this.shown_s));
      node.addEventListener("click", (event) => this.#choose(this.#at(event)));
    }
    new ResizeObserver(() => this.update()).observe(root); // also when it is shown
  }

  clear() {
    Object.assign(this.series, new Series());
    Object.assign(this, { events: [], shown_s: null });
    this.update();
  }

  put(message) {
    this.series.put(message);
    this.update();
  }

  putEvent(event) {
    this.events = [...this.events, event].slice(-MAX_EVENTS);
    this.#list();
    this.band.draw();
  }

  putMoment({ at_s }) {
    this.shown_s = at_s;
    this.#mark(at_s);
  }

  update() {
    if (this.root.hidden) return;
    const rates = this.series.names.filter((name) => name.startsWith("rate_hz/"));
    this.plots.find(({ plot }) => plot.title === "Rates").plot.lines = rates.map((name, i) =>
      line(name, RATE_COLOURS[i % RATE_COLOURS.length], name.slice("rate_hz/".length)));
    for (const { plot: { lines }, card: node, key } of this.plots) {
      node.hidden = !lines.some(({ name }) => this.series.rows.some(({ figures }) => typeof figures[name] === "number"));
      key.hidden = lines.length < 2;
      key.replaceChildren(...(key.hidden ? [] : lines.map(({ words, colour: its }) => swatched(words, `var(${its})`))));
    }
    this.#list();
    this.#mark(this.shown_s);
  }

  #list() {
    if (this.root.hidden) return;
    const states = this.series.states.map(({ from_s, to_s, state, level }, i, all) => ({ stamp_s: from_s, level,
      words: `${state || "no state known"}${i + 1 < all.length ? `, ${duration(to_s - from_s)}` : ""}` }));
    const lines = [...(states.length > 1 ? states : []), ...eventLines(this.series.events ?? this.events)].sort((a, b) => b.stamp_s - a.stamp_s).slice(0, MAX_EVENTS);
    const listed = JSON.stringify(lines);
    if (listed === this.listed) return; // what is focused stays
    this.listed = listed;
    this.timeline.hidden = lines.length === 0;
    this.list.replaceChildren(...lines.map(({ stamp_s, level, words }) => {
      const mark = element("span", level === undefined ? { className: "dot event-dot" } : { className: "dot", "data-level": LEVELS[level] });
      return element("li", {}, element("button", { type: "button", className: "line", onclick: () => this.#choose(stamp_s) },
        mark, element("time", {}, clockTime(stamp_s)), element("span", {}, words)));
    }));
  }

  #at(event) {
    const { span } = this.series, box = event.target.getBoundingClientRect();
    return span && timeAxis(span, box.width).at(event.clientX - box.left);
  }

  #choose(stamp_s) {
    if (stamp_s === null || this.goTo(stamp_s)) return;
    this.shown_s = this.shown_s === stamp_s ? null : stamp_s; // of a running service: the figures of then
    this.#mark(this.shown_s);
  }

  /** The figures of a time stand at the heads of the plots; null: the newest. */
  #mark(stamp_s) {
    const row = this.series.rowAt(stamp_s);
    this.marked_s = stamp_s;
    setText(this.timeline.aside, row && stamp_s !== null ? clockTime(row.stamp_s) : "");
    for (const { plot, card: { aside } } of this.plots) {
      plot.marked_s = stamp_s;
      setText(aside, plot.words(row));
      plot.draw();
    }
    this.band.draw();
  }

  #drawBand(context, width, height) {
    const { span, states } = this.series;
    if (!span) return;
    const { x } = timeAxis(span, width), states_px = height - EVENT_HEIGHT;
    for (const { from_s, to_s, level } of states) {
      context.fillStyle = colour(`--${LEVELS[level]}`);
      const high = states_px * (0.6 + 0.2 * Math.min(level, 2)); // higher where worse: not by colour alone
      context.fillRect(x(from_s), height - high, Math.max(x(to_s) - x(from_s), 2), high);
    }
    context.fillStyle = colour("--text");
    for (const { stamp_s } of this.series.events ?? this.events) {
      if (stamp_s >= span[0] - 1 && stamp_s <= span[1] + 1) dot(context, [x(stamp_s), EVENT_HEIGHT / 2], 3.5);
    }
    if (this.marked_s !== null) context.fillRect(x(this.marked_s) - 1, 0, 2, height);
    this.band.node.setAttribute("aria-label", `States of the last ${duration(span[1] - span[0])}: ${states.length}, now ${states.at(-1).state || "not known"}; listed below`);
  }
}
