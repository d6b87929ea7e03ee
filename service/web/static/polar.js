// A laser's newest scan as the laser sees it: forward is up; beams without a return are ticks at the rim, in the colour
// of what the device says of them.

import { element, swatched } from "./dom.js";
import { fixed } from "./format.js";
import { niceLength } from "./map_view.js";
import { RANGE_STEP_M } from "./protocol.js";
import { colour, Drawing } from "./series.js";

const RINGS = 4, MARGIN = 12; // pixels
const NO_RETURN = 0; // in a message, see protocol.py

const CAUSE_COLOURS = ["--warn", "--error", "--laser-4", "--laser-3", "--laser-2", "--laser-1", "--laser-0"];

const colourOfCause = (cause) => colour(CAUSE_COLOURS[cause % CAUSE_COLOURS.length]);

/** How many beams returned, and how far; lengths in m, null where none did. */
const returnsOf = ({ ranges }) => {
  const found = Array.from(ranges).filter((steps) => steps !== NO_RETURN);
  const far = found.reduce((most, steps) => Math.max(most, steps), 0), near = found.reduce((least, steps) => Math.min(least, steps), Infinity);
  return { beams: ranges.length, returns: found.length, nearest_m: found.length ? near * RANGE_STEP_M : null, farthest_m: found.length ? far * RANGE_STEP_M : null };
};

export class PolarView extends Drawing {
  /** colourOf(): of the laser, as on the map; causes: why a beam has no return, in words. */
  constructor(colourOf, causes) {
    super("polar", (...sheet) => this.#draw(...sheet));
    this.colourOf = colourOf;
    this.causes = causes;
    this.legend = element("p", { className: "key" });
    this.scan = null;
  }

  put(scan) {
    this.scan = scan;
    const counts = new Map();
    scan.causes.forEach((cause, i) => { if (scan.ranges[i] === NO_RETURN) counts.set(cause, (counts.get(cause) ?? 0) + 1); });
    this.legend.replaceChildren(...[...counts].sort(([a], [b]) => a - b)
      .map(([cause, count]) => swatched(`${this.causes[cause] ?? "no return"}: ${count}`, colourOfCause(cause), "cause")));
    this.draw();
  }

  get words() {
    const { beams, returns, nearest_m, farthest_m } = returnsOf(this.scan);
    return `${beams} beams: ${returns} returns, ${fixed(nearest_m, 2)} to ${fixed(farthest_m, 2, " m")}; ${beams - returns} without a return`;
  }

  #draw(context, width, height) {
    if (!this.scan) return;
    const colours = CAUSE_COLOURS.map(colour);
    const { first_angle_rad, angle_step_rad, ranges, causes } = this.scan, { farthest_m } = returnsOf(this.scan);
    const rim_m = RINGS * niceLength(Math.max(farthest_m ?? 1, 0.1) / RINGS), radius = Math.min(width, height) / 2 - MARGIN;
    const [x, y] = [width / 2, height / 2];
    const at = (angle_rad, pixels) => [x - pixels * Math.sin(angle_rad), y - pixels * Math.cos(angle_rad)];
    context.strokeStyle = colour("--line");
    context.fillStyle = colour("--text-2");
    for (let ring = 1; ring <= RINGS; ring += 1) {
      context.beginPath();
      context.arc(x, y, (radius * ring) / RINGS, 0, 2 * Math.PI);
      context.stroke();
      context.fillText(`${Number(((rim_m * ring) / RINGS).toFixed(2))} m`, x + 3, y + (radius * ring) / RINGS - 3);
    }
    context.fillStyle = this.colourOf() ?? colour("--text");
    ranges.forEach((steps, i) => {
      const angle_rad = first_angle_rad + i * angle_step_rad;
      if (steps === NO_RETURN) {
        context.strokeStyle = colours[causes[i] % colours.length];
        context.beginPath();
        context.moveTo(...at(angle_rad, radius + 3));
        context.lineTo(...at(angle_rad, radius + 9));
        context.stroke();
      } else {
        const [sx, sy] = at(angle_rad, (radius * steps * RANGE_STEP_M) / rim_m);
        context.fillRect(sx - 1, sy - 1, 2, 2);
      }
    });
    this.node.setAttribute("aria-label", `Newest scan, forward is up. ${this.words}`);
  }
}
