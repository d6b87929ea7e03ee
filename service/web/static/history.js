// The area History: states and events over time, and figures; a click on any of them shows that moment.

import { card, element, setText, swatched } from "./dom.js";
import { clockTime, duration } from "./format.js";
import { eventLines } from "./events.js";
import { LEVELS } from "./information.js";
import { colour, Drawing, Plot, Series, timeAxis } from "./series.js";

const PLOTS = [ // title, unit, digits, least top of the scale, lines
  ["Speed", " m/s", 2, 0.2, [["speed_mps", "", "--accent"]]],
  ["Sigma of the position", " m", 3, 0.02, [["sigma_m", "", "--accent"]]],
  ["Inlier ratio", "", 2, 1, [["inlier_ratio", "", "--accent"]]],
  ["From a scan to its pose", " ms", 1, 5, [["latency_max_ms", "longest", "--warn"], ["latency_p50_ms", "median", "--accent"]]],
  ["Rates", " Hz", 1, 10, null],
  ["Scans not mapped", "", 0, 2, [["dropped", "", "--error"]]],
];
const RATE_COLOURS = ["--laser-0", "--laser-1", "--laser-2", "--laser-3", "--laser-4", "--accent"];
const MAX_EVENTS = 300; // that stand in the list
const EVENT_HEIGHT = 12;

export class History {
  /** goTo(stamp_s): show that moment of a recording; null while nothing can be gone to. */
  constructor(root, goTo) {
    this.goTo = goTo;
    this.series = new Series();
    this.events = []; // {stamp_s, text}, as they came
    this.band = new Drawing("plot band", (...sheet) => this.#drawBand(...sheet));
    this.timeline = card("States and events");
    this.list = element("ul", { className: "events timeline", tabIndex: 0, "aria-label": "States and events, the newest first" });
    this.timeline.node.append(this.band.node, this.list);
    this.plots = PLOTS.map(([title, unit, digits, leastTop, lines]) => {
      const made = card(title);
      const named = (lines ?? []).map(([name, words, line]) => ({ name, words, colour: line }));
      const plot = new Plot(this.series, title, unit, named, digits, leastTop);
      const key = element("p", { className: "note key" });
      made.node.append(plot.node, key);
      return { plot, card: made, key, isOfRates: lines === null };
    });
    root.append(this.timeline.node, ...this.plots.map(({ card: { node } }) => node));
    this.root = root;
    for (const { node } of [this.band, ...this.plots.map(({ plot }) => plot)]) {
      node.addEventListener("pointermove", (event) => this.#mark(this.#at(event)));
      node.addEventListener("pointerleave", () => this.#mark(this.shown_s ?? null));
      node.addEventListener("click", (event) => this.#choose(this.#at(event)));
    }
    new ResizeObserver(() => this.update()).observe(root); // also when it is shown
  }

  clear() {
    this.series.clear();
    this.events = [];
    this.shown_s = null;
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

  /** Of a recording: which of its moments is shown. */
  putMoment({ at_s }) {
    this.shown_s = at_s;
    this.#mark(at_s);
  }

  /** All of it again; nothing while the area is hidden. */
  update() {
    if (this.root.hidden) return;
    this.#nameRates();
    for (const { plot, card: { node }, key } of this.plots) {
      node.hidden = !plot.lines.some(({ name }) => this.series.rows.some(({ figures }) => typeof figures[name] === "number"));
      key.hidden = plot.lines.length < 2;
      key.replaceChildren(...(key.hidden ? [] : plot.lines.map(({ words, colour: line }) => swatched(words, `var(${line})`))));
    }
    this.#list();
    this.#mark(this.shown_s ?? null);
  }

  #nameRates() {
    const names = this.series.names.filter((name) => name.startsWith("rate_hz/"));
    const { plot } = this.plots.find(({ isOfRates }) => isOfRates);
    plot.lines = names.map((name, i) => ({ name, words: name.slice("rate_hz/".length), colour: RATE_COLOURS[i % RATE_COLOURS.length] }));
  }

  /** Lines of states and events: a button each where it can be gone to. */
  #list() {
    if (this.root.hidden) return;
    const states = this.series.states.map(({ from_s, to_s, state, level }, i, all) => ({ stamp_s: from_s, level,
      words: `${state || "no state known"}${i + 1 < all.length ? `, ${duration(to_s - from_s)}` : ""}` }));
    const lines = [...(states.length > 1 || states[0]?.state ? states : []), ...eventLines(this.series.events ?? this.events)].sort((a, b) => b.stamp_s - a.stamp_s).slice(0, MAX_EVENTS);
    const listed = JSON.stringify(lines);
    if (listed === this.listed) return; // what is focused stays
    this.listed = listed;
    this.timeline.node.hidden = lines.length === 0;
    this.list.replaceChildren(...lines.map(({ stamp_s, level, words }) => {
      const dot = element("span", { className: level === undefined ? "dot event-dot" : "dot" });
      if (level !== undefined) dot.dataset.level = LEVELS[level];
      const button = element("button", { type: "button", className: "line", onclick: () => this.#choose(stamp_s) }, dot, element("time", {}, clockTime(stamp_s)), element("span", {}, words));
      return element("li", {}, button);
    }));
  }

  #at(event) {
    const { span } = this.series, box = event.target.getBoundingClientRect();
    return span && timeAxis(span, box.width).at(event.clientX - box.left);
  }

  #choose(stamp_s) {
    if (stamp_s === null) return;
    if (this.goTo(stamp_s)) return;
    this.shown_s = this.shown_s === stamp_s ? null : stamp_s; // of a running service: the figures of then
    this.#mark(this.shown_s);
  }

  /** The figures of a time stand at the heads of the plots; null: the newest. */
  #mark(stamp_s) {
    const { rows } = this.series, row = rows.length === 0 ? undefined : stamp_s === null ? rows.at(-1) : this.series.rowAt(stamp_s);
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
      if (stamp_s < span[0] - 1 || stamp_s > span[1] + 1) continue;
      context.beginPath();
      context.arc(x(stamp_s), EVENT_HEIGHT / 2, 3.5, 0, 2 * Math.PI);
      context.fill();
    }
    if (this.marked_s !== null) context.fillRect(x(this.marked_s) - 1, 0, 2, height);
    const now = states.at(-1);
    this.band.node.setAttribute("aria-label", `States of the last ${duration(span[1] - span[0])}: ${states.length}, now ${now.state || "not known"}; listed below`);
  }
}
