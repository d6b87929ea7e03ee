// Loops of a stored map: what each rests on, its two places on the map, and what a person decides of it.

import { card, confirmed, element, setText } from "./dom.js";
import { fixed } from "./format.js";

const SHOWN = 50; // of each kind
const KINDS = {
  accepted: { label: "Accepted loops", heading: "Accepted, the largest residual first", rank: ({ off_mm }) => -off_mm },
  refused: { label: "Loops not accepted", heading: "Not accepted, the best agreement first", rank: ({ on_map }) => -on_map },
};

export class EditLoops {
  /** edit: of the area Edit. */
  constructor(edit) {
    this.edit = edit;
    this.card = card("Loops", element("p", { className: "note" }, "Show draws what both places saw, each in its colour. Walls must coincide."));
    this.parts = Object.entries(KINDS).map(([kind, { label, heading, rank }]) => {
      const list = element("ul", { className: "stored loops", tabIndex: 0, "aria-label": label });
      const part = element("div", {}, element("h3", {}, heading), list);
      this.card.node.append(part);
      return { kind, rank, list, part };
    });
  }

  put(loops = { accepted: [], refused: [] }) {
    this.card.node.hidden = loops.accepted.length + loops.refused.length === 0;
    setText(this.card.aside, `${loops.accepted.length} accepted, ${loops.refused.length} not`);
    for (const { kind, rank, list, part } of this.parts) {
      part.hidden = loops[kind].length === 0;
      list.replaceChildren(...loops[kind].toSorted((a, b) => rank(a) - rank(b)).slice(0, SHOWN).map((loop) => this.#entry(loop)));
    }
  }

  #entry(loop) {
    const isAccepted = "loop" in loop;
    return element("li", {}, element("p", { className: "stored-name" }, isAccepted ? `Loop ${loop.loop}` : loop.why),
      element("p", { className: "note" }, evidence(loop)),
      element("div", { className: "row" }, element("button", { type: "button", onclick: () => this.show(loop) }, "Show"),
        element("button", { type: "button", onclick: () => (isAccepted ? this.#refuse(loop) : this.#accept(loop)) }, isAccepted ? "Refuse\u2026" : "Accept\u2026")));
  }

  /** Both places with the points that they saw. */
  async show({ keyframes: [first, second] }) {
    const { a, b } = this.edit.pairs.places;
    await Promise.all([a.choose(first), b.choose(second)]);
    b.show();
  }

  async #refuse(loop) {
    const isSure = await confirmed(`Refuse loop ${loop.loop}?`, `${evidence(loop)}. The map is solved without it; Undo takes that back.`, "Refuse");
    if (isSure) this.edit.change({ what: "refuse-loop", loop: loop.loop }, "Refuse loop");
  }

  async #accept({ pairs, keyframes, ...loop }) {
    const isSure = await confirmed("Accept this loop?", `It was refused: ${loop.why}. ${evidence(loop)}. It holds as two pairs of points, and the map is solved with them; Undo takes that back.`, "Accept");
    if (isSure) this.edit.change({ what: "add-pair", pairs: pairs.map((points) => ({ points, places: keyframes.map((keyframe) => ({ keyframe })) })) }, "Accept loop");
  }
}

const evidence = ({ x_m, y_m, from_s, back_at_s, points, on_map, in_free, off_mm, off_deg }) => [
  `${fixed(from_s, 0)} to ${fixed(back_at_s, 0, " s")} at x ${fixed(x_m, 1)}, y ${fixed(y_m, 1, " m")}`,
  `${points || "\u2013"} points, ${fixed(100 * on_map, 0, " %")} on walls${in_free === null ? "" : `, ${fixed(100 * in_free, 0, " %")} in free space`}`,
  `residual ${fixed(off_mm, 1, " mm")}, ${fixed(off_deg, 2, "\u00b0")}`].join("; ");
