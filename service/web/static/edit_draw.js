// Cards of the area Edit that draw on the map: areas to be erased, walls, and the time span to be cut out.

import { square } from "./canvas.js";
import { byId, onClick, setPressed, setRefused, setText } from "./dom.js";
import { area, CornersTool, length, RectangleTool } from "./edit_tools.js";
import { counted, fixed } from "./format.js";

const MAX_CORNERS = 500; // of one change; the service refuses more
const SPAN_STEP_S = 0.01;
const MAX_UNASKED_M2 = 10; // of a rectangle that is erased without a question: Undo brings it back
const SHAPES = ["rectangle", "area", "wall"];

const squareMetres = (corners) => fixed(area(corners), 2, " m\u00b2");

export class EditDraw {
  constructor(edit) {
    this.edit = edit;
    this.kind = null; // of SHAPES, while it is drawn
    for (const kind of SHAPES) onClick(`draw-${kind}`, () => this.#choose(kind));
    onClick("erase", () => this.#erase());
    onClick("wall", () => this.#wall());
    this.update();
  }

  get corners() {
    return this.kind ? this.edit.tool?.corners ?? [] : [];
  }

  update() {
    const { kind, corners } = this, isWall = kind === "wall";
    for (const shape of SHAPES) setPressed(byId(`draw-${shape}`), shape === kind);
    setRefused(byId("erase"), !isWall && corners.length >= 3 ? "" : "Draw an area on the map first");
    setRefused(byId("wall"), isWall && corners.length >= 2 ? "" : "Draw a wall on the map first");
    setText(byId("draw-words"), !kind ? "Choose what to draw on the map."
      : isWall ? `${counted(corners.length, "point")}, ${fixed(length(corners), 2, " m")}`
        : `${counted(corners.length, "corner")}, ${squareMetres(corners)}`);
  }

  #choose(kind) {
    if (this.kind === kind) {
      this.edit.endTool();
      return;
    }
    const { view } = this.edit, changed = () => this.update();
    const done = () => (kind === "wall" ? this.#wall() : this.#erase(kind === "rectangle"));
    const tool = kind === "rectangle" ? new RectangleTool(view, { changed, done })
      : new CornersTool(view, { isClosed: kind === "area", most: MAX_CORNERS, changed, done });
    this.edit.beginTool(tool, () => {
      this.kind = null;
      this.update();
    });
    this.kind = kind;
    this.update();
  }

  /** isDragged: by one stroke, so that a small one is undone as quickly as it was drawn. */
  #erase(isDragged = false) {
    const { corners } = this, becomes = byId("erase-becomes").value;
    const words = `What stands within ${squareMetres(corners)} is gone: from the map, and from what vehicles are localised against. Undo brings it back.`;
    this.edit.change({ what: "erase", corners, becomes }, "Erase", isDragged && area(corners) <= MAX_UNASKED_M2 ? null : ["Erase the area?", words, "Erase"]);
  }

  #wall() {
    const { corners } = this, words = `${fixed(length(corners), 2, " m")} are occupied from now on, whatever lasers see there. Undo takes it down.`;
    this.edit.change({ what: "wall", corners }, "Wall", ["Put up the wall?", words, "Put up"]);
  }
}

export class EditCut {
  constructor(edit) {
    this.edit = edit;
    this.fields = [this.#field("cut-from", "where the span begins", Math.floor), this.#field("cut-to", "where it ends", Math.ceil)];
    onClick("cut", () => this.#cut());
    this.update();
  }

  /** round: so that the key frame that was clicked is within the span. */
  #field(id, what, round) {
    const input = byId(id);
    input.oninput = () => this.update();
    onClick(`${id}-pick`, () => this.edit.pickKeyframe(what, (k) => {
      input.value = (round(this.edit.keyframes.seconds(k) / SPAN_STEP_S) * SPAN_STEP_S).toFixed(2);
      this.update();
    }));
    return input;
  }

  get span() {
    const [from_s, to_s] = this.fields.map(({ value }) => (value === "" ? NaN : Number(value)));
    return Number.isFinite(from_s) && Number.isFinite(to_s) ? { from_s, to_s } : null;
  }

  update() {
    const { span } = this, isSpan = span !== null && span.to_s >= span.from_s;
    setRefused(byId("cut"), isSpan ? "" : "Enter when the span begins and ends, or choose it on the map");
    setText(byId("cut-words"), !span ? "" : !isSpan ? "The span ends before it begins." : `In it: ${this.#counted}.`);
    this.edit.view.invalidate();
  }

  get #points() {
    const { span } = this, { points, at_s } = this.edit.keyframes;
    return span ? points.filter((_, i) => at_s[i] >= span.from_s && at_s[i] <= span.to_s) : [];
  }

  get #counted() {
    return counted(this.#points.length * this.edit.keyframes.every, "key frame");
  }

  async #cut() {
    const { span } = this;
    const words = `What was driven from ${fixed(span.from_s, 2)} to ${fixed(span.to_s, 2, " s")} is gone: about ${this.#counted}, with points and loops. Undo brings them back.`;
    if (!await this.edit.change({ what: "cut", ...span, bridge: byId("cut-bridge").checked }, "Cut", ["Cut out the time span?", words, "Cut out"])) return;
    this.fields.forEach((field) => { field.value = ""; });
    this.update();
  }

  draw(context, camera, colours) {
    context.fillStyle = colours.measure;
    for (const point of this.#points) square(context, camera.toScreen(...point), 6);
  }
}
