// A laser's newest scan as the laser sees it: forward is up; beams without a return are ticks at the rim.

import { fixed } from "./format.js";
import { niceLength } from "./map_view.js";
import { RANGE_STEP_M } from "./protocol.js";
import { colour, Drawing } from "./series.js";

const RINGS = 4, MARGIN = 12; // pixels
const NO_RETURN = 0; // in a message, see protocol.py

/** How many beams returned, and how far; lengths in m, null where none did. */
const returnsOf = ({ ranges }) => {
  const found = Array.from(ranges).filter((steps) => steps !== NO_RETURN);
  const far = found.reduce((most, steps) => Math.max(most, steps), 0), near = found.reduce((least, steps) => Math.min(least, steps), Infinity);
  return { beams: ranges.length, returns: found.length, nearest_m: found.length ? near * RANGE_STEP_M : null, farthest_m: found.length ? far * RANGE_STEP_M : null };
};

export class PolarView extends Drawing {
  /** colourOf(): of the laser, as on the map. */
  constructor(colourOf) {
    super("polar", (...sheet) => this.#draw(...sheet));
    this.colourOf = colourOf;
    this.scan = null;
  }

  put(scan) {
    this.scan = scan;
    this.draw();
  }

  get words() {
    const { beams, returns, nearest_m, farthest_m } = returnsOf(this.scan);
    return `${beams} beams: ${returns} returns, ${fixed(nearest_m, 2)} to ${fixed(farthest_m, 2, " m")}; ${beams - returns} without a return`;
  }

  #draw(context, width, height) {
    if (!this.scan) return;
    const { first_angle_rad, angle_step_rad, ranges } = this.scan, { farthest_m } = returnsOf(this.scan);
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
    context.strokeStyle = colour("--warn");
    context.beginPath();
    ranges.forEach((steps, i) => {
      const angle_rad = first_angle_rad + i * angle_step_rad;
      if (steps === NO_RETURN) {
        context.moveTo(...at(angle_rad, radius + 3));
        context.lineTo(...at(angle_rad, radius + 9));
      } else {
        const [sx, sy] = at(angle_rad, (radius * steps * RANGE_STEP_M) / rim_m);
        context.fillRect(sx - 1, sy - 1, 2, 2);
      }
    });
    context.stroke();
    this.node.setAttribute("aria-label", `Newest scan, forward is up. ${this.words}`);
  }
}
