// Changes the map of a running session: the service makes each change beside the mapping, which goes on.

import { seenFrom } from "./geometry.js";

const lastName = (folder) => folder.split("/").at(-1);

/** What the service of a running session takes: key frames by stamp, for more come, and points as these saw them. */
const asLive = (change) => (change.what !== "add-pair" ? change : { ...change,
  pairs: change.pairs.map(({ points, places }) => ({
    stamps_ns: places.map(({ stamp_ns }) => stamp_ns), points_base: points.map((point, i) => seenFrom(places[i].pose, point)),
  })) });

export class LiveEdit {
  constructor(connection) {
    this.connection = connection;
    this.undoable = 0; // changes that Undo takes back
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
    if (!saved.ok) return saved;
    const map = lastName(saved.folder), answer = await this.connection.resource({ action: "look", kind: "map", name: map });
    if (answer.ok) [this.seen, this.map] = [answer.seen, map];
    return answer;
  }

  keyframe(keyframe) {
    return this.connection.resource({ action: "keyframe", kind: "map", name: this.map, request: { seen: this.seen, keyframe } });
  }

  /** Resolves to {ok, done?, error?, looked?}. looked: the answer of look() for the changed map, where it was called before. */
  async change(change, who) {
    const answer = await this.connection.command("edit_map", { who, change: asLive(change) });
    if (!answer.ok) return answer;
    this.undoable = answer.undoable;
    return { ...answer, looked: this.seen ? await this.look() : null };
  }
}
