// The two places whose points are paired, and the pane that shows place B beside place A.

import { MapCanvas } from "./camera.js";
import { drawCrossHair, FONT, square } from "./canvas.js";
import { byId, notice, onClick, setRefused, setText } from "./dom.js";
import { fixed } from "./format.js";
import { pointsOf } from "./geometry.js";
import { Gestures } from "./gestures.js";

export class PlacePicker {
  keyframe = null;
  pose = null; // pose_map_base, [x_m, y_m, theta_rad]
  stamp_ns = ""; // digits
  points = []; // map frame
  loading = false;

  /** side: "a" or "b"; edit: of the area Edit; changed(): the place or its points are others. */
  constructor(side, edit, changed) {
    const label = `Place ${side.toUpperCase()}`, id = `place-${side}`;
    Object.assign(this, { side, edit, changed, label });
    for (const part of ["swatch", "words", "go"]) this[part] = byId(`${id}-${part}`);
    this.slider = byId(id);
    this.slider.oninput = () => this.choose(Number(this.slider.value));
    onClick(`${id}-go`, () => this.show());
    onClick(`${id}-pick`, () => edit.pickKeyframe(`where ${label} is`, (k) => this.choose(k)));
    this.update();
  }

  get isChosen() {
    return this.keyframe !== null;
  }

  as() {
    return { keyframe: this.keyframe, stamp_ns: this.stamp_ns, pose: this.pose };
  }

  /** Load and show the points of a key frame; while one is loading, the newest request waits. */
  async choose(keyframe) {
    this.keyframe = keyframe;
    this.update();
    if (this.loading) return;
    this.loading = true;
    for (let loaded = null; this.isChosen && loaded !== this.keyframe;) {
      loaded = this.keyframe;
      const { ok, error, points, pose, stamp_ns } = await this.edit.map.keyframe(loaded, this.edit.version);
      if (!ok) {
        this.keyframe = null;
        notice(`${this.label}: ${error}.`, "error");
        break;
      }
      if (this.keyframe === loaded) Object.assign(this, { points: pointsOf(points), pose, stamp_ns });
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

  show() {
    if (this.pose) this.edit.view.show(this.pose);
  }

  update() {
    const { keyframes, view } = this.edit;
    this.swatch.style.background = view.colours.places[this.side];
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
    for (const point of this.points) square(context, camera.toScreen(...point), 4);
    const [x, y] = camera.toScreen(this.pose[0], this.pose[1]), isA = this.side === "a"; // A and B may be at one spot
    context.lineWidth = 3;
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    context.stroke();
    context.font = `bold 14px ${FONT}`;
    context.textAlign = isA ? "right" : "left";
    context.fillText(this.side.toUpperCase(), isA ? x - 9 : x + 9, y - 7);
    context.textAlign = "left";
  }
}

export class PlacePane extends MapCanvas {
  /** view: MapView of the first pane. tool(): the PairTool that is at work, else null. draw(context, camera, colours): what lies on it. */
  constructor(canvas, view, tool, draw) {
    super(canvas);
    Object.assign(this, { view, draw });
    const ofPane = () => tool() && { click: (point) => tool().click(point, this), back: () => tool().back() };
    this.gestures = new Gestures(this, ofPane);
    this.gestures.onHover = (point) => tool()?.hover(point, this);
  }

  /** Place A in the middle of the first pane, place B in that of this one. Poses: [x_m, y_m, theta_rad], map frame. */
  open(poseOfA, poseOfB) {
    const { scale, rotation_rad } = this.view.camera;
    this.split(true);
    Object.assign(this.camera, { scale, rotation_rad });
    this.view.show(poseOfA);
    this.show(poseOfB);
  }

  split(isSplit) {
    this.canvas.hidden = !isSplit;
    byId("map-area").classList.toggle("split", isSplit);
  }

  paint() {
    const { context, camera, view, dpr } = this, { colours } = view;
    camera.clear(context, colours.ground, dpr);
    view.tiles.draw(context, camera.seen, camera.scale * dpr, colours.palette);
    context.setTransform(dpr, 0, 0, dpr, 0, 0);
    this.draw(context, camera, colours);
    if (this.canvas.matches(":focus-visible")) drawCrossHair(context, camera, colours);
  }
}
