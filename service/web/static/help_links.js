// Which page of the manual explains a status of health.

import { element } from "./dom.js";

export const PAGES = {
  mapping: "mapping.md#state", sensor: "doctor.md", recording: "recording.md", map: "maps.md", zenoh: "subscribing.md", ros2: "ros2.md",
  fleet: "fleet.md", foxglove: "operator.md#foxglove-and-lichtblick", web: "operator.md#faults", clock: "operations.md#time",
  commands: "commands.md", gnss: "gnss.md", timing: "importing.md#recordings-whose-times-are-wrong", replay: "operator.md#replays", tiles: "maps.md",
};

/** Address of the page for a status, by its name; all others are listed in one table. */
export const helpAddress = (status) => `/help/${PAGES[status.split("/")[0]] ?? "operations.md#health"}`;

/** Opens apart: the map stays as it is. */
export const helpLink = (status) => element("a", { href: helpAddress(status), target: "_blank", className: "help", "aria-label": `Manual: ${status}` }, "Manual");
