// Manual optimisation: points of two places that are one, what is left between them, and the solution.

import { FONT, square, strokeLine } from "./canvas.js";
import { button, byId, confirmed, element, note, onClick, row, setPressed, setRefused, setText } from "./dom.js";
import { PairTool } from "./edit_tools.js";
import { counted, fixed } from "./format.js";
import { distance } from "./geometry.js";
import { PlacePane, PlacePicker } from "./places.js";

const MAX_PAIRS = 100; // in one change; the service refuses more
const FAR_M = 0.5; // apart, more than a search for loops without drift errs by: then the person is asked

export class EditPairs {
  pairs = []; // not yet in the map: {points: [of A, of B], places: of each {keyframe, stamp_ns, pose}}
  stored = []; // of the map, as map_look tells them
  passes = []; // that could be joined, as map_look tells them
  shownInPane = null; // pose of place B

  constructor(edit) {
    this.edit = edit;
    this.places = Object.fromEntries(["a", "b"].map((side) => [side, new PlacePicker(side, edit, () => this.#placeChanged())]));
    this.pane = new PlacePane(byId("pane"), edit.view, () => this.#tool, (...drawing) => this.#drawPane(...drawing));
    const acts = { "other-pass": () => this.#otherPass(), "pick-pairs": () => this.#pickPoints(), "side-by-side": () => this.#sideBySide(),
      "forget-places": () => this.clear(), optimise: () => this.#optimise() };
    for (const [id, act] of Object.entries(acts)) onClick(id, act);
  }

  get #tool() {
    return this.edit.tool instanceof PairTool ? this.edit.tool : null;
  }

  /** Pairs, passes that could be joined, and key frames of the map as it is now. */
  put(pairs, passes) {
    [this.stored, this.passes] = [pairs, passes];
    for (const place of Object.values(this.places)) {
      if (place.isChosen && place.keyframe < this.edit.keyframes.count) place.choose(place.keyframe);
      else place.clear();
    }
    this.update();
  }

  clear() {
    this.pairs = [];
    this.edit.endTool();
    for (const place of Object.values(this.places)) place.clear();
    this.#changed();
  }

  #changed() {
    this.update();
    this.edit.view.invalidate();
  }

  update() {
    const { a, b } = this.places, areTwo = a.isChosen && b.isChosen, needsTwo = areTwo ? "" : "Choose place A and place B first";
    a.update();
    b.update();
    setRefused(byId("other-pass"), a.isChosen ? "" : "Choose place A first");
    setRefused(byId("pick-pairs"), needsTwo || (a.keyframe === b.keyframe ? "Place A and place B are one key frame: choose another" : ""));
    setPressed(byId("pick-pairs"), this.#tool !== null);
    setRefused(byId("side-by-side"), needsTwo);
    if (!areTwo && this.pane.isOpen) this.pane.split(false);
    setPressed(byId("side-by-side"), this.pane.isOpen);
    setRefused(byId("forget-places"), a.isChosen || b.isChosen || this.pairs.length ? "" : "Nothing is chosen");
    setText(byId("optimise"), this.pairs.length ? `Optimise with ${this.pairs.length} new` : "Optimise");
    const total = this.stored.length + this.pairs.length;
    setText(byId("pair-count"), total ? counted(total, "pair") : "");
    byId("passes").hidden = this.passes.length === 0;
    byId("passes").replaceChildren(...this.passes.map((pass) => this.#proposal(pass)));
    byId("pairs").replaceChildren(
      ...this.stored.map(({ pair, apart_mm }) => entry(`Pair ${pair}`, apart_mm / 1000, () => this.edit.change({ what: "remove-pair", pair }, "Remove pair"))),
      ...this.pairs.map((pair, i) => entry(newName(i), apart_m(pair), () => { this.pairs.splice(i, 1); this.#changed(); })));
  }

  /** What was aligned and not accepted, with the points that would join it. */
  #proposal(pass) {
    const { apart_m: off_m, apart_deg, on_map, x_m, y_m, why } = pass;
    const [a, b] = pass.keyframes.map((k) => fixed(this.edit.keyframes.seconds(k), 0, " s")), where = `x ${fixed(x_m, 1)}, y ${fixed(y_m, 1, " m")}`;
    const propose = button("Propose points", () => this.#propose(pass), { "aria-label": `Propose points at ${where}` });
    setRefused(propose, this.pairs.some((pair) => pair.pass === pass) ? "Its points are in the list below" : "");
    return element("li", { className: "pass" }, element("p", { className: "stored-name" }, `Two passes ${fixed(off_m, 2, " m")} and ${fixed(apart_deg, 1)}\u00b0 apart at ${where}`),
      note(`Driven at ${a} and ${b}; aligned, ${fixed(100 * on_map, 0, " %")} of the later points fit. Not joined by itself: ${why}.`), row(propose));
  }

  async #propose(pass) {
    const { a, b } = this.places, [of, to] = pass.keyframes;
    await Promise.all([a.choose(of), b.choose(to)]);
    if (a.keyframe !== of || b.keyframe !== to || !this.passes.includes(pass)) return;
    for (const points of pass.points.slice(0, MAX_PAIRS - this.pairs.length)) this.pairs.push({ pass, points, places: [a.as(), b.as()] });
    b.show();
    this.update();
  }

  #placeChanged() {
    const { pose } = this.places.b;
    this.#tool?.back();
    if (this.pane.isOpen && pose && pose !== this.shownInPane) {
      this.shownInPane = pose;
      this.pane.show(pose);
    }
    this.#changed();
  }

  #otherPass() {
    const k = this.edit.keyframes.otherPass(this.places.a.keyframe);
    if (k === null) this.edit.say("No other pass: the path is shorter than 10 m", "error");
    else this.places.b.choose(k);
  }

  #pickPoints() {
    if (this.#tool) {
      this.edit.endTool();
      return;
    }
    const { places, pane } = this;
    const tool = new PairTool(this.edit.view, { places, pane, picked: (...points) => {
      if (this.pairs.length >= MAX_PAIRS) tool.note = `${MAX_PAIRS} new pairs at most; optimise first.`;
      else this.pairs.push({ points, places: [places.a.as(), places.b.as()] });
      this.update();
    } });
    this.edit.beginTool(tool);
  }

  #sideBySide() {
    const { a, b } = this.places;
    if (this.pane.isOpen) this.closePane();
    else if (a.pose && b.pose) {
      this.pane.open(a.pose, b.pose);
      this.shownInPane = b.pose;
      if (this.#tool) this.edit.beginTool(this.#tool); // the focus goes to the map
      else this.#pickPoints();
    }
    this.update();
  }

  closePane() {
    this.pane.split(false);
    this.#tool?.back();
    this.update();
  }

  async #optimise() {
    const far = this.pairs.flatMap((pair, i) => (apart_m(pair) > FAR_M ? [`${newName(i)}: ${fixed(apart_m(pair), 3, " m")}`] : []));
    if (far.length && !await confirmed("Join points that are far apart?",
      `In the map as it is they are farther apart than ${FAR_M} m: ${far.join(", ")}. If they are one place, the map is bent by as much; if not, it is spoilt. Undo takes it back.`, "Optimise")) return;
    const { pairs } = this;
    this.pairs = [];
    if (!await this.edit.change(pairs.length ? { what: "add-pair", pairs } : { what: "optimize" }, "Optimise")) this.pairs = pairs; // to be corrected, not picked again
    this.#changed();
  }

  draw(context, camera, colours) {
    const { a, b } = this.places;
    this.pane.invalidate();
    if (!a.isChosen && !b.isChosen && !this.pairs.length) return;
    a.draw(context, camera, colours.places.a);
    if (!this.pane.isOpen) b.draw(context, camera, colours.places.b);
    this.#drawLinks(context, camera, colours);
  }

  #drawPane(context, camera, colours) {
    this.places.b.draw(context, camera, colours.places.b);
    this.#drawLinks(context, camera, colours);
    this.#tool?.drawOf(["b"], context, camera, colours);
  }

  #drawLinks(context, camera, { measure }) {
    const link = (points, name, dash) => {
      const ends = points.map((point) => camera.toScreen(...point)), [x, y] = ends[1];
      context.setLineDash(dash);
      strokeLine(context, ...ends);
      for (const end of ends) square(context, end, 6);
      context.fillText(name, x + 6, y + 14);
    };
    context.strokeStyle = context.fillStyle = measure;
    context.lineWidth = 2;
    context.font = `12px ${FONT}`;
    for (const { pair, x_m, y_m, other_x_m, other_y_m } of this.stored) link([[x_m, y_m], [other_x_m, other_y_m]], String(pair), [3, 3]);
    this.pairs.forEach(({ points }, i) => link(points, newName(i), []));
    context.setLineDash([]);
  }
}

const newName = (i) => `New ${i + 1}`;

const apart_m = ({ points }) => distance(...points);

const entry = (name, residual_m, remove) => element("li", { className: "pair" }, element("span", { className: "stored-name" }, name),
  element("span", { className: "note" }, `${fixed(residual_m, 3, " m")} apart`), button("Remove", remove, { "aria-label": `Remove ${name}` }));
