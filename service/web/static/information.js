// The area Information: how things stand, in words and figures.

import { byId, element, Facts, setText } from "./dom.js";
import { eventLines } from "./events.js";
import { clockTime, degrees, deviceClock, duration, figure, fixed } from "./format.js";
import { deviationsInMap, wrapAngle } from "./geometry.js";
import { explain, hasOwnPose, helpLink, LEVELS, statusOf, valuesOf } from "./health.js";
import { PolarView } from "./plots.js";

const COLUMNS = 6; // of the table of sensors
const MAX_EVENTS = 60;
const MAX_SIGMA_MS = 5; // of a clock that is known
const UNKNOWN = "\u2013";
const NO_POSE = { "x": UNKNOWN, "y": UNKNOWN, "Heading": UNKNOWN, "Speed": UNKNOWN };

export class Information {
  stamp_s = null; // of the newest health, Unix time
  causes = []; // why a beam has no return, in words
  events = []; // {stamp_s, text}, as they came
  rows = new Map(); // of sensors and parts, by the names of their statuses

  constructor(colourOf) {
    this.colourOf = colourOf;
    this.pose = new Facts(byId("pose-facts"));
    this.pose.set({ ...NO_POSE, "Agreement with the map": UNKNOWN, "Scans mapped a second": UNKNOWN }); // in this order
    this.recording = new Facts(byId("recording-facts"));
  }

  putLost() {
    byId("information-old").hidden = this.stamp_s === null;
    if (this.stamp_s !== null) setText(byId("information-old"), `No connection. All of this is of ${clockTime(this.stamp_s)}.`);
  }

  clear() {
    this.stamp_s = null;
    byId("information-old").hidden = true;
    for (const facts of [this.pose, this.recording]) facts.clear();
    for (const emptied of ["mapping-words", "mapping-since", "sensors-well", "recording-state", "sensor-rows", "part-rows"]) byId(emptied).replaceChildren();
    this.putEvents([]);
    this.rows.clear();
  }

  putPose(pose) {
    if (!pose) {
      this.pose.set(NO_POSE);
      return;
    }
    const { x_std_m, y_std_m, theta_std_rad } = deviationsInMap(pose);
    const metres = (m, std_m) => `${fixed(m, 3, " m")} \u00b1 ${fixed(100 * std_m, 1, " cm")}`;
    this.pose.set({ "x": metres(pose.x_m, x_std_m), "y": metres(pose.y_m, y_std_m),
      "Heading": `${degrees(wrapAngle(pose.theta_rad))} \u00b1 ${degrees(theta_std_rad, 2)}`,
      "Speed": `${fixed(pose.twist[0], 2, " m/s")}, ${degrees(pose.twist[2])}/s` });
  }

  putHealth(health) {
    this.stamp_s = health.stamp_s;
    byId("information-old").hidden = true;
    const isSensor = ({ name }) => name.startsWith("sensor/"), mapping = statusOf(health, "mapping"), recording = statusOf(health, "recording");
    if (mapping) this.#mapping(mapping);
    if (recording) this.#recording(recording, valuesOf(health, "map"));
    const sensors = health.statuses.filter(isSensor);
    for (const status of sensors) this.#sensor(status, health.latency_ms);
    setText(byId("sensors-well"), `${sensors.filter(({ level }) => level === 0).length} of ${sensors.length} well`);
    for (const status of health.statuses.filter((one) => !isSensor(one))) this.#part(status);
    // A replay, a stored map and a fleet have no devices.
    const hasPose = hasOwnPose(health), hasDevices = hasPose && !statusOf(health, "replay");
    for (const card of ["sensors", "recording", "events"]) byId(card).hidden = !hasDevices;
    for (const part of ["pose-facts", "mapping-since"]) byId(part).hidden = !hasPose;
  }

  putMoment({ events }) {
    if (events.at(-1)?.stamp_s !== this.events.at(-1)?.stamp_s) this.putEvents(events);
  }

  putEvent(event) {
    this.putEvents([...this.events, event]);
  }

  putEvents(events) {
    this.events = events.slice(-MAX_EVENTS);
    byId("event-list").replaceChildren(...eventLines(this.events).reverse().map(({ stamp_s, words }) =>
      element("li", {}, element("time", {}, clockTime(stamp_s)), element("span", {}, words))));
  }

  #for({ since_s }) {
    return duration(this.stamp_s - since_s);
  }

  #mapping(mapping) {
    const { values } = mapping, isLive = "scan_rate_hz" in values;
    setText(byId("mapping-since"), `for ${this.#for(mapping)}`);
    byId("mapping-manual").hidden = mapping.level === 0;
    explain(byId("mapping-manual"), mapping);
    setText(byId("mapping-words"), mapping.message === "ok" ? "Everything is well." : mapping.message);
    this.pose.set({
      "Agreement with the map": figure(values.inlier_ratio && 100 * values.inlier_ratio, 0, " %"),
      "Scans mapped": isLive ? null : values.scans ?? null, // of a replay, which has no rate of its own
      "Scans mapped a second": isLive ? figure(values.scan_rate_hz, 1) : null,
      "Scans not mapped": isLive ? values.scans_dropped ?? UNKNOWN : null,
      "Processor a scan, median": isLive ? figure(values.scan_cpu_ms_p50, 1, " ms") : null,
      "Loops closed": values.loop_closures ?? null,
    });
  }

  #recording(recording, map) {
    const { values } = recording;
    setText(byId("recording-state"), recording.message);
    this.recording.set({
      "Recording for": values.state === "recording" ? this.#for(recording) : "not recording",
      "File": values.file ? values.file.split("/").at(-1) : UNKNOWN, // its name says vehicle, time and number
      "Messages": values.messages ?? UNKNOWN,
      "Disk left": figure(values.free_gb, 1, " GB"),
      "Map folder": map.folder?.split("/").at(-1) ?? UNKNOWN,
    });
  }

  /** The row of a status; made, by the parts that make() adds to those of all rows, where there is none yet. */
  #row({ name, level }, make) {
    const row = this.rows.get(name) ?? make(element("span", { className: "dot" }));
    row.dot.dataset.level = LEVELS[level];
    this.rows.set(name, row);
    return row;
  }

  #sensor(status, latency_ms) {
    const name = status.name.slice("sensor/".length), { values } = status;
    const row = this.#row(status, (dot) => {
      const swatch = element("span", { className: "swatch" }), details = new Details(COLUMNS, status.name, dot, name, swatch);
      const cells = Array.from({ length: COLUMNS - 1 }, () => element("td")), text = element("span"), manual = helpLink(status.name);
      const words = element("tr", { className: "words" }, element("td", { colSpan: COLUMNS }, text, " ", manual));
      byId("sensor-rows").append(element("tr", {}, element("td", {}, details.button), ...cells), words, details.row);
      return { dot, swatch, cells, words, text, manual, details };
    });
    row.swatch.style.background = this.colourOf(name) ?? "transparent";
    const figures = [figure(values.rate_hz, 1), figure(values.age_s, 2), fixed(latency_ms[name], 1), values.dropped ?? UNKNOWN, deviceClock(values.device_clock_s)];
    figures.forEach((text, i) => setText(row.cells[i], text));
    row.words.hidden = status.level === 0;
    explain(row.manual, status);
    setText(row.text, `${status.message} (for ${this.#for(status)})`);
    row.details.put(status, status.message, clockWords(values));
  }

  #part(status) {
    const { words, details } = this.#row(status, (dot) => {
      const made = { dot, words: element("td"), details: new Details(2, status.name, dot, status.name) };
      byId("part-rows").append(element("tr", { className: "words" }, element("td", {}, made.details.button), made.words), made.details.row);
      return made;
    });
    setText(words, status.message);
    details.put(status);
  }

  putScan(scan) {
    const details = this.rows.get(`sensor/${scan.sensor}`)?.details;
    if (details && !details.row.hidden) details.putScan(scan, () => this.colourOf(scan.sensor), this.causes);
  }
}

const clockWords = ({ device_clock_s, clock_sigma_ms }) => {
  if (!device_clock_s || !clock_sigma_ms) return "";
  const runs = Number(clock_sigma_ms) < MAX_SIGMA_MS ? "runs right" : "is being learnt";
  return `device clock: ${deviceClock(device_clock_s)}, ${runs} (\u00b1 ${figure(clock_sigma_ms, 1, " ms")})`;
};

/** All values of a sensor or a part, in a row of its own below it, while its name is pressed. */
class Details {
  text = "";

  constructor(columns, status, ...name) {
    this.button = element("button", { type: "button", className: "name", "aria-expanded": "false", onclick: () => this.#toggle() }, ...name);
    this.words = element("p");
    this.manual = helpLink(status);
    this.row = element("tr", { className: "words details", hidden: true }, element("td", { colSpan: columns }, this.words, this.manual));
  }

  put(status, ...first) {
    explain(this.manual, status);
    const values = Object.entries(status.values).filter(([, text]) => text !== "").map(([key, text]) => `${key}: ${text}`);
    this.text = [...first, ...values].filter(Boolean).join("\n");
    if (!this.row.hidden) setText(this.words, this.text);
  }

  putScan(scan, colourOf, causes) {
    if (!this.polar) {
      this.polar = new PolarView(colourOf, causes);
      this.words.before(this.polar.node, this.polar.returns, this.polar.legend);
    }
    this.polar.put(scan);
  }

  #toggle() {
    this.row.hidden = !this.row.hidden;
    this.button.setAttribute("aria-expanded", String(!this.row.hidden));
    setText(this.words, this.text || "Nothing more is known.");
  }
}
