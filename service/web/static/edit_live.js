// Changes the map of a running session: a copy is saved, changed, and the mapping goes on in it.

import { notice } from "./dom.js";
import { compose } from "./geometry.js";

const STEPS = ["a copy of the map is saved", "the copy is changed", "the mapping goes on in the copy"];
const POSE_WAIT_MS = 5000; // for the first pose in the copy

/** Of map.directory: what no other copy is called, such as edited-20261123T053000Z. */
const copyName = () => `edited-${new Date().toISOString().replace(/[-:]|\.\d+/g, "")}`;

export class LiveEdit {
  /** lastPose(): of the vehicle, null where it is not known now. */
  constructor(connection, lastPose) {
    this.connection = connection;
    this.lastPose = lastPose;
  }

  /** say(words): how far it is. Resolves to {ok, done?, error?}; where it is refused, the session goes on as before. */
  async change(change, say) {
    const copy = copyName(), steps = [
      () => this.connection.command("save_map", { name: copy }),
      () => this.connection.resource({ action: "edit", kind: "map", name: copy, change }),
      () => this.#load(copy),
    ];
    let done = "";
    for (const [i, step] of steps.entries()) {
      say(`${i + 1} of ${steps.length}: ${STEPS[i]}`);
      const answer = await step();
      if (!answer.ok) return { ok: false, error: `${answer.error}; the map of the session is as it was` };
      done = answer.done ?? done;
      if (i + 1 === steps.length && answer.folder_before) this.#offerUndo(answer.folder_before);
    }
    return { ok: true, done: `${done}; the mapping goes on in ${copy}` };
  }

  /** Somebody may wait for the next one. */
  putPose(pose) {
    this.poseCame?.(pose);
  }

  /** The vehicle is looked for where it was before, and by as much farther as it has driven since: poses begin at (0, 0, 0). */
  async #load(map) {
    const before = this.lastPose(), answer = await this.connection.command("load_map", { map });
    const since = answer.ok && before ? await this.#nextPose() : null;
    if (since) {
      const { x_m, y_m, theta_rad } = compose(before, since);
      await this.connection.command("set_pose", { x_m, y_m, theta_rad }); // refused where it was found already
    }
    return answer;
  }

  /** null where none comes. */
  #nextPose() {
    return new Promise((settle) => {
      this.poseCame = settle;
      setTimeout(() => settle(null), POSE_WAIT_MS);
    });
  }

  #offerUndo(folder) {
    notice(`The map before the change is ${folder.split("/").at(-1)}.`, "none", { text: "Undo the change", act: async () => {
      const answer = await this.#load(folder);
      notice(answer.ok ? "The change is undone: the mapping goes on in the map before." : `Undo: ${answer.error}.`, answer.ok ? "ok" : "error");
    } });
  }
}
