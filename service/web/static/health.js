// Health, as the service tells it: {stamp_s, latency_ms, statuses: [{name, level, message, since_s, values}]}.

import { element } from "./dom.js";

export const LEVELS = ["ok", "warn", "error", "error"]; // of diagnostic_msgs/DiagnosticStatus

export const GRAPH_PROFILE = "corridor"; // the one whose graph takes poses, modes and edits

export const statusOf = (health, name) => health?.statuses.find((status) => status.name === name);

export const valuesOf = (health, name) => statusOf(health, name)?.values ?? {};

/** Whether a vehicle of its own is shown: a stored map has none, a fleet has several. */
export const hasOwnPose = (health) => !["stored", "fleet"].includes(valuesOf(health, "mapping").state);

export const PAGES = {
  mapping: "mapping.md#state", sensor: "doctor.md", recording: "recording.md", map: "maps.md", zenoh: "subscribing.md", ros2: "ros2.md",
  fleet: "fleet.md", foxglove: "operator.md#foxglove-and-lichtblick", web: "operator.md#faults", clock: "operations.md#time",
  commands: "commands.md", gnss: "gnss.md", timing: "importing.md#recordings-whose-times-are-wrong", replay: "operator.md#replays", tiles: "maps.md",
};

/** Address of what explains a status: its reason where it has one, else the page by its name; all others are listed in one table. */
export const helpAddress = (status, reason = "") =>
  (reason ? `/help/reason/${encodeURIComponent(reason)}` : `/help/${PAGES[status.split("/")[0]] ?? "operations.md#health"}`);

/** Opens apart: the map stays as it is. */
export const helpLink = (status) => element("a", { href: helpAddress(status), target: "_blank", className: "help", "aria-label": `Manual: ${status}` }, "Manual");

export const explain = (link, { name, values }) => { link.href = helpAddress(name, values.reason_id); };
