// Draws the map, the path, the scans and the vehicle; only when something changed, at most once a screen refresh.

import { Camera } from "./camera.js";
import { compose, ellipse, PoseTrack } from "./geometry.js";
import { GraphLayer } from "./graph_layer.js";
import { ChangeLayer } from "./change_layer.js";
import { metres } from "./format.js";
import { StandingLayer } from "./standing_layer.js";
import { RANGE_STEP_M } from "./protocol.js";
import { StoredChangeLayer } from "./stored_change_layer.js";
import { TileMap } from "./tiles.js";

const STALE_MS = 1500; // older scans and poses are not shown as live
const PATH_STEP_M = 0.05, MAX_PATH_POINTS = 40_000;
const JUMP_M = 1, FASTEST_MPS = 20; // farther than that no vehicle comes: its pose jumped
const LASER_COLOURS = 5;
const MAX_COMING = 50; // scans of a laser
const VEHICLE_M = 0.5; // length of the arrow; never smaller than VEHICLE_PIXELS
const VEHICLE_PIXELS = 22;

/** A colour of the style sheet as [red, green, blue, 255]. */
const rgba = (colour) => {
  const canvas = new OffscreenCanvas(1, 1).getContext("2d");
  canvas.fillStyle = colour;
  canvas.fillRect(0, 0, 1, 1);
  return [...canvas.getImageData(0, 0, 1, 1).data];
};

export class MapView {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.camera = new Camera();
    this.tiles = new TileMap();
    this.track = new PoseTrack();
    this.path = []; // [x_m, y_m, x_m, y_m ...]; NaN, NaN where the pose jumped
    this.scans = new Map(); // sensor -> {scan}: the newest whose place is known
    this.coming = new Map(); // sensor -> scans that wait for their poses, which come later where the service is busy
    this.sensors = []; // lasers in the order in which they were first seen: gives each its colour
    this.mountings = {};
    this.layers = { map: true, path: true, standing: false, graph: false, change: false, stored: true, scans: true, vehicle: true, grid: true };
    this.graph = new GraphLayer();
    this.change = new ChangeLayer();
    this.stored = new StoredChangeLayer();
    this.standing = new StandingLayer();
    this.overlays = []; // functions(context, camera, colours) of the tools
    this.before = null; // snapshot of an earlier map
    this.showsBefore = false; // ... and whether it is drawn in place of the present one
    this.other = null; // {tiles, share}: another version of the map, drawn in that share of the width
    this.follows = true;
    this.isHeld = false; // a replay that is paused: what came last is of now, however long ago that was
    this.fitted = null; // the camera as it last showed all; null: nothing is shown yet
    this.poseArrived_ms = -Infinity;
    this.moment = null; // of a past that is looked at: {at_s, path}
    this.frames = 0;
    this.firstMap_ms = null; // when there was a map on the screen, after the page was opened
    this.drawn_ms = []; // how long the last pictures took
    this.needsPicture = false;
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.readColours();
  }

  /** Again after the theme has changed. */
  readColours() {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    this.colours = {
      ground: colour("--map-ground"), grid: colour("--map-grid"), path: colour("--map-path"),
      vehicle: colour("--map-vehicle"), measure: colour("--map-measure"), text: colour("--text"),
      paper: colour("--ground"), stale: colour("--none"),
      change: { appeared: colour("--change-appeared"), gone: colour("--change-gone") },
      standing: { fresh: rgba(colour("--standing-fresh")), full: rgba(colour("--standing-full")) },
      graph: { keyFrames: colour("--graph-key-frames"), accepted: colour("--graph-accepted"),
        refused: colour("--graph-refused"), borders: colour("--graph-border") },
      places: { a: colour("--laser-0"), b: colour("--laser-1") }, // no laser is seen where places are chosen
      lasers: Array.from({ length: LASER_COLOURS }, (_, i) => colour(`--laser-${i}`)),
    };
    this.standing.repaint();
    for (const tiles of [this.tiles, this.before?.tiles, this.other?.tiles]) {
      tiles?.setColours({
        unknown: [0, 0, 0, 0], free: rgba(colour("--map-free")), occupied: rgba(colour("--map-occupied")),
      });
    }
    this.invalidate();
  }

  /** The map, the path and the graph as they are now. */
  snapshot() {
    return { tiles: this.tiles.copy(), path: this.path, graph: this.graph.copy() };
  }

  invalidate() {
    if (this.needsPicture) return;
    this.needsPicture = true;
    requestAnimationFrame(() => {
      this.needsPicture = false;
      this.#draw();
    });
  }

  clear() {
    this.tiles.clear();
    this.track.clear();
    this.scans.clear();
    this.coming.clear();
    this.graph.clear();
    this.change.clear();
    this.standing.clear();
    this.stored.clear();
    this.layers.change = false;
    this.path = [];
    this.moment = null;
    this.fitted = null;
    this.invalidate();
  }

  putTiles({ edge, cell_m, tiles }) {
    for (const { ix, iy, cells } of tiles) {
      this.tiles.put(ix, iy, edge, cell_m, cells);
      this.change.put(ix, iy, edge, cell_m, cells);
    }
    const isUntouched = this.fitted === null || this.fitted === this.camera.place;
    if (isUntouched && (this.track.last === null || this.moment)) this.#showAll(); // a vehicle is followed all the same when it comes
    this.invalidate();
  }

  putPath({ points, goesOn = false }) {
    this.path = goesOn ? this.path.concat(Array.from(points)) : Array.from(points);
    this.invalidate();
  }

  putGraph(graph) {
    this.graph.put(graph);
    this.invalidate();
  }

  putStanding(standing) {
    this.standing.put(standing);
    this.invalidate();
  }

  putStoredChanges(changes) {
    this.stored.put(changes);
    this.invalidate();
  }

  putPose(pose) {
    const before = this.track.last;
    this.track.add(pose);
    this.poseArrived_ms = performance.now();
    if (before && this.path.length && jumps(before, pose)) this.path.push(NaN, NaN);
    const n = this.path.length;
    const step_m = n ? Math.hypot(this.path[n - 2] - pose.x_m, this.path[n - 1] - pose.y_m) : Infinity;
    if (!(step_m < PATH_STEP_M)) this.path.push(pose.x_m, pose.y_m);
    if (this.path.length > 2 * MAX_PATH_POINTS) {
      this.path = this.path.filter((metres, i) => i % 4 < 2 || Number.isNaN(metres));
    }
    if (this.follows) this.camera.centreOn(pose.x_m, pose.y_m);
    this.fitted = ""; // what is shown goes by the vehicle
    this.invalidate();
  }

  /** Show a moment of the past: the poses about it, and as much of the path as was driven by then. */
  putMoment({ at_s, poses, path }) {
    if (!this.moment) this.follows = false; // all of the map first
    this.moment = { at_s, path };
    this.track.clear();
    for (const pose of poses) this.track.add({ ...pose, covariance: known(pose.covariance), twist: known(pose.twist) });
    for (const shownScan of this.scans.values()) shownScan.isFinal = false;
    this.follow(this.follows);
  }

  /** What comes from now on is of now. */
  endMoment() {
    if (!this.moment) return;
    this.moment = null;
    this.track.clear();
    this.scans.clear();
    this.coming.clear();
    this.invalidate();
  }

  /** Whether it is of a laser that was not seen before. */
  putScan(scan) {
    const isNew = !this.sensors.includes(scan.sensor);
    if (isNew) {
      this.sensors.push(scan.sensor);
      this.sensors.sort();
    }
    const coming = this.coming.get(scan.sensor) ?? [];
    if (coming.length && scan.stamp_s < coming.at(-1).stamp_s) coming.length = 0; // another run
    coming.push(scan);
    if (coming.length > MAX_COMING) coming.shift();
    this.coming.set(scan.sensor, coming);
    this.invalidate();
    return isNew;
  }

  /** Of a laser that was seen; null of any other sensor. */
  colourOf(sensor) {
    const index = this.sensors.indexOf(sensor);
    return index < 0 ? null : this.colours.lasers[index % LASER_COLOURS];
  }

  /** Bring the complete map and the vehicle into view. */
  fit() {
    if (this.#showAll()) this.follows = false;
  }

  #showAll() {
    const bounds = this.tiles.bounds, pose = this.track.last;
    if (!bounds) return false;
    if (pose) {
      bounds.x_min_m = Math.min(bounds.x_min_m, pose.x_m);
      bounds.x_max_m = Math.max(bounds.x_max_m, pose.x_m);
      bounds.y_min_m = Math.min(bounds.y_min_m, pose.y_m);
      bounds.y_max_m = Math.max(bounds.y_max_m, pose.y_m);
    }
    this.camera.fit(bounds);
    this.fitted = this.camera.place;
    this.invalidate();
    return true;
  }

  follow(isOn) {
    this.follows = isOn;
    const last = this.track.last;
    if (isOn && last) this.camera.centreOn(last.x_m, last.y_m);
    this.onFollows?.();
    this.invalidate();
  }

  /** Whether the newest pose is of now. */
  get isLive() {
    if (this.moment) return 1000 * (this.moment.at_s - this.track.last.stamp_s) < STALE_MS;
    return this.isHeld || performance.now() - this.poseArrived_ms < STALE_MS;
  }

  #resize() {
    this.dpr = this.camera.sizeTo(this.canvas);
    this.#draw(); // at once: an emptied canvas would flash
  }

  #draw() {
    const began_ms = performance.now();
    const { context, camera, colours, layers, dpr = 1 } = this;
    const { tiles, path, graph } = this.showsBefore ? this.before : this;
    camera.clear(context, colours.ground, dpr);
    if (layers.map) tiles.draw(context, camera.seen, camera.scale * dpr);
    if (layers.map && this.other) this.#drawOther();
    if (layers.grid) this.#drawGrid();
    if (layers.standing && !this.showsBefore) this.standing.draw(context, colours.standing);
    if (layers.change) this.change.draw(context, camera.seen, camera.scale, colours.change);
    if (layers.stored && !this.showsBefore) this.stored.draw(context, camera.seen, camera.scale, colours.change);
    if (layers.path) this.#drawPath(this.moment && !this.showsBefore ? this.#drivenPath() : path);
    if (layers.graph) graph.draw(context, camera.scale, colours.graph);
    if (layers.scans) this.#drawScans();
    if (layers.vehicle) this.#drawVehicle();
    context.setTransform(dpr, 0, 0, dpr, 0, 0);
    for (const overlay of this.overlays) overlay(context, camera, colours);
    this.onDrawn?.();
    this.frames += 1;
    if (this.firstMap_ms === null && tiles.tiles.size > 0) this.firstMap_ms = performance.now();
    this.drawn_ms.push(performance.now() - began_ms);
    if (this.drawn_ms.length > 300) this.drawn_ms.shift();
  }

  #drawOther() {
    const { context, camera, canvas, colours, dpr = 1, other } = this, split = Math.round(canvas.width * other.share);
    context.save();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.beginPath();
    context.rect(0, 0, split, canvas.height);
    context.clip();
    camera.clear(context, colours.ground, dpr);
    other.tiles.draw(context, camera.seen, camera.scale * dpr);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = colours.measure;
    context.fillRect(split - 2 * dpr, 0, 2 * dpr, canvas.height);
    context.restore();
  }

  get gridStep_m() {
    return niceLength(90 / this.camera.scale);
  }

  /** Seen on free space, not on walls. */
  #drawGrid() {
    const { context, camera, gridStep_m: step_m } = this;
    const { x_min_m, y_min_m, x_max_m, y_max_m } = camera.seen;
    context.beginPath();
    for (let x = Math.ceil(x_min_m / step_m) * step_m; x <= x_max_m; x += step_m) {
      context.moveTo(x, y_min_m);
      context.lineTo(x, y_max_m);
    }
    for (let y = Math.ceil(y_min_m / step_m) * step_m; y <= y_max_m; y += step_m) {
      context.moveTo(x_min_m, y);
      context.lineTo(x_max_m, y);
    }
    context.strokeStyle = this.colours.grid;
    context.lineWidth = 1 / camera.scale;
    context.globalCompositeOperation = document.documentElement.dataset.theme === "dark" ? "lighten" : "darken";
    context.stroke();
    context.globalCompositeOperation = "source-over";
  }

  /** As far as it was driven at the moment that is shown, and on to the vehicle. */
  #drivenPath() {
    const { path: [first, end] } = this.moment, { last } = this.track;
    const driven = this.path.slice(2 * first, 2 * end);
    if (last && end > first) driven.push(last.x_m, last.y_m);
    return driven;
  }

  #drawPath(path) {
    const { context, camera } = this;
    const every = 2 * Math.max(1, Math.floor(1 / (camera.scale * PATH_STEP_M))); // of points a pixel
    context.beginPath();
    for (let begin = 0, i = 0; i <= path.length; i += 2) {
      if (i < path.length && !Number.isNaN(path[i])) continue;
      if (i > begin) {
        context.moveTo(path[begin], path[begin + 1]);
        for (let k = begin + every; k < i; k += every) context.lineTo(path[k], path[k + 1]);
        context.lineTo(path[i - 2], path[i - 1]);
      }
      begin = i + 2;
    }
    context.strokeStyle = this.colours.path;
    context.lineWidth = 2 / camera.scale;
    context.lineJoin = "round";
    context.stroke();
  }

  #drawScans() {
    const { context, camera } = this;
    const size_m = Math.max(3 / camera.scale, 0.02);
    for (const [sensor, coming] of this.coming) this.#takeScan(sensor, coming);
    for (const [sensor, shownScan] of this.scans) {
      if (!this.#isOfNow(shownScan)) continue;
      if (!shownScan.isFinal) this.#placeScan(shownScan);
      if (!shownScan.points) continue;
      context.fillStyle = this.colourOf(sensor);
      const { points } = shownScan;
      for (let i = 0; i < points.length; i += 2) {
        context.fillRect(points[i] - size_m / 2, points[i + 1] - size_m / 2, size_m, size_m);
      }
    }
  }

  /** The newest scan whose place is known, and no older one from then on. */
  #takeScan(sensor, coming) {
    const last = coming.findLastIndex(({ stamp_s }) => this.track.at(stamp_s) !== null);
    if (last < 0) return;
    this.scans.set(sensor, { scan: coming[last] });
    coming.splice(0, last + 1);
  }

  /** Whether a scan is of the pose that is shown, or of the moment of the past. */
  #isOfNow({ scan }) {
    const { last } = this.track, now_s = this.moment?.at_s ?? last?.stamp_s;
    const age_ms = 1000 * (now_s - scan.stamp_s);
    return this.moment ? age_ms >= 0 && age_ms <= STALE_MS : this.isLive && Math.abs(age_ms) <= STALE_MS;
  }

  /** Lasers whose scans are drawn. */
  get shownSensors() {
    return this.sensors.filter((sensor) => this.scans.has(sensor) && this.#isOfNow(this.scans.get(sensor)));
  }

  /** End points in the map, each beam at its own moment. */
  #placeScan(shownScan) {
    const { scan } = shownScan;
    const at = this.track.at(scan.stamp_s);
    const mounting = this.mountings[scan.sensor];
    if (!at || !mounting) {
      shownScan.points = null;
      return;
    }
    const laser = { x_m: mounting[0], y_m: mounting[1], theta_rad: mounting[2] };
    const sensor = compose(at.pose, laser);
    const c = Math.cos(at.pose.theta_rad), s = Math.sin(at.pose.theta_rad);
    const [forward, left, rate] = at.twist;
    const vx = c * forward - s * left, vy = s * forward + c * left;
    const points = [];
    scan.ranges.forEach((steps, i) => {
      if (steps === 0) return;
      const range_m = steps * RANGE_STEP_M, t_s = i * scan.beam_interval_s;
      const angle = sensor.theta_rad + scan.first_angle_rad + i * scan.angle_step_rad + rate * t_s;
      points.push(sensor.x_m + vx * t_s + range_m * Math.cos(angle), sensor.y_m + vy * t_s + range_m * Math.sin(angle));
    });
    shownScan.points = points;
    shownScan.isFinal = at.isFinal;
  }

  #drawVehicle() {
    const { context, camera, colours } = this;
    const pose = this.track.last;
    if (!pose) return;
    const colour = this.isLive ? colours.vehicle : colours.stale;
    context.save();
    context.translate(pose.x_m, pose.y_m);
    context.rotate(pose.theta_rad);
    const { major_m, minor_m, direction_rad, heading_rad } = ellipse(pose.covariance);
    const size_m = Math.max(VEHICLE_M, VEHICLE_PIXELS / camera.scale);
    context.lineWidth = 2 / camera.scale;
    context.strokeStyle = colour;
    context.fillStyle = colour;
    context.globalAlpha = 0.25;
    context.beginPath();
    context.ellipse(0, 0, Math.min(major_m, 1000), Math.min(minor_m, 1000), direction_rad, 0, 2 * Math.PI);
    context.fill();
    context.beginPath(); // where it may be heading
    const wedge = Math.min(heading_rad, Math.PI);
    context.moveTo(0, 0);
    context.arc(0, 0, 1.6 * size_m, -wedge, wedge);
    context.closePath();
    context.fill();
    context.globalAlpha = 1;
    context.beginPath();
    context.ellipse(0, 0, Math.min(major_m, 1000), Math.min(minor_m, 1000), direction_rad, 0, 2 * Math.PI);
    context.stroke();
    context.beginPath();
    context.moveTo(0.6 * size_m, 0);
    context.lineTo(-0.4 * size_m, 0.35 * size_m);
    context.lineTo(-0.2 * size_m, 0);
    context.lineTo(-0.4 * size_m, -0.35 * size_m);
    context.closePath();
    context.fill();
    context.strokeStyle = colours.paper;
    context.stroke();
    context.restore();
  }
}

/** Numbers of a message; NaN where JSON has null: not known. */
const known = (numbers) => numbers.map((number) => number ?? NaN);

/** 1, 2 or 5 times a power of ten, at least `least`. */
export const niceLength = (least) => {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((k) => k * power).find((length) => length >= least * (1 - 1e-9));
};

/** Length and words of a scale bar that is at most `most` pixels long. */
export const scaleBar = (pixels_per_m, most) => {
  const length_m = [5, 2, 1].map((k) => k * 10 ** Math.floor(Math.log10(most / pixels_per_m)))
    .find((length) => length * pixels_per_m <= most);
  return { pixels: length_m * pixels_per_m, text: length_m < 1 ? `${Math.round(100 * length_m)} cm` : metres(length_m).replace(".00", "") };
};

const jumps = (before, pose) => Math.hypot(pose.x_m - before.x_m, pose.y_m - before.y_m)
  > JUMP_M + FASTEST_MPS * Math.abs(pose.stamp_s - before.stamp_s);
