// The area Resources: stored maps and sessions; to have, to load, to name, to delete and to take back.

import { button, byId, confirmed, element, fileName, NO_TOKEN, note, notice, noticeOf, onClick, row, select, setRefused, setText } from "./dom.js";
import { bytes, dateTime } from "./format.js";
import { GRAPH_PROFILE, valuesOf } from "./health.js";

const KINDS = ["map", "session"];
const SHOWN = 30; // of a kind; the rest on demand

export class Resources {
  formats = {};
  verbs = [];
  written = ""; // what the service writes to
  mapping = {}; // values of health

  /** lastPose(): {x_m, y_m, theta_rad} of the vehicle in the present map, null where it is not known now. */
  constructor(root, connection, lastPose) {
    Object.assign(this, { root, connection, lastPose });
    onClick("refresh", () => this.refresh());
  }

  putHealth(health) {
    this.mapping = valuesOf(health, "mapping");
    const written = `${valuesOf(health, "map").folder} ${valuesOf(health, "recording").file} ${this.mapping.profile}`;
    if (written === this.written) return;
    this.written = written;
    if (!this.root.hidden) this.refresh();
  }

  async refresh() {
    const answer = await this.connection.resource({ action: "list" });
    if (!answer.ok) {
      notice(`Resources: ${answer.error}.`, "error");
      return;
    }
    this.formats = answer.formats;
    for (const kind of KINDS) this.#show(kind, answer[kind], SHOWN);
  }

  #show(kind, entries, most) {
    const list = byId(`${kind}-list`);
    setText(byId(`${kind}-total`), `${entries.length}, ${bytes(entries.reduce((sum, entry) => sum + entry.bytes, 0))}`);
    list.replaceChildren(...entries.slice(0, most).map((entry) => this.#entry(kind, entry)));
    if (entries.length === 0) list.append(element("li", { className: "note" }, "None stored."));
    if (entries.length > most) list.append(element("li", {}, button(`Show all ${entries.length}`, () => this.#show(kind, entries, Infinity))));
  }

  #entry(kind, { name, bytes: size, changed_s, in_use, has_graph }) {
    const format = select({ "aria-label": `Format of ${name}` }, this.formats[kind].map((one) => [one, one]));
    const act = (text, onclick, refused, className = "") => {
      const made = button(text, onclick, { className, "aria-label": `${text} ${name}` });
      setRefused(made, this.connection.mayControl ? refused : NO_TOKEN);
      return made;
    };
    const isWritten = name.endsWith(".active") ? "It is being recorded: stop the recording first" : "", inUse = in_use ? "The service is using it" : "";
    const load = kind === "map" && this.verbs.includes("load_map")
      ? [act("Load\u2026", () => this.#load(name), inUse || this.#whyNotLoaded(has_graph))] : [];
    return element("li", {},
      element("div", { className: "stored-head" }, element("div", {}, element("p", { className: "stored-name" }, ...fileName(name)),
        note(`${bytes(size)}, ${dateTime(1000 * changed_s)}${in_use ? ", in use" : ""}`)), ...load),
      row(format, act("Download", () => this.#download(kind, name, format.value), isWritten),
        act("Rename\u2026", () => this.#rename(kind, name), inUse), act("Delete\u2026", () => this.#delete(kind, name), inUse, "danger")));
  }

  #whyNotLoaded(hasGraph) {
    const { profile = GRAPH_PROFILE } = this.mapping;
    if (profile !== GRAPH_PROFILE) return `The profile ${profile} begins in no stored map; ${GRAPH_PROFILE} does`;
    return hasGraph ? "" : "It holds a picture without key frames: no session can begin in it";
  }

  async #download(kind, name, to) {
    notice(`${name} is being made ready as ${to}.`);
    const answer = await this.connection.resource({ action: "download", kind, name, to });
    if (answer.ok) element("a", { href: answer.url, download: "" }).click();
    else notice(`${name}: ${answer.error}.`, "error");
  }

  async #load(name) {
    const isFixed = this.mapping.configured_mode === "localization"; // it is localised anyway
    const choice = await confirmed(`Load ${name}?`, `The present map is saved and closed. The vehicle goes on in this one: ${isFixed ? "it" : "it maps there, or"} is only localised, and the map stays as it is. `
      + "It is lost until it is found there; Set pose helps it. The recording goes on.", isFixed ? "Load and localise" : "Load and map", null, !isFixed && this.verbs.includes("set_mode") ? "Load and localise" : "");
    if (!choice) return;
    const pose = this.lastPose(), answer = await this.connection.command("load_map", { map: name });
    const mode = answer.ok && choice === "other" ? await this.connection.command("set_mode", { mode: "localization" }) : answer;
    const loaded = `${name} is loaded${answer.folder_before ? `, the map before is in ${answer.folder_before}` : ""}`;
    if (answer.ok && !mode.ok) notice(`${loaded}, but the vehicle maps in it: ${mode.error}.`, "error");
    else if (!answer.ok || !pose) noticeOf(`Load ${name}`, answer, loaded);
    else notice(`${loaded}. Is it a copy of that one, and the vehicle where it was?`, "ok", { text: "Set its pose", act: () => this.#setPose(pose) });
    this.refresh();
  }

  async #setPose({ x_m, y_m, theta_rad }) {
    noticeOf("Set pose", await this.connection.command("set_pose", { x_m, y_m, theta_rad }), "The vehicle is looked for where it was");
  }

  async #rename(kind, name) {
    const to = await confirmed(`Rename ${name}`, "The new name: letters, digits, _ . and -", "Rename", name);
    if (!to || to === name) return;
    const answer = await this.connection.resource({ action: "rename", kind, name, to });
    noticeOf(name, answer, `${name} is called ${answer.name} now`);
    this.refresh();
  }

  async #delete(kind, name) {
    const isSure = await confirmed(`Delete ${name}?`, "It can be taken back until the service starts again; then it is erased.", "Delete");
    if (!isSure) return;
    const answer = await this.connection.resource({ action: "delete", kind, name });
    if (answer.ok) notice(`${name} is deleted.`, "none", { text: "Undo", act: () => this.#undo(answer.undo) });
    else notice(`${name}: ${answer.error}.`, "error");
    this.refresh();
  }

  async #undo(to) {
    const answer = await this.connection.resource({ action: "undo", to });
    noticeOf("Undo", answer, `${answer.name} is back`);
    this.refresh();
  }
}
