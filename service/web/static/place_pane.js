// The second pane of the map: place B beside place A, each to be moved, zoomed and turned by itself.

import { Camera } from "./camera.js";
import { byId } from "./dom.js";
import { drawCrossHair } from "./edit_tools.js";
import { Gestures } from "./gestures.js";

export class PlacePane {
  follows = false; // of a vehicle, as a MapView does

  /** view: MapView of the first pane. tool(): the PairTool that is at work, else null. draw(context, camera, colours): what lies on it. */
  constructor(canvas, view, tool, draw) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.camera = new Camera();
    this.view = view;
    this.draw = draw;
    this.needsPicture = false;
    this.frames = 0;
    const ofPane = () => tool() && { drags: false, click: (point) => tool().click(point, this) };
    this.gestures = new Gestures(canvas, this, ofPane, () => {});
    this.gestures.onHover = (point) => tool()?.hover(point, this);
    canvas.addEventListener("keydown", (event) => this.#key(event, tool()));
    for (const change of ["focus", "blur"]) canvas.addEventListener(change, () => this.invalidate());
    new ResizeObserver(() => this.#resize()).observe(canvas);
  }

  get isOpen() {
    return !this.canvas.hidden;
  }

  /** Place A in the middle of the first pane, place B in that of this one. Poses: [x_m, y_m, theta_rad], map frame. */
  open(poseOfA, poseOfB) {
    this.#split(true);
    Object.assign(this.camera, { scale: this.view.camera.scale, rotation_rad: this.view.camera.rotation_rad });
    this.view.follow(false);
    this.view.camera.centreOn(poseOfA[0], poseOfA[1]);
    this.view.invalidate();
    this.show(poseOfB);
  }

  close() {
    this.#split(false);
  }

  /** Bring a place into the middle. */
  show(pose) {
    this.camera.centreOn(pose[0], pose[1]);
    this.invalidate();
  }

  invalidate() {
    if (this.needsPicture || !this.isOpen) return;
    this.needsPicture = true;
    requestAnimationFrame(() => {
      this.needsPicture = false;
      if (this.isOpen) this.#draw();
    });
  }

  #split(isSplit) {
    this.canvas.hidden = !isSplit;
    byId("map-area").classList.toggle("split", isSplit);
  }

  #key(event, tool) {
    if (event.ctrlKey || event.metaKey || event.altKey || (event.repeat && event.key === "Enter")) return;
    const { camera } = this;
    if (event.key === "Enter") tool?.click([camera.width / 2, camera.height / 2], this);
    else if (event.key === "Backspace") tool?.back();
    else if (!this.gestures.key(event.key)) return;
    event.preventDefault();
  }

  #resize() {
    if (!this.isOpen) return;
    this.dpr = this.camera.sizeTo(this.canvas);
    this.#draw(); // at once: an emptied canvas would flash
  }

  #draw() {
    const { context, camera, view } = this, { colours } = view, { dpr = 1 } = this;
    camera.clear(context, colours.ground, dpr);
    view.tiles.draw(context, camera.seen, camera.scale * dpr);
    context.setTransform(dpr, 0, 0, dpr, 0, 0);
    this.draw(context, camera, colours);
    if (this.canvas.matches(":focus-visible")) drawCrossHair(context, camera, colours);
    this.frames += 1;
  }
}
