// The area Resources: stored maps and sessions; to have, to load, to name, to delete and to take back.

import { card, confirmed, element, fileName, NO_TOKEN, notice, setRefused, setText } from "./dom.js";
import { bytes } from "./format.js";
import { GRAPH_PROFILE } from "./profile_card.js";

const KINDS = { map: "Maps", session: "Sessions" };
const SHOWN = 30; // of a kind; the rest on demand

export class Resources {
  /** lastPose(): {x_m, y_m, theta_rad} of the vehicle in the present map, null where it is not known now. */
  constructor(root, connection, lastPose) {
    this.connection = connection;
    this.lastPose = lastPose;
    this.formats = {};
    this.lists = {};
    this.verbs = [];
    this.written = ""; // what the service writes to
    this.mapping = {}; // what health tells of it
    this.root = root;
    const refresh = element("button", { type: "button", onclick: () => this.refresh() }, "Refresh");
    root.append(element("div", { className: "row" }, refresh,
      element("span", { className: "note" }, "Deleted things can be taken back until the service starts again.")));
    for (const [kind, title] of Object.entries(KINDS)) {
      const { node, aside } = card(title);
      const list = element("ul", { className: "stored" });
      if (kind === "map") node.append(element("p", { className: "note" }, "The command corridor view shows a stored map, and edits it."));
      node.append(list);
      root.append(node);
      this.lists[kind] = { list, aside };
    }
  }

  /** Another map is loaded, another recording begun. */
  putHealth({ statuses }) {
    const values = (name) => statuses.find((status) => status.name === name)?.values ?? {};
    this.mapping = values("mapping");
    const written = `${values("map").folder} ${values("recording").file} ${this.mapping.profile}`;
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
    for (const kind of Object.keys(KINDS)) this.#show(kind, answer[kind]);
  }

  #show(kind, entries) {
    const { list, aside } = this.lists[kind];
    const size = entries.reduce((sum, entry) => sum + entry.bytes, 0);
    setText(aside, `${entries.length}, ${bytes(size)}`);
    list.replaceChildren(...entries.slice(0, SHOWN).map((entry) => this.#entry(kind, entry)));
    if (entries.length === 0) list.append(element("li", { className: "note" }, "None stored."));
    if (entries.length > SHOWN) {
      const all = element("button", { type: "button" }, `Show all ${entries.length}`);
      all.addEventListener("click", () => list.replaceChildren(...entries.map((entry) => this.#entry(kind, entry))));
      list.append(element("li", {}, all));
    }
  }

  #entry(kind, entry) {
    const may = this.connection.mayControl;
    const when = new Date(1000 * entry.changed_s).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
    const format = element("select", { "aria-label": `Format of ${entry.name}` },
      ...this.formats[kind].map((name) => element("option", { value: name }, name)));
    const act = (text, label, onclick, refused, className = "") => {
      const button = element("button", { type: "button", className, onclick, "aria-label": `${text} ${label}` }, text);
      setRefused(button, may ? refused : NO_TOKEN);
      return button;
    };
    const isBeingWritten = entry.name.endsWith(".active"), inUse = entry.in_use ? "The service is using it" : "";
    const load = kind === "map" && this.verbs.includes("load_map")
      ? [act("Load\u2026", entry.name, () => this.#load(entry.name), inUse || this.#whyNotLoaded(entry))] : [];
    return element("li", {},
      element("div", { className: "stored-head" }, element("div", {},
        element("p", { className: "stored-name" }, ...fileName(entry.name)),
        element("p", { className: "note" }, `${bytes(entry.bytes)}, ${when}${entry.in_use ? ", in use" : ""}`)), ...load),
      element("div", { className: "row" }, format,
        act("Download", entry.name, () => this.#download(kind, entry.name, format.value), isBeingWritten ? "It is being recorded: stop the recording first" : ""),
        act("Rename\u2026", entry.name, () => this.#rename(kind, entry.name), inUse),
        act("Delete\u2026", entry.name, () => this.#delete(kind, entry.name), inUse, "danger")));
  }

  #whyNotLoaded({ has_graph }) {
    const { profile = GRAPH_PROFILE } = this.mapping;
    if (profile !== GRAPH_PROFILE) return `The profile ${profile} begins in no stored map; ${GRAPH_PROFILE} does`;
    return has_graph ? "" : "It holds a picture without key frames: no session can begin in it";
  }

  async #download(kind, name, to) {
    notice(`${name} is being made ready as ${to}.`);
    const answer = await this.connection.resource({ action: "download", kind, name, to });
    if (!answer.ok) {
      notice(`${name}: ${answer.error}.`, "error");
      return;
    }
    element("a", { href: answer.url, download: "" }).click();
  }

  /** The mapping goes on in a stored map. */
  async #load(name) {
    const isFixed = this.mapping.configured_mode === "localization"; // it is localised anyway
    const choice = await confirmed(`Load ${name}?`, `The present map is saved and closed. The vehicle goes on in this one: ${isFixed ? "it" : "it maps there, or"} is only localised, and the map stays as it is. `
      + "It is lost until it is found there; Set pose helps it. The recording goes on.", isFixed ? "Load and localise" : "Load and map", null, !isFixed && this.verbs.includes("set_mode") ? "Load and localise" : "");
    if (!choice) return;
    const pose = this.lastPose();
    const answer = await this.connection.command("load_map", { map: name });
    const mode = answer.ok && choice === "other" ? await this.connection.command("set_mode", { mode: "localization" }) : answer;
    const before = answer.folder_before ? `, the map before is in ${answer.folder_before}` : "";
    if (!answer.ok) notice(`Load ${name}: ${answer.error}.`, "error");
    else if (!mode.ok) notice(`${name} is loaded${before}, but the vehicle maps in it: ${mode.error}.`, "error");
    else if (!pose) notice(`${name} is loaded${before}.`, "ok");
    else {
      notice(`${name} is loaded${before}. Is it a copy of that one, and the vehicle where it was?`, "ok",
        { text: "Set its pose", act: () => this.#setPose(pose) });
    }
    this.refresh();
  }

  async #setPose({ x_m, y_m, theta_rad }) {
    const answer = await this.connection.command("set_pose", { x_m, y_m, theta_rad });
    notice(answer.ok ? "The vehicle is looked for where it was." : `Set pose: ${answer.error}.`, answer.ok ? "ok" : "error");
  }

  async #rename(kind, name) {
    const to = await confirmed(`Rename ${name}`, "The new name: letters, digits, _ . and -", "Rename", name);
    if (!to || to === name) return;
    const answer = await this.connection.resource({ action: "rename", kind, name, to });
    notice(answer.ok ? `${name} is called ${answer.name} now.` : `${name}: ${answer.error}.`, answer.ok ? "ok" : "error");
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
    notice(answer.ok ? `${answer.name} is back.` : `Undo: ${answer.error}.`, answer.ok ? "ok" : "error");
    this.refresh();
  }
}
