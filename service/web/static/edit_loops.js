// Loops of a stored map or of a running session: what each rests on, its two places, and what a person decides of it.

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
    this.isPressed = false; // what is pressed must not be moved away
    this.waiting = null; // to be shown when it is released
    this.card = card("Loops", element("p", { className: "note" }, "Show draws what both places saw, each in its colour. Walls must coincide."));
    this.parts = Object.entries(KINDS).map(([kind, { label, heading, rank }]) => {
      const list = element("ul", { className: "stored loops", tabIndex: 0, "aria-label": label });
      const part = element("div", {}, element("h3", {}, heading), list);
      this.card.node.append(part);
      return { kind, rank, list, part, entries: new Map() };
    });
    this.card.node.addEventListener("pointerdown", () => { this.isPressed = true; });
    for (const end of ["pointerup", "pointercancel"]) window.addEventListener(end, () => setTimeout(() => this.#release())); // behind the click
    this.put();
  }

  /** loops: {accepted, refused}; without any of a map that has none. */
  put(loops = {}) {
    if (this.isPressed) {
      this.waiting = loops;
      return;
    }
    const { accepted = [], refused = [] } = loops;
    this.card.node.hidden = accepted.length + refused.length === 0;
    setText(this.card.aside, `${accepted.length} accepted, ${refused.length} not`);
    for (const part of this.parts) this.#show(part, (loops[part.kind] ?? []).toSorted((a, b) => part.rank(a) - part.rank(b)).slice(0, SHOWN));
  }

  #release() {
    this.isPressed = false;
    if (this.waiting) this.put(this.waiting);
    this.waiting = null;
  }

  /** Entries stay where their loops do: a list that comes every 2 s must not take the focus away. */
  #show(part, loops) {
    const before = part.entries, focused = document.activeElement;
    part.part.hidden = loops.length === 0;
    part.entries = new Map(loops.map((loop) => {
      const key = JSON.stringify([loop.stamps_ns, loop.loop]), entry = before.get(key) ?? this.#entry();
      entry.put(loop);
      return [key, entry];
    }));
    if ([...part.entries.keys()].join() === [...before.keys()].join()) return;
    part.list.replaceChildren(...[...part.entries.values()].map(({ node }) => node));
    if (focused !== document.activeElement && part.list.contains(focused)) focused.focus({ preventScroll: true });
  }

  #entry() {
    const name = element("p", { className: "stored-name" }), note = element("p", { className: "note" });
    const decide = element("button", { type: "button", onclick: () => this.#decide(entry.loop) });
    const show = element("button", { type: "button", onclick: () => this.show(entry.loop) }, "Show");
    const node = element("li", {}, name, note, element("div", { className: "row" }, show, decide));
    const entry = { node, put: (loop) => {
      entry.loop = loop;
      setText(name, loop.why ?? nameOf(loop).replace("l", "L"));
      setText(note, evidence(loop));
      setText(decide, loop.why ? "Accept\u2026" : "Refuse\u2026");
      for (const button of [show, decide]) button.setAttribute("aria-label", `${button.textContent} ${nameOf(loop)}`); // there are many
    } };
    return entry;
  }

  /** Both places with the points that they saw. */
  async show(loop) {
    const keyframes = await this.edit.keyframesOf(loop), { a, b } = this.edit.pairs.places;
    if (!keyframes) return;
    await Promise.all([a.choose(keyframes[0]), b.choose(keyframes[1])]);
    b.show();
  }

  #decide(loop) {
    if (loop.why) this.#accept(loop);
    else this.#refuse(loop);
  }

  async #refuse(loop) {
    const isSure = await confirmed(`Refuse ${nameOf(loop)}?`, `${evidence(loop)}. The map is solved without it; Undo takes that back.`, "Refuse");
    if (isSure) this.edit.change({ what: "refuse-loop", ...(this.edit.isLive ? { stamps_ns: loop.stamps_ns } : { loop: loop.loop }) }, "Refuse loop");
  }

  async #accept({ stamps_ns, pairs, keyframes, ...loop }) {
    const isSure = await confirmed("Accept this loop?", `It was refused: ${loop.why}. ${evidence(loop)}. It holds as two pairs of points, and the map is solved with them; Undo takes that back.`, "Accept");
    if (!isSure) return;
    this.edit.change(this.edit.isLive ? { what: "accept-loop", stamps_ns }
      : { what: "add-pair", pairs: pairs.map((points) => ({ points, places: keyframes.map((keyframe) => ({ keyframe })) })) }, "Accept loop");
  }
}

const nameOf = ({ loop, back_at_s }) => (loop === undefined ? `loop at ${fixed(back_at_s, 0, " s")}` : `loop ${loop}`);

const evidence = ({ x_m, y_m, from_s, back_at_s, way_m, points, on_map, in_free, off_mm, off_deg, sigma_mm, sigma_deg }) => [
  `Driven at ${fixed(from_s, 0, " s")} and, ${fixed(way_m, 0, " m")} of path later, at ${fixed(back_at_s, 0, " s")}, at x ${fixed(x_m, 1)}, y ${fixed(y_m, 1, " m")}`,
  `${fixed(100 * on_map, 0, " %")} of ${points || "the"} points on walls${in_free === null ? "" : `, ${fixed(100 * in_free, 0, " %")} in free space`}`,
  `residual ${fixed(off_mm, 1, " mm")}, ${fixed(off_deg, 2, "\u00b0")}`,
  ...(sigma_mm === undefined ? [] : [`sigma ${fixed(sigma_mm, 0, " mm")}, ${fixed(sigma_deg, 2, "\u00b0")}`])].join("; ");
