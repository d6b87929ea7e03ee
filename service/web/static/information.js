// The area Information: how things stand, in words and figures.

import { card, element, Facts, setText } from "./dom.js";
import { eventLines } from "./events.js";
import { deviationsInMap, wrapAngle } from "./geometry.js";
import { explain, helpLink } from "./help_links.js";
import { PolarView } from "./polar.js";
import { clockTime, degrees, deviceClock, duration, figure, fixed } from "./format.js";

export const LEVELS = ["ok", "warn", "error", "error"]; // of diagnostic_msgs/DiagnosticStatus
const COLUMNS = [["Sensor", ""], ["Hz", "frames a second"], ["Age s", "since the newest frame"],
  ["Delay ms", "from the measurement to its arrival"], ["Dropped", "scans not mapped: they had waited too long"],
  ["Clock", "what the device's clock says: time since power-up, or since it last began at 0, or the year it was set to"]];
const MAX_EVENTS = 60;
const MAX_SIGMA_MS = 5; // of a clock that is known

/** Whether a vehicle of its own is shown: a stored map has none, a fleet has several. */
export const hasOwnPose = ({ statuses }) => !["stored", "fleet"].includes(statuses.find(({ name }) => name === "mapping")?.values.state);

export class Information {
  constructor(root, colourOf) {
    this.colourOf = colourOf;
    this.stamp_s = null; // of the newest health, Unix time
    this.causes = []; // why a beam has no return, in words
    this.old = element("p", { id: "information-old", role: "status", hidden: true });
    this.isPast = false; // whether moments of a recording are shown
    this.mapping = card("Mapping");
    this.words = element("p", { className: "note below" }); // below what must not move when they get longer
    this.pose = new Facts();
    const inOrder = ["x", "y", "Heading", "Speed", "Agreement with the map", "Scans mapped a second"];
    this.pose.set(Object.fromEntries(inOrder.map((name) => [name, "\u2013"])));
    this.manual = helpLink("mapping");
    this.manual.hidden = true; // while all is well
    this.mapping.node.append(this.pose.node, this.words, this.manual);
    this.sensors = card("Sensors");
    this.rows = element("tbody");
    const heads = COLUMNS.map(([text, title]) => element("th", { scope: "col", title }, text));
    this.sensors.node.append(element("table", {}, element("thead", {}, element("tr", {}, ...heads)), this.rows));
    this.sensorRows = new Map();
    this.recording = card("Recording and disk");
    this.recordingFacts = new Facts("wrapped");
    this.recording.node.append(this.recordingFacts.node);
    this.parts = new Map(); // rows by their names
    this.partRows = element("tbody");
    const partsCard = card("Parts of the service", element("table", {}, this.partRows));
    this.events = card("Events");
    this.heard = []; // {stamp_s, text}, as they came
    this.eventList = element("ul", { className: "events", tabIndex: 0, "aria-label": "Events, the newest first" }); // it scrolls
    this.events.node.append(this.eventList);
    root.append(this.old, ...[this.mapping, this.sensors, this.recording, partsCard, this.events].map((c) => c.node));
  }

  /** The connection is lost: figures that stand still look like those of now. */
  putLost() {
    this.old.hidden = this.stamp_s === null;
    if (this.stamp_s !== null) setText(this.old, `No connection. All of this is of ${clockTime(this.stamp_s)}.`);
  }

  /** Another run of the service: nothing is known of it yet. */
  clear() {
    this.stamp_s = null;
    this.old.hidden = true;
    for (const facts of [this.pose, this.recordingFacts]) facts.clear();
    for (const node of [this.words, this.mapping.aside, this.sensors.aside, this.recording.aside]) setText(node, "");
    for (const list of [this.rows, this.partRows]) list.replaceChildren();
    this.putEvents([]);
    this.sensorRows.clear();
    this.parts.clear();
  }

  /** null: none is known. */
  putPose(pose) {
    if (!pose) {
      this.pose.set(Object.fromEntries(["x", "y", "Heading", "Speed"].map((name) => [name, "\u2013"])));
      return;
    }
    const { x_std_m, y_std_m, theta_std_rad } = deviationsInMap(pose);
    this.pose.set({
      "x": `${fixed(pose.x_m, 3, " m")} \u00b1 ${fixed(100 * x_std_m, 1, " cm")}`,
      "y": `${fixed(pose.y_m, 3, " m")} \u00b1 ${fixed(100 * y_std_m, 1, " cm")}`,
      "Heading": `${degrees(wrapAngle(pose.theta_rad))} \u00b1 ${degrees(theta_std_rad, 2)}`,
      "Speed": `${fixed(pose.twist[0], 2, " m/s")}, ${degrees(pose.twist[2])}/s`,
    });
  }

  putHealth(health) {
    this.stamp_s = health.stamp_s;
    this.old.hidden = true;
    const byName = new Map(health.statuses.map((status) => [status.name, status]));
    this.#mapping(byName.get("mapping"), health.stamp_s);
    this.#sensors(health);
    this.#recording(byName.get("recording"), byName.get("map"), health.stamp_s);
    this.#parts(health.statuses);
    // A replay, a stored map and a fleet have no devices.
    const hasPose = hasOwnPose(health), hasDevices = hasPose && !byName.has("replay");
    for (const { node } of [this.sensors, this.recording, this.events]) node.hidden = !hasDevices;
    this.pose.node.hidden = this.mapping.aside.hidden = !hasPose;
  }

  /** A moment of the past: what had happened by then. */
  putMoment({ events }) {
    this.isPast = true;
    const newest = events.at(-1)?.stamp_s ?? null;
    if (this.heard.length > 0 && newest === this.newestEvent_s) return;
    this.newestEvent_s = newest;
    this.putEvents(events);
  }

  putEvent(event) {
    this.putEvents([...this.heard, event]);
  }

  /** All of them, as they came. */
  putEvents(events) {
    this.heard = events.slice(-MAX_EVENTS);
    this.eventList.replaceChildren(...eventLines(this.heard).reverse().map(({ stamp_s, words }) =>
      element("li", {}, element("time", {}, clockTime(stamp_s)), element("span", {}, words))));
  }

  #mapping(mapping, now_s) {
    if (!mapping) return;
    const { values } = mapping, isLive = "scan_rate_hz" in values;
    setText(this.mapping.aside, `for ${duration(now_s - mapping.since_s)}`);
    this.manual.hidden = mapping.level === 0;
    explain(this.manual, mapping);
    setText(this.words, mapping.message === "ok" ? "Everything is well." : mapping.message);
    this.pose.set({
      "Agreement with the map": figure(values.inlier_ratio && 100 * values.inlier_ratio, 0, " %"),
      "Scans mapped": isLive ? null : values.scans ?? null, // of a replay, which has no rate of its own
      "Scans mapped a second": isLive ? figure(values.scan_rate_hz, 1) : null,
      "Scans not mapped": isLive ? values.scans_dropped ?? "\u2013" : null,
      "Processor a scan, median": isLive ? figure(values.scan_cpu_ms_p50, 1, " ms") : null,
      "Loops closed": values.loop_closures ?? null,
    });
  }

  /** Drawn while the data of its laser are shown. */
  putScan(scan) {
    const details = this.sensorRows.get(scan.sensor)?.details;
    if (!details || details.row.hidden) return;
    if (!details.polar) {
      details.polar = new PolarView(() => this.colourOf(scan.sensor), this.causes);
      details.returns = element("p", { className: "returns" });
      details.words.before(details.polar.node, details.returns, details.polar.legend);
    }
    details.polar.put(scan);
    setText(details.returns, details.polar.words);
  }

  #sensors(health) {
    const sensors = health.statuses.filter((status) => status.name.startsWith("sensor/"));
    let streaming = 0;
    for (const status of sensors) {
      const name = status.name.slice("sensor/".length), level = LEVELS[status.level];
      streaming += status.level === 0;
      const row = this.#sensorRow(name);
      row.dot.dataset.level = level;
      row.swatch.style.background = this.colourOf(name) ?? "transparent";
      const { values } = status;
      const figures = [figure(values.rate_hz, 1), figure(values.age_s, 2), fixed(health.latency_ms[name], 1),
        values.dropped ?? "\u2013", deviceClock(values.device_clock_s)];
      figures.forEach((text, i) => setText(row.cells[i], text));
      row.words.hidden = status.level === 0;
      explain(row.manual, status);
      setText(row.text, `${status.message} (for ${duration(health.stamp_s - status.since_s)})`);
      row.details.put([status.message, clockWords(values)].filter(Boolean).join("\n"), status);
    }
    setText(this.sensors.aside, `${streaming} of ${sensors.length} well`);
  }

  #sensorRow(name) {
    let row = this.sensorRows.get(name);
    if (!row) {
      const dot = element("span", { className: "dot" }), swatch = element("span", { className: "swatch" });
      const details = new Details(COLUMNS.length, `sensor/${name}`, dot, name, swatch);
      const cells = COLUMNS.slice(1).map(() => element("td"));
      const text = element("span"), manual = helpLink(`sensor/${name}`);
      const words = element("tr", { className: "words", hidden: true }, element("td", { colSpan: COLUMNS.length }, text, " ", manual));
      this.rows.append(element("tr", {}, element("td", {}, details.button), ...cells), words, details.row);
      row = { dot, swatch, cells, words, text, manual, details };
      this.sensorRows.set(name, row);
    }
    return row;
  }

  #recording(recording, map, now_s) {
    if (!recording) return;
    const { values } = recording;
    const isOn = values.state === "recording";
    setText(this.recording.aside, recording.message);
    this.recordingFacts.set({
      "Recording for": isOn ? duration(now_s - recording.since_s) : "not recording",
      "File": values.file ? values.file.split("/").at(-1) : "\u2013", // its name says vehicle, time and number
      "Messages": values.messages ?? "\u2013",
      "Disk left": figure(values.free_gb, 1, " GB"),
      "Map folder": map?.values.folder.split("/").at(-1) ?? "\u2013",
    });
  }

  #parts(statuses) {
    const parts = statuses.filter((status) => !status.name.startsWith("sensor/"));
    for (const status of parts) {
      const row = this.parts.get(status.name) ?? this.#partRow(status.name);
      row.dot.dataset.level = LEVELS[status.level];
      setText(row.words, status.message);
      row.details.put("", status);
    }
  }

  #partRow(name) {
    const dot = element("span", { className: "dot" }), words = element("td"), details = new Details(2, name, dot, name);
    this.partRows.append(element("tr", { className: "words" }, element("td", {}, details.button), words), details.row);
    this.parts.set(name, { dot, words, details });
    return this.parts.get(name);
  }
}

/** Whether a device's clock can be relied on. */
const clockWords = ({ device_clock_s, clock_sigma_ms }) => {
  if (!device_clock_s || !clock_sigma_ms) return "";
  const runs = Number(clock_sigma_ms) < MAX_SIGMA_MS ? "runs right" : "is being learnt";
  return `device clock: ${deviceClock(device_clock_s)}, ${runs} (\u00b1 ${figure(clock_sigma_ms, 1, " ms")})`;
};

/** All values of a sensor or a part, in a row of its own below it, while its name is pressed. */
class Details {
  constructor(columns, status, ...name) {
    this.text = "";
    this.button = element("button", { type: "button", className: "name", "aria-expanded": "false", onclick: () => this.#toggle() }, ...name);
    this.words = element("p");
    this.manual = helpLink(status);
    this.row = element("tr", { className: "words details", hidden: true }, element("td", { colSpan: columns }, this.words, this.manual));
  }

  put(message, status) {
    explain(this.manual, status);
    this.text = [message, ...Object.entries(status.values).filter(([, text]) => text !== "").map(([key, text]) => `${key}: ${text}`)].filter(Boolean).join("\n");
    if (!this.row.hidden) setText(this.words, this.text);
  }

  #toggle() {
    this.row.hidden = !this.row.hidden;
    this.button.setAttribute("aria-expanded", String(!this.row.hidden));
    setText(this.words, this.text || "Nothing more is known.");
  }
}
