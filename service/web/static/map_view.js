// Draws the map, the path, the scans and the vehicle.

import { MapCanvas } from "./camera.js";
import { colour, drawArrow, niceLength, trace } from "./canvas.js";
import { compose, ellipse, PoseTrack } from "./geometry.js";
import { ChangeLayer, GraphLayer, StandingLayer, StoredChangeLayer } from "./layers.js";
import { RANGE_STEP_M } from "./protocol.js";
import { paletteOf, TileMap } from "./tiles.js";

const STALE_MS = 1500; // older scans and poses are not shown as live
const PATH_STEP_M = 0.05, MAX_PATH_POINTS = 40_000;
const JUMP_M = 1, FASTEST_MPS = 20; // farther than that no vehicle comes: its pose jumped
const LASER_COLOURS = 5;
const MAX_COMING = 50; // scans of a laser
const VEHICLE_M = 0.5, VEHICLE_PIXELS = 22; // length of the arrow, at least
const MAX_ELLIPSE_M = 1000;
const MAX_TIMES = 300;
const LAYERS = { graph: GraphLayer, standing: StandingLayer, stored: StoredChangeLayer }; // made of messages

const rgba = (name) => {
  const canvas = new OffscreenCanvas(1, 1).getContext("2d");
  canvas.fillStyle = colour(name);
  canvas.fillRect(0, 0, 1, 1);
  return [...canvas.getImageData(0, 0, 1, 1).data];
};

export class MapView extends MapCanvas {
  layers = { map: true, path: true, standing: false, graph: false, change: false, stored: true, scans: true, vehicle: true, grid: true };
  follows = true;
  tiles = new TileMap();
  track = new PoseTrack();
  scans = new Map(); // sensor -> {scan}: the newest whose place is known
  coming = new Map(); // sensor -> scans that wait for their poses, which come later where the service is busy
  sensors = []; // lasers in the order of their names: gives each its colour
  mountings = {};
  overlays = []; // functions(context, camera, colours) of the tools
  before = null; // snapshot of an earlier map
  showsBefore = false; // ... and whether it is shown in place of the present one
  other = null; // {tiles, share}: another version of the map, shown in that share of the width
  isHeld = false; // a replay that is paused: what came last is of now, however long ago that was
  poseArrived_ms = -Infinity;
  firstMap_ms = null; // when there was a map on the screen, after the page was opened
  render_ms = []; // how long the last pictures took

  constructor(canvas) {
    super(canvas);
    this.clear();
    this.readColours();
  }

  readColours() {
    this.colours = {
      ground: colour("--map-ground"), grid: colour("--map-grid"), path: colour("--map-path"),
      vehicle: colour("--map-vehicle"), measure: colour("--map-measure"), text: colour("--text"),
      paper: colour("--ground"), stale: colour("--none"),
      palette: paletteOf(rgba("--map-free"), rgba("--map-occupied")),
      change: { appeared: colour("--change-appeared"), gone: colour("--change-gone") },
      standing: { fresh: rgba("--standing-fresh"), full: rgba("--standing-full") },
      graph: { keyFrames: colour("--graph-key-frames"), accepted: colour("--graph-accepted"),
        refused: colour("--graph-refused"), borders: colour("--graph-border") },
      places: { a: colour("--laser-0"), b: colour("--laser-1") }, // no laser is seen where places are chosen
      lasers: Array.from({ length: LASER_COLOURS }, (_, i) => colour(`--laser-${i}`)),
    };
    this.invalidate();
  }

  clear() {
    for (const [name, Layer] of Object.entries(LAYERS)) this[name] = new Layer();
    for (const part of [this.tiles, this.track, this.scans, this.coming]) part.clear();
    this.path = []; // [x_m, y_m, x_m, y_m ...]; NaN, NaN where the pose jumped
    this.moment = null; // of a past that is looked at: {at_s, path}
    this.fitted = null; // the camera as it last showed all; null: nothing is shown yet
    this.compare(false);
  }

  compare(isOn) {
    this.layers.change = isOn;
    this.change = new ChangeLayer(isOn ? this.tiles.copy() : null);
    this.invalidate();
  }

  put(layer, message) {
    this[layer] = new LAYERS[layer](message);
    this.invalidate();
  }

  putTiles({ edge, cell_m, tiles }) {
    for (const tile of tiles) {
      this.tiles.put(tile, edge, cell_m);
      this.change.put(tile, edge, cell_m);
    }
    const isUntouched = this.fitted === null || this.fitted === this.camera.place;
    if (isUntouched && (this.track.last === null || this.moment)) this.#showAll(); // a vehicle is followed all the same when it comes
    this.invalidate();
  }

  putPath({ points, goesOn = false }) {
    this.path = goesOn ? this.path.concat(Array.from(points)) : Array.from(points);
    this.invalidate();
  }

  putPose(pose) {
    const before = this.track.last, { path } = this;
    this.track.add(pose);
    this.poseArrived_ms = performance.now();
    if (before && path.length && jumps(before, pose)) path.push(NaN, NaN);
    const step_m = path.length ? Math.hypot(path.at(-2) - pose.x_m, path.at(-1) - pose.y_m) : Infinity;
    if (!(step_m < PATH_STEP_M)) path.push(pose.x_m, pose.y_m);
    if (path.length > 2 * MAX_PATH_POINTS) this.path = path.filter((metres, i) => i % 4 < 2 || Number.isNaN(metres));
    if (this.follows) this.camera.centreOn(pose.x_m, pose.y_m);
    this.fitted = ""; // what is shown goes by the vehicle
    this.invalidate();
  }

  putMoment({ at_s, poses, path }) {
    if (!this.moment) this.follows = false; // all of the map first
    this.moment = { at_s, path };
    this.track.clear();
    for (const pose of poses) this.track.add({ ...pose, covariance: known(pose.covariance), twist: known(pose.twist) });
    for (const shownScan of this.scans.values()) shownScan.isFinal = false;
    this.follow(this.follows);
  }

  endMoment() {
    if (!this.moment) return;
    this.moment = null;
    for (const part of [this.track, this.scans, this.coming]) part.clear();
    this.invalidate();
  }

  /** Whether it is of a laser that was not seen before. */
  putScan(scan) {
    const isNew = !this.sensors.includes(scan.sensor), coming = this.coming.get(scan.sensor) ?? [];
    if (isNew) this.sensors = [...this.sensors, scan.sensor].sort();
    if (coming.length && scan.stamp_s < coming.at(-1).stamp_s) coming.length = 0; // another run
    coming.push(scan);
    if (coming.length > MAX_COMING) coming.shift();
    this.coming.set(scan.sensor, coming);
    this.invalidate();
    return isNew;
  }

  colourOf(sensor) {
    const index = this.sensors.indexOf(sensor);
    return index < 0 ? null : this.colours.lasers[index % LASER_COLOURS];
  }

  fit() {
    if (this.#showAll()) this.follow(false);
  }

  #showAll() {
    const { bounds } = this.tiles, { x_m = NaN, y_m = NaN } = this.track.last ?? {};
    if (!bounds) return false;
    if (this.track.last) {
      Object.assign(bounds, { x_min_m: Math.min(bounds.x_min_m, x_m), x_max_m: Math.max(bounds.x_max_m, x_m),
        y_min_m: Math.min(bounds.y_min_m, y_m), y_max_m: Math.max(bounds.y_max_m, y_m) });
    }
    this.camera.fit(bounds);
    this.fitted = this.camera.place;
    this.invalidate();
    return true;
  }

  follow(isOn) {
    const { last } = this.track;
    if (isOn && last) this.camera.centreOn(last.x_m, last.y_m);
    super.follow(isOn);
    this.onFollows?.();
  }

  get isLive() {
    if (this.moment) return 1000 * (this.moment.at_s - this.track.last?.stamp_s) < STALE_MS;
    return this.isHeld || performance.now() - this.poseArrived_ms < STALE_MS;
  }

  paint() {
    const began_ms = performance.now(), { context, camera, colours, layers, showsBefore, dpr } = this;
    const { tiles, path, graph } = showsBefore ? this.before : this;
    camera.clear(context, colours.ground, dpr);
    if (layers.map) tiles.draw(context, camera.seen, camera.scale * dpr, colours.palette);
    if (layers.map && this.other) this.#drawOther();
    if (layers.grid) this.#drawGrid();
    if (layers.standing && !showsBefore) this.standing.draw(context, colours.standing);
    if (layers.change) this.change.draw(context, camera.seen, camera.scale, colours.change);
    if (layers.stored && !showsBefore) this.stored.draw(context, camera.seen, camera.scale, colours.change);
    if (layers.path) this.#drawPath(this.moment && !showsBefore ? this.#drivenPath() : path);
    if (layers.graph) graph.draw(context, camera.scale, colours.graph);
    if (layers.scans) this.#drawScans();
    if (layers.vehicle && this.track.last) this.#drawVehicle(this.track.last);
    context.setTransform(dpr, 0, 0, dpr, 0, 0);
    for (const overlay of this.overlays) overlay(context, camera, colours);
    if (tiles.tiles.size > 0) this.firstMap_ms ??= performance.now();
    this.render_ms.push(performance.now() - began_ms);
    if (this.render_ms.length > MAX_TIMES) this.render_ms.shift();
  }

  #drawOther() {
    const { context, camera, canvas, colours, dpr, other } = this, split = Math.round(canvas.width * other.share);
    context.save();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.beginPath();
    context.rect(0, 0, split, canvas.height);
    context.clip();
    camera.clear(context, colours.ground, dpr);
    other.tiles.draw(context, camera.seen, camera.scale * dpr, colours.palette);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = colours.measure;
    context.fillRect(split - 2 * dpr, 0, 2 * dpr, canvas.height);
    context.restore();
  }

  get gridStep_m() {
    return niceLength(90 / this.camera.scale);
  }

  #drawGrid() {
    const { context, camera, gridStep_m: step_m } = this, { x_min_m, y_min_m, x_max_m, y_max_m } = camera.seen;
    context.beginPath();
    for (let x = Math.ceil(x_min_m / step_m) * step_m; x <= x_max_m; x += step_m) trace(context, [[x, y_min_m], [x, y_max_m]]);
    for (let y = Math.ceil(y_min_m / step_m) * step_m; y <= y_max_m; y += step_m) trace(context, [[x_min_m, y], [x_max_m, y]]);
    context.strokeStyle = this.colours.grid;
    context.lineWidth = 1 / camera.scale;
    context.globalCompositeOperation = document.documentElement.dataset.theme === "dark" ? "lighten" : "darken";
    context.stroke();
    context.globalCompositeOperation = "source-over";
  }

  /** As far as it was driven at the moment that is shown, and on to the vehicle. */
  #drivenPath() {
    const { path: [first, end] } = this.moment, { last } = this.track, driven = this.path.slice(2 * first, 2 * end);
    return last && end > first ? [...driven, last.x_m, last.y_m] : driven;
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
    const { context } = this, size_m = Math.max(3 / this.camera.scale, 0.02);
    for (const [sensor, coming] of this.coming) this.#takeScan(sensor, coming);
    for (const sensor of this.shownSensors) {
      const shownScan = this.scans.get(sensor);
      if (!shownScan.isFinal) this.#placeScan(shownScan);
      const points = shownScan.points ?? [];
      context.fillStyle = this.colourOf(sensor);
      for (let i = 0; i < points.length; i += 2) context.fillRect(points[i] - size_m / 2, points[i + 1] - size_m / 2, size_m, size_m);
    }
  }

  /** The newest scan whose place is known, and no older one from then on. */
  #takeScan(sensor, coming) {
    const last = coming.findLastIndex(({ stamp_s }) => this.track.at(stamp_s) !== null);
    if (last >= 0) this.scans.set(sensor, { scan: coming.splice(0, last + 1).at(-1) });
  }

  /** Lasers whose scans are of the pose that is shown, or of the moment of the past. */
  get shownSensors() {
    const now_s = this.moment?.at_s ?? this.track.last?.stamp_s;
    return [...this.scans].filter(([, { scan }]) => {
      const age_ms = 1000 * (now_s - scan.stamp_s);
      return this.moment ? age_ms >= 0 && age_ms <= STALE_MS : this.isLive && Math.abs(age_ms) <= STALE_MS;
    }).map(([sensor]) => sensor).sort();
  }

  /** End points in the map, each beam at its own moment. */
  #placeScan(shownScan) {
    const { scan } = shownScan, at = this.track.at(scan.stamp_s), mounting = this.mountings[scan.sensor];
    shownScan.points = null;
    if (!at || !mounting) return;
    const sensor = compose(at.pose, { x_m: mounting[0], y_m: mounting[1], theta_rad: mounting[2] });
    const c = Math.cos(at.pose.theta_rad), s = Math.sin(at.pose.theta_rad), [forward, left, rate] = at.twist;
    const vx = c * forward - s * left, vy = s * forward + c * left;
    const points = [];
    scan.ranges.forEach((steps, i) => {
      if (steps === 0) return;
      const range_m = steps * RANGE_STEP_M, t_s = i * scan.beam_interval_s;
      const angle = sensor.theta_rad + scan.first_angle_rad + i * scan.angle_step_rad + rate * t_s;
      points.push(sensor.x_m + vx * t_s + range_m * Math.cos(angle), sensor.y_m + vy * t_s + range_m * Math.sin(angle));
    });
    Object.assign(shownScan, { points, isFinal: at.isFinal });
  }

  #drawVehicle(pose) {
    const { context, camera, colours } = this, fill = this.isLive ? colours.vehicle : colours.stale;
    const { major_m, minor_m, direction_rad, heading_rad } = ellipse(pose.covariance);
    const size_m = Math.max(VEHICLE_M, VEHICLE_PIXELS / camera.scale);
    const region = new Path2D(), heading = new Path2D("M 0 0"), wedge = Math.min(heading_rad, Math.PI);
    region.ellipse(0, 0, Math.min(major_m, MAX_ELLIPSE_M), Math.min(minor_m, MAX_ELLIPSE_M), direction_rad, 0, 2 * Math.PI);
    heading.arc(0, 0, 1.6 * size_m, -wedge, wedge);
    context.save();
    context.translate(pose.x_m, pose.y_m);
    context.rotate(pose.theta_rad);
    context.lineWidth = 2 / camera.scale;
    context.strokeStyle = context.fillStyle = fill;
    context.globalAlpha = 0.25;
    context.fill(region);
    context.fill(heading);
    context.globalAlpha = 1;
    context.stroke(region);
    drawArrow(context, size_m, fill, colours.paper);
    context.restore();
  }
}

const known = (numbers) => numbers.map((number) => number ?? NaN);

const jumps = (before, pose) => Math.hypot(pose.x_m - before.x_m, pose.y_m - before.y_m)
  > JUMP_M + FASTEST_MPS * Math.abs(pose.stamp_s - before.stamp_s);
