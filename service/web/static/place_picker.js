// One of the two places whose points are said to be the same: a key frame, chosen by number or on the map.

import { element, notice, setRefused, setText } from "./dom.js";
import { fixed } from "./format.js";

const LABELS = { a: "Place A", b: "Place B" };

export class PlacePicker {
  /** edit: of the area Edit; changed(): the place or its points are others. */
  constructor(side, edit, changed) {
    this.side = side;
    this.edit = edit;
    this.changed = changed;
    this.keyframe = null;
    this.pose = null; // pose_map_base, [x_m, y_m, theta_rad]
    this.stamp_ns = ""; // digits
    this.points = []; // map frame, [x_m, y_m, ...]
    this.loading = false;
    const label = LABELS[side], id = `place-${side}`;
    this.swatch = element("span", { className: "swatch" });
    this.words = element("span", { className: "note", id: `${id}-words` });
    this.slider = element("input", { type: "range", id, min: "0", max: "0", step: "1", value: "0", "aria-label": `${label}: key frame` });
    this.slider.addEventListener("input", () => this.choose(Number(this.slider.value)));
    this.pick = element("button", { type: "button", id: `${id}-pick`, onclick: () => edit.pickKeyframe(`where ${label} is`, (k) => this.choose(k)) },
      "On the map");
    this.go = element("button", { type: "button", id: `${id}-go`, "aria-label": `Show ${label}`, onclick: () => this.show() }, "Show");
    this.node = element("div", { className: "place", role: "group", "aria-label": label },
      element("div", { className: "row" }, element("span", { className: "name" }, this.swatch, label), this.words),
      element("div", { className: "row" }, this.slider, this.pick, this.go));
    this.update();
  }

  get isChosen() {
    return this.keyframe !== null;
  }

  /** The key frame, for who keeps a point of it. */
  as() {
    return { keyframe: this.keyframe, stamp_ns: this.stamp_ns, pose: this.pose };
  }

  /** Load and show the points of a key frame; while one is loading, the newest request waits. */
  async choose(keyframe) {
    this.keyframe = keyframe;
    this.update();
    if (this.loading) return;
    this.loading = true;
    for (let loaded = null; loaded !== this.keyframe;) {
      loaded = this.keyframe;
      if (loaded === null) break;
      const answer = await this.edit.keyframe(loaded);
      if (!answer.ok) {
        this.keyframe = null;
        notice(`${LABELS[this.side]}: ${answer.error}.`, "error");
        break;
      }
      if (this.keyframe === loaded) [this.points, this.pose, this.stamp_ns] = [answer.points, answer.pose, answer.stamp_ns];
    }
    this.loading = false;
    if (!this.isChosen) this.clear();
    this.update();
    this.changed();
  }

  clear() {
    this.keyframe = this.pose = null;
    this.points = [];
    this.update();
  }

  /** Bring it into the middle of the map. */
  show() {
    if (!this.pose) return;
    this.edit.view.follow(false);
    this.edit.view.camera.centreOn(this.pose[0], this.pose[1]);
    this.edit.view.invalidate();
  }

  update() {
    const { keyframes } = this.edit;
    this.slider.max = String(Math.max(keyframes.count - 1, 0));
    this.slider.value = String(this.keyframe ?? 0);
    const words = this.isChosen ? `key frame ${this.keyframe}, ${fixed(keyframes.seconds(this.keyframe), 1, " s")}` : "not chosen";
    this.slider.setAttribute("aria-valuetext", words);
    setRefused(this.go, this.isChosen ? "" : "Choose the place first");
    setText(this.words, words);
  }

  draw(context, camera, colour) {
    if (!this.pose) return;
    context.fillStyle = context.strokeStyle = colour;
    for (let i = 0; i < this.points.length; i += 2) {
      const [x, y] = camera.toScreen(this.points[i], this.points[i + 1]);
      context.fillRect(x - 2, y - 2, 4, 4);
    }
    const [x, y] = camera.toScreen(this.pose[0], this.pose[1]);
    context.lineWidth = 3;
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    context.stroke();
    context.font = "bold 14px system-ui, sans-serif";
    const isA = this.side === "a"; // A and B may be at one spot
    context.textAlign = isA ? "right" : "left";
    context.fillText(this.side.toUpperCase(), isA ? x - 9 : x + 9, y - 7);
    context.textAlign = "left";
  }
}
