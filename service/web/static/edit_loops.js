// Loops of a stored map or of a running session: what each rests on, its two places, and what a person decides of it.

import { button, byId, element, note, row, setText } from "./dom.js";
import { fixed } from "./format.js";

const SHOWN = 50; // of each kind
const KINDS = {
  accepted: { label: "Accepted loops", heading: "Accepted, the largest residual first", rank: ({ off_mm }) => -off_mm },
  refused: { label: "Loops not accepted", heading: "Not accepted, the best agreement first", rank: ({ on_map }) => -on_map },
};

export class EditLoops {
  isPressed = false; // what is pressed must not be moved away
  waiting = null; // to be shown when it is released

  constructor(edit) {
    this.edit = edit;
    this.parts = Object.entries(KINDS).map(([kind, { label, heading, rank }]) => {
      const list = element("ul", { className: "stored loops", tabIndex: 0, "aria-label": label });
      return { kind, rank, list, node: element("div", {}, element("h3", {}, heading), list), entries: new Map() };
    });
    byId("loops").append(...this.parts.map(({ node }) => node));
    byId("loops").addEventListener("pointerdown", () => { this.isPressed = true; });
    for (const end of ["pointerup", "pointercancel"]) window.addEventListener(end, () => setTimeout(() => this.#release())); // behind the click
    this.put();
  }

  put(loops = {}) {
    if (this.isPressed) {
      this.waiting = loops;
      return;
    }
    const [accepted, refused] = this.parts.map((part) => this.#show(part, loops[part.kind] ?? []));
    byId("loops").hidden = accepted + refused === 0;
    setText(byId("loop-count"), `${accepted} accepted, ${refused} not`);
  }

  #release() {
    this.isPressed = false;
    if (this.waiting) this.put(this.waiting);
    this.waiting = null;
  }

  /** Entries stay where their loops do: a list that comes every 2 s must not take the focus away. Returns how many there are. */
  #show({ node, list, rank, entries }, loops) {
    const before = [...entries.keys()].join(), known = new Map(entries), focused = document.activeElement;
    node.hidden = loops.length === 0;
    entries.clear();
    for (const loop of loops.toSorted((a, b) => rank(a) - rank(b)).slice(0, SHOWN)) {
      const key = JSON.stringify([loop.stamps_ns, loop.loop]), entry = known.get(key) ?? this.#entry();
      entry.put(loop);
      entries.set(key, entry);
    }
    if ([...entries.keys()].join() !== before) {
      list.replaceChildren(...[...entries.values()].map((entry) => entry.node));
      if (focused !== document.activeElement && list.contains(focused)) focused.focus({ preventScroll: true });
    }
    return loops.length;
  }

  #entry() {
    const name = element("p", { className: "stored-name" }), words = note();
    const show = button("Show", () => this.#showPlaces(entry.loop));
    const decide = button("", () => (entry.loop.why ? this.#accept(entry.loop) : this.#refuse(entry.loop)));
    const entry = { node: element("li", {}, name, words, row(show, decide)), put: (loop) => {
      entry.loop = loop;
      setText(name, loop.why ?? nameOf(loop).replace("l", "L"));
      setText(words, evidence(loop));
      setText(decide, loop.why ? "Accept\u2026" : "Refuse\u2026");
      for (const one of [show, decide]) one.setAttribute("aria-label", `${one.textContent} ${nameOf(loop)}`); // there are many
    } };
    return entry;
  }

  async #showPlaces(loop) {
    const keyframes = await this.edit.keyframesOf(loop), { a, b } = this.edit.pairs.places;
    if (!keyframes) return;
    await Promise.all([a.choose(keyframes[0]), b.choose(keyframes[1])]);
    b.show();
  }

  #refuse(loop) {
    const question = [`Refuse ${nameOf(loop)}?`, `${evidence(loop)}. The map is solved without it; Undo takes that back.`, "Refuse"];
    this.edit.change({ what: "refuse-loop", ...(this.edit.isLive ? { stamps_ns: loop.stamps_ns } : { loop: loop.loop }) }, "Refuse loop", question);
  }

  #accept({ stamps_ns, pairs, keyframes, ...loop }) {
    const words = `It was refused: ${loop.why}. ${evidence(loop)}. It holds as two pairs of points, and the map is solved with them; Undo takes that back.`;
    this.edit.change(this.edit.isLive ? { what: "accept-loop", stamps_ns }
      : { what: "add-pair", pairs: pairs.map((points) => ({ points, places: keyframes.map((keyframe) => ({ keyframe })) })) }, "Accept loop", ["Accept this loop?", words, "Accept"]);
  }
}

const nameOf = ({ loop, back_at_s }) => (loop === undefined ? `loop at ${fixed(back_at_s, 0, " s")}` : `loop ${loop}`);

const evidence = ({ x_m, y_m, from_s, back_at_s, way_m, points, on_map, in_free, off_mm, off_deg, sigma_mm, sigma_deg }) => [
  `Driven at ${fixed(from_s, 0, " s")} and, ${fixed(way_m, 0, " m")} of path later, at ${fixed(back_at_s, 0, " s")}, at x ${fixed(x_m, 1)}, y ${fixed(y_m, 1, " m")}`,
  `${fixed(100 * on_map, 0, " %")} of ${points || "the"} points on walls${in_free === null ? "" : `, ${fixed(100 * in_free, 0, " %")} in free space`}`,
  `residual ${fixed(off_mm, 1, " mm")}, ${fixed(off_deg, 2, "\u00b0")}`,
  ...(sigma_mm === undefined ? [] : [`sigma ${fixed(sigma_mm, 0, " mm")}, ${fixed(sigma_deg, 2, "\u00b0")}`])].join("; ");
