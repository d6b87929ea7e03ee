// Which page of the manual explains a status of health.

import { element } from "./dom.js";

export const PAGES = {
  mapping: "mapping.md#state", sensor: "doctor.md", recording: "recording.md", map: "maps.md", zenoh: "subscribing.md", ros2: "ros2.md",
  fleet: "fleet.md", foxglove: "operator.md#foxglove-and-lichtblick", web: "operator.md#faults", clock: "operations.md#time",
  commands: "commands.md", gnss: "gnss.md", timing: "importing.md#recordings-whose-times-are-wrong", replay: "operator.md#replays", tiles: "maps.md",
};

/** Address of what explains a status: its reason where it has one, else the page by its name; all others are listed in one table. */
export const helpAddress = (status, reason = "") =>
  reason ? `/help/reason/${encodeURIComponent(reason)}` : `/help/${PAGES[status.split("/")[0]] ?? "operations.md#health"}`;

/** Opens apart: the map stays as it is. */
export const helpLink = (status) => element("a", { href: helpAddress(status), target: "_blank", className: "help", "aria-label": `Manual: ${status}` }, "Manual");

/** Let a link lead to the reason why that status is not well. */
export function explain(link, { name, values }) {
  const address = helpAddress(name, values.reason_id);
  if (link.getAttribute("href") !== address) link.href = address;
}
