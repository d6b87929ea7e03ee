// Changes the map of a running session: a copy is saved, changed, and the mapping goes on in it.

import { compose } from "./geometry.js";

const STEPS = ["a copy of the map is saved", "the copy is changed", "the mapping goes on in the copy"];
const POSE_WAIT_MS = 5000; // for the first pose in the copy

/** Of map.directory: what no other copy is called, such as edited-20261123T053000Z. */
const copyName = () => `edited-${new Date().toISOString().replace(/[-:]|\.\d+/g, "")}`;

const lastName = (folder) => folder.split("/").at(-1);

export class LiveEdit {
  /** lastPose(): of the vehicle, null where it is not known now. */
  constructor(connection, lastPose) {
    this.connection = connection;
    this.lastPose = lastPose;
    this.before = null; // folder of the map before the newest change
    this.awaited = null; // first pose of a map that is being loaded: {settle, isBegun}
    this.clear();
  }

  /** Forget what was looked at. */
  clear() {
    this.seen = ""; // which look the key frames are of
    this.map = ""; // name of the map they are of
  }

  /** Key frames and pairs of the map as it is now; resolves to {ok, keyframes?, pairs?, user?, error?}. */
  async look() {
    const saved = await this.connection.command("save_map");
    return saved.ok ? this.#lookAt(lastName(saved.folder)) : saved;
  }

  async #lookAt(map) {
    const told = await this.connection.resource({ action: "look", kind: "map", name: map });
    if (told.ok) [this.seen, this.map] = [told.seen, map];
    return told;
  }

  keyframe(keyframe) {
    return this.connection.resource({ action: "keyframe", kind: "map", name: this.map, request: { seen: this.seen, keyframe } });
  }

  /** say(words): how far it is. Resolves to {ok, done?, error?, told?}; where it is refused, the session goes on as before.
   * told: what look() would say of the copy, where somebody has looked before. */
  async change(change, who, say) {
    const copy = copyName(), steps = [
      () => this.connection.command("save_map", { name: copy }),
      () => this.connection.resource({ action: "edit", kind: "map", name: copy, request: { seen: this.seen, who, change } }),
      () => this.#load(copy),
    ];
    let done = "";
    for (const [i, step] of steps.entries()) {
      say(`${i + 1} of ${steps.length}: ${STEPS[i]}`);
      const answer = await step();
      if (!answer.ok) return { ok: false, error: `${answer.error}; the map of the session is as it was` };
      done = answer.done ?? done;
    }
    const told = this.seen ? await this.#lookAt(copy) : null;
    return { ok: true, done: `${done}; the mapping goes on in ${copy}`, told };
  }

  /** Go on in the map before the newest change; resolves to {ok, done?, error?}. */
  async undo() {
    const answer = await this.#load(this.before);
    this.clear();
    return answer.ok ? { ok: true, done: "the mapping goes on in the map before" } : answer;
  }

  /** The map that is shown begins anew: what comes from now on is of the new one. */
  mapBegan() {
    if (this.awaited) this.awaited.isBegun = true;
  }

  /** Somebody may wait for the first one of a map. */
  putPose(pose) {
    if (this.awaited?.isBegun) this.awaited.settle(pose);
  }

  /** The vehicle is looked for where it was before, and by as much farther as it has driven since: poses begin at (0, 0, 0). */
  async #load(map) {
    const before = this.lastPose();
    const first = new Promise((settle) => { this.awaited = { settle, isBegun: false }; });
    const answer = await this.connection.command("load_map", { map });
    if (answer.ok) this.before = answer.folder_before ?? null;
    const late = new Promise((settle) => setTimeout(() => settle(null), POSE_WAIT_MS));
    const since = answer.ok && before ? await Promise.race([first, late]) : null;
    this.awaited = null;
    if (since) {
      const { x_m, y_m, theta_rad } = compose(before, since);
      await this.connection.command("set_pose", { x_m, y_m, theta_rad }); // refused where it was found already
    }
    return answer;
  }
}
