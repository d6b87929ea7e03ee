// Cards of the area Edit that draw on the map: areas to be erased, walls, and the time span to be cut out.

import { card, confirmed, element, setRefused, setText } from "./dom.js";
import { area, CornersTool, length, RectangleTool } from "./edit_tools.js";
import { counted, fixed } from "./format.js";

const MAX_CORNERS = 500; // of one change; the service refuses more
const SPAN_STEP_S = 0.01;
const MAX_UNASKED_M2 = 10; // of a rectangle that is erased without a question: Undo brings it back
const BECOMES = { as_seen: "free where scans see through", unknown: "unknown", free: "free" };

export class EditDraw {
  constructor(edit) {
    this.edit = edit;
    this.kind = null; // "rectangle", "area" or "wall", while it is drawn
    const choose = (kind, text) => element("button", { type: "button", id: `draw-${kind}`, "aria-pressed": "false", onclick: () => this.#choose(kind) }, text);
    this.choices = { rectangle: choose("rectangle", "Rectangle"), area: choose("area", "Area by corners"), wall: choose("wall", "Wall") };
    this.words = element("p", { className: "note", id: "draw-words", role: "status" });
    this.becomes = element("select", { id: "erase-becomes" },
      ...Object.entries(BECOMES).map(([value, words]) => element("option", { value }, words)));
    this.erase = element("button", { type: "button", className: "danger", id: "erase", onclick: () => this.#erase() }, "Erase\u2026");
    this.wall = element("button", { type: "button", id: "wall", onclick: () => this.#wall() }, "Put up the wall\u2026");
    this.card = card("Erase and draw");
    this.card.node.append(element("div", { className: "row" }, ...Object.values(this.choices)), this.words,
      element("div", { className: "row" }, element("label", { for: "erase-becomes" }, "Then the area is"), this.becomes),
      element("div", { className: "row" }, this.erase, this.wall));
    this.update();
  }

  get corners() {
    return this.kind ? this.edit.tool?.corners ?? [] : [];
  }

  update() {
    const { kind, corners } = this, isWall = kind === "wall";
    for (const [name, button] of Object.entries(this.choices)) button.setAttribute("aria-pressed", String(name === kind));
    setRefused(this.erase, !isWall && corners.length >= 3 ? "" : "Draw an area on the map first");
    setRefused(this.wall, isWall && corners.length >= 2 ? "" : "Draw a wall on the map first");
    setText(this.words, !kind ? "Choose what to draw on the map."
      : isWall ? `${counted(corners.length, "point")}, ${fixed(length(corners), 2, " m")}`
        : `${counted(corners.length, "corner")}, ${fixed(area(corners), 2, " m\u00b2")}`);
  }

  #choose(kind) {
    if (this.kind === kind) {
      this.edit.endTool();
      return;
    }
    const changed = () => this.update();
    const done = () => (kind === "wall" ? this.#wall() : this.#erase(kind === "rectangle"));
    const tool = kind === "rectangle" ? new RectangleTool(this.edit.view, { changed, done })
      : new CornersTool(this.edit.view, { isClosed: kind === "area", most: MAX_CORNERS, changed, done });
    this.edit.beginTool(tool, () => {
      this.kind = null;
      this.update();
    });
    this.kind = kind;
    this.update();
  }

  /** isDragged: by one stroke, so that a small one is undone as quickly as it was drawn. */
  async #erase(isDragged = false) {
    const { corners } = this, becomes = this.becomes.value;
    const isSure = (isDragged && area(corners) <= MAX_UNASKED_M2) || await confirmed("Erase the area?",
      `What stands within ${fixed(area(corners), 2, " m\u00b2")} is gone: from the map, and from what vehicles are localised against. Undo brings it back.`, "Erase");
    if (isSure) this.#change({ what: "erase", corners, becomes }, "Erase");
  }

  async #wall() {
    const { corners } = this;
    const isSure = await confirmed("Put up the wall?",
      `${fixed(length(corners), 2, " m")} are occupied from now on, whatever lasers see there. Undo takes it down.`, "Put up");
    if (isSure) this.#change({ what: "wall", corners }, "Wall");
  }

  #change(change, label) {
    this.edit.endTool();
    return this.edit.change(change, label);
  }
}

export class EditCut {
  constructor(edit) {
    this.edit = edit;
    const field = (name, words) => {
      const input = element("input", { type: "number", id: `cut-${name}`, step: String(SPAN_STEP_S), min: "0", inputMode: "decimal" });
      input.addEventListener("input", () => this.update());
      const round = name === "from" ? Math.floor : Math.ceil; // so that the key frame that was clicked is within
      const pick = element("button", { type: "button", id: `cut-${name}-pick`, "aria-label": `${words}: choose on the map`,
        onclick: () => edit.pickKeyframe(`${words === "From" ? "where the span begins" : "where it ends"}`, (k) => {
          input.value = (round(edit.keyframes.seconds(k) / SPAN_STEP_S) * SPAN_STEP_S).toFixed(2);
          this.update();
        }) }, "On the map");
      return { input, row: element("div", { className: "row" }, element("label", { for: `cut-${name}`, className: "short" }, `${words}, s`), input, pick) };
    };
    this.from = field("from", "From");
    this.to = field("to", "To");
    this.bridge = element("input", { type: "checkbox", id: "cut-bridge" });
    this.words = element("p", { className: "note", id: "cut-words", role: "status" });
    this.button = element("button", { type: "button", className: "danger", id: "cut", onclick: () => this.#cut() }, "Cut out\u2026");
    this.card = card("Cut out a time span");
    this.card.node.append(element("p", { className: "note" }, "Seconds after the map's first key frame."), this.from.row, this.to.row, this.words,
      element("label", { className: "check" }, this.bridge, "Bridge: odometry holds the ends over what is cut"),
      element("div", { className: "row" }, this.button));
    this.update();
  }

  /** Both ends, s; null while a field is empty. */
  get span() {
    const [from_s, to_s] = [this.from, this.to].map(({ input }) => (input.value === "" ? NaN : Number(input.value)));
    return Number.isFinite(from_s) && Number.isFinite(to_s) ? { from_s, to_s } : null;
  }

  update() {
    const { span } = this, isSpan = span !== null && span.to_s >= span.from_s;
    setRefused(this.button, isSpan ? "" : "Enter when the span begins and ends, or choose it on the map");
    setText(this.words, !span ? "" : !isSpan ? "The span ends before it begins." : `In it: ${counted(this.#count(span), "key frame")}.`);
    this.edit.view.invalidate();
  }

  #count({ from_s, to_s }) {
    const { at_s, every } = this.edit.keyframes;
    return at_s.filter((s) => s >= from_s && s <= to_s).length * every;
  }

  async #cut() {
    const { span } = this;
    const isSure = await confirmed("Cut out the time span?",
      `What was driven from ${fixed(span.from_s, 2)} to ${fixed(span.to_s, 2, " s")} is gone: about ${counted(this.#count(span), "key frame")}, with points and loops. Undo brings them back.`, "Cut out");
    if (!isSure || !await this.edit.change({ what: "cut", ...span, bridge: this.bridge.checked }, "Cut")) return;
    this.from.input.value = this.to.input.value = "";
    this.update();
  }

  draw(context, camera, colours) {
    const { span } = this, { x_m, y_m, at_s } = this.edit.keyframes;
    if (!span) return;
    context.fillStyle = colours.measure;
    at_s.forEach((s, i) => {
      if (s < span.from_s || s > span.to_s) return;
      const [x, y] = camera.toScreen(x_m[i], y_m[i]);
      context.fillRect(x - 3, y - 3, 6, 6);
    });
  }
}
