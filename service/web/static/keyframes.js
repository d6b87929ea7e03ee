// The key frames of a stored map: where and when each was, and the one that a person means.

const PATH_APART_M = 10; // key frames of so much path between them are of two passes
const SAME_S = 0.02; // times are rounded

export class Keyframes {
  /** answer: of the service's map_look; null where the map has none. */
  constructor(answer = null) {
    this.count = answer?.count ?? 0;
    this.every = answer?.every ?? 1;
    this.x_m = answer?.x_m ?? [];
    this.y_m = answer?.y_m ?? [];
    this.at_s = answer?.at_s ?? [];
    this.way_m = [];
    this.x_m.forEach((x, i) => this.way_m.push(i ? this.way_m[i - 1] + Math.hypot(x - this.x_m[i - 1], this.y_m[i] - this.y_m[i - 1]) : 0));
  }

  /** Map point of key frame k. */
  at(k) {
    const i = this.#index(k);
    return [this.x_m[i], this.y_m[i]];
  }

  seconds(k) {
    return this.at_s[this.#index(k)];
  }

  /** Whether they are of a drive until then, s after the first one. */
  reaches(at_s) {
    return this.at_s.length > 0 && at_s <= this.at_s.at(-1) + SAME_S;
  }

  /** Number of the key frame of that time. */
  closestTo(at_s) {
    return this.every * this.at_s.reduce((best, s, i) => (Math.abs(s - at_s) < Math.abs(this.at_s[best] - at_s) ? i : best), 0);
  }

  /** Number of the key frame that is drawn nearest to a point of the screen; null where none is within some pixels. */
  nearest(camera, [sx, sy], pixels) {
    let least = pixels, found = null;
    for (let i = 0; i < this.x_m.length; i += 1) {
      const [x, y] = camera.toScreen(this.x_m[i], this.y_m[i]);
      const away = Math.hypot(x - sx, y - sy);
      if (away < least) [least, found] = [away, i * this.every];
    }
    return found;
  }

  /** The key frame nearest to k that was driven in another pass; null where there is only one. */
  otherPass(k) {
    const i = this.#index(k), [x, y] = this.at(k);
    let least = Infinity, found = null;
    for (let j = 0; j < this.x_m.length; j += 1) {
      if (Math.abs(this.way_m[j] - this.way_m[i]) < PATH_APART_M) continue;
      const away = Math.hypot(this.x_m[j] - x, this.y_m[j] - y);
      if (away < least) [least, found] = [away, j * this.every];
    }
    return found;
  }

  draw(context, camera, colour) {
    context.fillStyle = colour;
    for (let i = 0; i < this.x_m.length; i += 1) {
      const [x, y] = camera.toScreen(this.x_m[i], this.y_m[i]);
      context.fillRect(x - 2, y - 2, 4, 4);
    }
  }

  #index(k) {
    return Math.min(Math.round(k / this.every), this.x_m.length - 1);
  }
}
