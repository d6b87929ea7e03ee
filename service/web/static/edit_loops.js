// Loops of a stored map: what each rests on, its two places on the map, and what a person decides of it.

import { card, confirmed, element, setText } from "./dom.js";
import { fixed } from "./format.js";

const SHOWN = 50; // of each kind, the most doubtful accepted ones and the best refused ones first

export class EditLoops {
  /** edit: of the area Edit. */
  constructor(edit) {
    this.edit = edit;
    this.loops = { accepted: [], refused: [] };
    this.card = card("Loops");
    this.lists = {
      accepted: element("ul", { className: "stored loops", tabIndex: 0, "aria-label": "Accepted loops" }),
      refused: element("ul", { className: "stored loops", tabIndex: 0, "aria-label": "Loops not accepted" }),
    };
    this.headings = { accepted: element("h3", {}, "Accepted, the largest residual first"), refused: element("h3", {}, "Not accepted, the best agreement first") };
    this.card.node.append(element("p", { className: "note" }, "Show draws what both places saw, each in its colour. Walls must coincide."),
      this.headings.accepted, this.lists.accepted, this.headings.refused, this.lists.refused);
  }

  put(loops = { accepted: [], refused: [] }) {
    this.loops = loops;
    const accepted = loops.accepted.toSorted((a, b) => b.off_mm - a.off_mm), refused = loops.refused.toSorted((a, b) => b.on_map - a.on_map);
    this.card.node.hidden = accepted.length + refused.length === 0;
    this.headings.accepted.hidden = this.lists.accepted.hidden = accepted.length === 0;
    this.headings.refused.hidden = this.lists.refused.hidden = refused.length === 0;
    setText(this.card.aside, `${accepted.length} accepted, ${refused.length} not`);
    this.lists.accepted.replaceChildren(...accepted.slice(0, SHOWN).map((loop) => this.#entry(loop, `Loop ${loop.loop}`,
      element("button", { type: "button", onclick: () => this.#refuse(loop) }, "Refuse\u2026"))));
    this.lists.refused.replaceChildren(...refused.slice(0, SHOWN).map((loop) => this.#entry(loop, loop.why,
      element("button", { type: "button", onclick: () => this.#accept(loop) }, "Accept\u2026"))));
  }

  #entry(loop, title, decide) {
    return element("li", {}, element("p", { className: "stored-name" }, title), element("p", { className: "note" }, evidence(loop)),
      element("div", { className: "row" }, element("button", { type: "button", onclick: () => this.show(loop) }, "Show"), decide));
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
