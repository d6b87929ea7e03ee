// The two maps that the area Edit changes: a stored one, and that of a running session. Both have
//   look(): its key frames and pairs as they are now; resolves to {ok, keyframes?, pairs?, user?, error?};
//   keyframe(k, version): the points of one; change(change, who, version): resolves to {ok, done?, error?, looked?}.

import { square } from "./canvas.js";
import { distance, leastIndex, seenFrom } from "./geometry.js";

/** A change in the words of the service: pairs of points as toPair makes them. */
const worded = (change, toPair) => (change.what === "add-pair" ? { ...change, pairs: change.pairs.map(toPair) } : change);

export class StoredMap {
  constructor(connection) {
    this.connection = connection;
  }

  look() {
    return this.connection.command("map_look");
  }

  keyframe(keyframe, version) {
    return this.connection.command("map_keyframe", { version, keyframe });
  }

  change(change, who, version) {
    const toPair = ({ points, places }) => ({ points, keyframes: places.map(({ keyframe }) => keyframe) });
    return this.connection.command("map_edit", { version, who, change: worded(change, toPair) });
  }
}

/** Changed beside the mapping, which goes on: key frames go by their stamps, for more come, and points as these saw them. */
export class LiveMap {
  undoable = 0; // changes that Undo takes back

  constructor(connection) {
    this.connection = connection;
    this.forget();
  }

  forget() {
    this.seen = ""; // which look the key frames are of
    this.map = ""; // name of the map they are of
  }

  async look() {
    const saved = await this.connection.command("save_map");
    if (!saved.ok) return saved;
    const name = saved.folder.split("/").at(-1), answer = await this.connection.resource({ action: "look", kind: "map", name });
    if (answer.ok) [this.seen, this.map] = [answer.seen, name];
    return answer;
  }

  keyframe(keyframe) {
    return this.connection.resource({ action: "keyframe", kind: "map", name: this.map, request: { seen: this.seen, keyframe } });
  }

  /** looked: the answer of look() for the changed map, where it was called before. */
  async change(change, who) {
    const toPair = ({ points, places }) => ({ stamps_ns: places.map(({ stamp_ns }) => stamp_ns),
      points_base: points.map((point, i) => seenFrom(places[i].pose, point)) });
    const answer = await this.connection.command("edit_map", { who, change: worded(change, toPair) });
    if (!answer.ok) return answer;
    this.undoable = answer.undoable;
    return { ...answer, looked: this.seen ? await this.look() : null };
  }
}

const PATH_APART_M = 10; // key frames of so much path between them are of two passes
const SAME_S = 0.02; // times are rounded

export class Keyframes {
  /** answer: of the service's map_look; null where the map has none. */
  constructor(answer) {
    const { count = 0, every = 1, x_m = [], y_m = [], at_s = [] } = answer ?? {};
    Object.assign(this, { count, every, at_s });
    this.points = x_m.map((x, i) => [x, y_m[i]]);
    this.path_m = [];
    this.points.forEach((point, i) => this.path_m.push(i ? this.path_m[i - 1] + distance(point, this.points[i - 1]) : 0));
  }

  at(k) {
    return this.points[this.#index(k)];
  }

  seconds(k) {
    return this.at_s[this.#index(k)];
  }

  /** Whether they are of a drive until then, s after the first one. */
  reaches(at_s) {
    return this.at_s.length > 0 && at_s <= this.at_s.at(-1) + SAME_S;
  }

  closestTo(at_s) {
    return this.#least((_, i) => Math.abs(this.at_s[i] - at_s));
  }

  /** Number of the key frame that is nearest to a point of the screen; null where none is within some pixels. */
  nearest(camera, point, pixels) {
    return this.#least((at) => distance(camera.toScreen(...at), point), pixels);
  }

  /** The key frame nearest to k that was driven in another pass; null where there is only one. */
  otherPass(k) {
    const path_m = this.path_m[this.#index(k)], here = this.at(k);
    return this.#least((at, i) => (Math.abs(this.path_m[i] - path_m) < PATH_APART_M ? Infinity : distance(at, here)));
  }

  draw(context, camera, colour) {
    context.fillStyle = colour;
    for (const point of this.points) square(context, camera.toScreen(...point), 4);
  }

  #index(k) {
    return Math.min(Math.round(k / this.every), this.points.length - 1);
  }

  /** See leastIndex; null where there is none. */
  #least(value, most) {
    const i = leastIndex(this.points, value, most);
    return i < 0 ? null : i * this.every;
  }
}
