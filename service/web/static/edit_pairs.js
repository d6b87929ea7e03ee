// Manual optimisation: points of two places that are one, what is left between them, and the solution.

import { byId, card, confirmed, element, setRefused, setText } from "./dom.js";
import { PairTool } from "./edit_tools.js";
import { fixed } from "./format.js";
import { PlacePane } from "./place_pane.js";
import { PlacePicker } from "./place_picker.js";

const MAX_PAIRS = 100; // in one change; the service refuses more
const FAR_M = 0.5; // apart, more than a search for loops without drift errs by: then the person is asked

export class EditPairs {
  /** edit: of the area Edit. */
  constructor(edit) {
    this.edit = edit;
    this.pairs = []; // not yet in the map: {points: [of A, of B], places: of each {keyframe, stamp_ns, pose}}
    this.stored = []; // of the map, as map_look tells them
    this.passes = []; // that could be joined, as map_look tells them
    this.places = {
      a: new PlacePicker("a", edit, () => this.#placeChanged()),
      b: new PlacePicker("b", edit, () => this.#placeChanged()),
    };
    this.otherPass = element("button", { type: "button", id: "other-pass", onclick: () => this.#otherPass() }, "B: other pass near A");
    this.pick = element("button", { type: "button", id: "pick-pairs", "aria-pressed": "false", onclick: () => this.#pickPoints() }, "Pick points");
    this.split = element("button", { type: "button", id: "side-by-side", "aria-pressed": "false", onclick: () => this.#sideBySide() }, "Side by side");
    this.pane = new PlacePane(byId("pane"), edit.view, () => (edit.tool instanceof PairTool ? edit.tool : null),
      (...drawing) => this.#drawPane(...drawing));
    this.shownInPane = null; // pose of place B
    this.forget = element("button", { type: "button", id: "forget-places", onclick: () => this.clear() }, "Clear");
    this.passList = element("ul", { className: "stored", id: "passes", "aria-label": "Passes that overlap and do not agree" });
    this.list = element("ul", { className: "stored", id: "pairs", "aria-label": "Pairs of points" });
    this.optimise = element("button", { type: "button", className: "primary", id: "optimise", onclick: () => this.#optimise() }, "Optimise");
    this.card = card("Join places by points");
    this.card.node.append(this.passList,
      element("p", { className: "note" },
        "Where a wall shows twice, choose a place of each pass; then click a point of A and the same one of B. Two pairs some metres apart fix a turn, too."),
      this.places.a.node, this.places.b.node,
      element("div", { className: "row" }, this.otherPass, this.pick, this.split),
      this.list, element("div", { className: "row" }, this.optimise, this.forget));
  }

  /** Pairs, passes that could be joined, and key frames of the map as it is now. */
  put(pairs, passes) {
    this.stored = pairs;
    this.passes = passes;
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
    this.update();
    this.edit.view.invalidate();
  }

  update() {
    const { a, b } = this.places, { places } = this.edit.view.colours;
    a.swatch.style.background = places.a;
    b.swatch.style.background = places.b;
    a.update();
    b.update();
    const areTwo = a.isChosen && b.isChosen, needsTwo = areTwo ? "" : "Choose place A and place B first";
    setRefused(this.otherPass, a.isChosen ? "" : "Choose place A first");
    setRefused(this.pick, needsTwo || (a.keyframe === b.keyframe ? "Place A and place B are one key frame: choose another" : ""));
    this.pick.setAttribute("aria-pressed", String(this.edit.tool instanceof PairTool));
    setRefused(this.split, needsTwo);
    if (!areTwo && this.pane.isOpen) this.pane.close();
    this.split.setAttribute("aria-pressed", String(this.pane.isOpen));
    setRefused(this.forget, a.isChosen || b.isChosen || this.pairs.length ? "" : "Nothing is chosen");
    setText(this.optimise, this.pairs.length ? `Optimise with ${this.pairs.length} new` : "Optimise");
    const total = this.stored.length + this.pairs.length;
    setText(this.card.aside, total ? `${total} ${total === 1 ? "pair" : "pairs"}` : "");
    this.passList.hidden = this.passes.length === 0;
    this.passList.replaceChildren(...this.passes.map((pass) => this.#proposal(pass)));
    this.list.replaceChildren(
      ...this.stored.map((pair) => this.#entry(`Pair ${pair.pair}`, pair.apart_mm / 1000, () => this.edit.change({ what: "remove-pair", pair: pair.pair }, "Remove pair"))),
      ...this.pairs.map((pair, i) => this.#entry(`New ${i + 1}`, apart_m(pair), () => this.#remove(i))));
  }

  #entry(name, residual_m, remove) {
    return element("li", { className: "pair" }, element("span", { className: "stored-name" }, name),
      element("span", { className: "note" }, `${fixed(residual_m, 3, " m")} apart`),
      element("button", { type: "button", "aria-label": `Remove ${name}`, onclick: remove }, "Remove"));
  }

  /** What was aligned and not accepted, with the points that would join it. */
  #proposal(pass) {
    const { keyframes: [a, b], apart_m, apart_deg, on_map, x_m, y_m, why } = pass, { keyframes } = this.edit;
    const where = `x ${fixed(x_m, 1)}, y ${fixed(y_m, 1, " m")}`, isChosen = this.pairs.some((pair) => pair.pass === pass);
    const button = element("button", { type: "button", "aria-label": `Propose points at ${where}`, onclick: () => this.#propose(pass) }, "Propose points");
    setRefused(button, isChosen ? "Its points are in the list below" : "");
    return element("li", { className: "pass" }, element("p", { className: "stored-name" }, `Two passes ${fixed(apart_m, 2, " m")} and ${fixed(apart_deg, 1)}\u00b0 apart at ${where}`),
      element("p", { className: "note" }, `Driven at ${fixed(keyframes.seconds(a), 0, " s")} and ${fixed(keyframes.seconds(b), 0, " s")}; aligned, ${fixed(100 * on_map, 0, " %")} of the later points fit. Not joined by itself: ${why}.`),
      element("div", { className: "row" }, button));
  }

  /** Choose both places and points of them, for the person to look at before Optimise. */
  async #propose(pass) {
    const { a, b } = this.places, [of, to] = pass.keyframes;
    await Promise.all([a.choose(of), b.choose(to)]);
    if (a.keyframe !== of || b.keyframe !== to || !this.passes.includes(pass)) return;
    for (const points of pass.points.slice(0, MAX_PAIRS - this.pairs.length)) this.pairs.push({ pass, points, places: [a.as(), b.as()] });
    b.show();
    this.update();
  }

  #remove(i) {
    this.pairs.splice(i, 1);
    this.update();
    this.edit.view.invalidate();
  }

  #placeChanged() {
    if (this.edit.tool instanceof PairTool) this.edit.tool.back();
    const { b } = this.places;
    if (this.pane.isOpen && b.pose && b.pose !== this.shownInPane) this.#showInPane();
    this.update();
    this.edit.view.invalidate();
  }

  #otherPass() {
    const k = this.edit.keyframes.otherPass(this.places.a.keyframe);
    if (k === null) this.edit.say("No other pass: the path is shorter than 10 m", "error");
    else this.places.b.choose(k);
  }

  #pickPoints() {
    if (this.edit.tool instanceof PairTool) {
      this.edit.endTool();
      return;
    }
    const tool = new PairTool(this.edit.view, this.places, this.pane, (ofA, ofB) => {
      if (this.pairs.length >= MAX_PAIRS) tool.note = `${MAX_PAIRS} new pairs at most; optimise first.`;
      else this.pairs.push({ points: [ofA, ofB], places: [this.places.a.as(), this.places.b.as()] });
      this.update();
    });
    this.edit.beginTool(tool);
  }

  /** Two panes, and points are picked in them; or one map again. */
  #sideBySide() {
    const { a, b } = this.places;
    if (this.pane.isOpen) this.closePane();
    else if (a.pose && b.pose) {
      this.pane.open(a.pose, b.pose);
      this.shownInPane = b.pose;
      if (!(this.edit.tool instanceof PairTool)) this.#pickPoints();
      else this.edit.beginTool(this.edit.tool); // its hint is another
    }
    this.update();
  }

  closePane() {
    this.pane.close();
    if (this.edit.tool instanceof PairTool) this.edit.tool.back();
    this.update();
  }

  #showInPane() {
    this.shownInPane = this.places.b.pose;
    this.pane.show(this.shownInPane);
  }

  async #optimise() {
    const far = this.pairs.flatMap((pair, i) => (apart_m(pair) > FAR_M ? [`New ${i + 1}: ${fixed(apart_m(pair), 3, " m")}`] : []));
    if (far.length && !await confirmed("Join points that are far apart?",
      `In the map as it is they are farther apart than ${FAR_M} m: ${far.join(", ")}. If they are one place, the map is bent by as much; if not, it is spoilt. Undo takes it back.`, "Optimise")) return;
    const { pairs } = this, change = pairs.length ? { what: "add-pair", pairs } : { what: "optimize" };
    this.pairs = [];
    this.edit.endTool();
    if (!await this.edit.change(change, "Optimise")) this.pairs = pairs; // to be corrected, not picked again
    this.update();
    this.edit.view.invalidate();
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
    if (this.edit.tool instanceof PairTool) this.edit.tool.drawOf(["b"], context, camera, colours);
  }

  #drawLinks(context, camera, colours) {
    const link = (from, to, name, dash) => {
      const [x0, y0] = camera.toScreen(...from), [x1, y1] = camera.toScreen(...to);
      context.strokeStyle = context.fillStyle = colours.measure;
      context.lineWidth = 2;
      context.setLineDash(dash);
      context.beginPath();
      context.moveTo(x0, y0);
      context.lineTo(x1, y1);
      context.stroke();
      context.setLineDash([]);
      for (const [x, y] of [[x0, y0], [x1, y1]]) context.fillRect(x - 3, y - 3, 6, 6);
      context.font = "12px system-ui, sans-serif";
      context.fillText(name, x1 + 6, y1 + 14);
    };
    for (const pair of this.stored) link([pair.x_m, pair.y_m], [pair.other_x_m, pair.other_y_m], String(pair.pair), [3, 3]);
    this.pairs.forEach(({ points: [from, to] }, i) => link(from, to, `New ${i + 1}`, []));
  }
}

const apart_m = ({ points: [[x0, y0], [x1, y1]] }) => Math.hypot(x1 - x0, y1 - y0);
