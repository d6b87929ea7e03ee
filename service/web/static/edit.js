// The area Edit: what a person changes in a stored map, or in that of a running session. Of a stored map each change is
// a version. The service makes the change.

import { BeforeAfter } from "./before_after.js";
import { byId, card, confirmed, element, notice, setRefused, setText } from "./dom.js";
import { EditCut, EditDraw } from "./edit_draw.js";
import { EditLoops } from "./edit_loops.js";
import { EditPairs } from "./edit_pairs.js";
import { KeyframeTool, PairTool } from "./edit_tools.js";
import { LiveEdit } from "./edit_live.js";
import { clockTime, counted } from "./format.js";
import { Keyframes } from "./keyframes.js";
import { GRAPH_PROFILE } from "./profile_card.js";
import { Swipe } from "./swipe.js";
import { chooseTab } from "./tabs.js";

const SHOWN = 8; // versions; the rest on demand
const LIVE_VERBS = ["save_map", "edit_map"]; // by which the map of a running session is changed
const LIVE_WORDS = "Each change is made beside the mapping, which goes on; Undo takes the newest one back.";
const FETCH_WORDS = "To join places and to cut, the map is saved, and its key frames are fetched: this takes some seconds. Later ones are not among them.";

/** Why the map of a running session takes no change; "": it does. */
const whyNot = ({ mode, configured_mode, profile = GRAPH_PROFILE }) => {
  if (profile !== GRAPH_PROFILE) return `The profile ${profile} changes no map while it maps; ${GRAPH_PROFILE} does. A saved map can be edited with corridor view.`;
  if (mode !== "localization") return "";
  return `The vehicle is only localised, and the map stays as it is. To edit it, ${configured_mode === mode ? "change mode: localization in the config" : "choose Map again under Control"}.`;
};

/** What the service of a stored map takes. */
const asStored = (change) => (change.what !== "add-pair" ? change
  : { ...change, pairs: change.pairs.map(({ points, places }) => ({ points, keyframes: places.map(({ keyframe }) => keyframe) })) });

export class Edit {
  /** setTool(tool): put a tool to work on the map, null: none. */
  constructor(root, connection, view, setTool) {
    this.connection = connection;
    this.view = view;
    this.setTool = setTool;
    this.live = new LiveEdit(connection);
    this.whyNot = ""; // the map of the running session is not changed
    this.isOffered = this.isLive = this.isBusy = this.showsAll = false;
    this.version = 0; // of the map that is shown; 0: not known yet
    this.versions = [];
    this.keyframes = new Keyframes();
    this.evidence = {}; // of the loops of a running session
    this.tool = null;

    this.note = element("p", { id: "edit-note", role: "status", tabIndex: 0 }); // it may be long, and scrolls then
    this.who = element("input", { type: "text", id: "edit-who", maxLength: 100, autocomplete: "off" });
    this.reported = null; // of the newest change: {words, level}
    this.undoButton = element("button", { type: "button", id: "edit-undo", onclick: () => this.undo() }, "Undo");
    this.list = element("ul", { className: "stored", id: "versions", "aria-label": "Versions of the map" });
    this.compare = new BeforeAfter(view);
    this.pairs = new EditPairs(this);
    this.loops = new EditLoops(this);
    this.swipe = new Swipe(view);
    this.drawing = new EditDraw(this);
    this.cut = new EditCut(this);
    const versions = card("Versions");
    this.versionsCard = versions.node;
    this.undoRow = element("div", { className: "row" }, this.undoButton, this.compare.toggle, this.compare.flicker);
    this.count = versions.aside;
    this.fetchButton = element("button", { type: "button", id: "fetch-keyframes", onclick: () => this.#fetch() });
    this.fetched = card("Key frames", element("p", { className: "note" }, FETCH_WORDS), element("div", { className: "row" }, this.fetchButton));
    versions.node.append(
      element("div", { className: "row" }, element("label", { for: "edit-who" }, "Your name"), this.who), this.list);
    this.all = element("fieldset", { className: "areas", "aria-label": "Changes of the map", "aria-describedby": this.note.id },
      element("div", { className: "edit-head" }, this.note, this.undoRow),
      element("div", { className: "cards" }, this.fetched.node, this.pairs.card.node, this.drawing.card.node, this.cut.card.node, versions.node, this.loops.card.node));
    root.append(this.all);
    this.update();
  }

  putVerbs({ verbs }) {
    this.isOffered = verbs.includes("map_edit");
    this.isLive = !this.isOffered && LIVE_VERBS.every((verb) => verbs.includes(verb));
    if (this.isLive) {
      this.forget();
      this.loops.put(this.evidence);
    }
    byId("tab-edit").hidden = !this.isOffered && !this.isLive;
    this.update();
  }

  /** The token was shown, or the connection is another one. */
  putAccess() {
    if (this.connection.mayControl && this.isOffered) this.look();
    this.update();
  }

  /** Somebody else may have changed the map. */
  putHealth({ statuses }) {
    const why = whyNot(statuses.find(({ name }) => name === "mapping")?.values ?? {});
    if (why !== this.whyNot) {
      this.whyNot = why;
      this.update();
    }
    const version = Number(statuses.find(({ name }) => name === "mapping")?.values.version ?? 0);
    if (this.version && version && version !== this.version && !this.isBusy) this.look();
  }

  update() {
    const may = this.connection.mayControl, isSeen = this.version > 0, hasKeyframes = this.keyframes.count > 0;
    this.all.disabled = !may || this.isBusy || (this.isLive && this.whyNot !== "") || !(isSeen || this.isLive);
    if (!this.isBusy) this.#showNote(may);
    this.versionsCard.hidden = this.isLive;
    this.fetched.node.hidden = !this.isLive;
    setText(this.fetched.aside, hasKeyframes && this.isLive ? `${this.keyframes.count}, ${clockTime(this.fetchedAt_s)}` : "");
    setText(this.fetchButton, hasKeyframes ? "Fetch them again" : "Fetch them");
    this.pairs.card.node.hidden = this.cut.card.node.hidden = this.isLive ? !hasKeyframes : isSeen && !hasKeyframes;
    this.pairs.update();
    this.drawing.update();
    this.cut.update();
    this.#showVersions();
  }

  /** What was looked at is of the map no more. */
  forget() {
    this.version = 0;
    this.keyframes = new Keyframes();
    this.live.clear();
    this.pairs.clear();
    this.pairs.put([], []);
  }

  async #fetch() {
    this.forget();
    this.isBusy = true;
    this.update();
    this.note.dataset.level = "none";
    setText(this.note, "Key frames: the map is saved, and they are read \u2026");
    const answer = await this.live.look(), isGraph = answer.ok && answer.keyframes;
    this.isBusy = false;
    this.#take(answer);
    this.say(isGraph ? `Fetched: ${counted(answer.keyframes.count, "key frame")}` : `Key frames: ${answer.error ?? "there are none; the profile makes none, or the vehicle is not found in the map yet"}`, isGraph ? "ok" : "error");
    this.update();
  }

  /** Of a running session: what it answered of its map; null: nothing. */
  #take(answer) {
    if (!answer?.ok || !answer.keyframes) {
      this.forget();
      return;
    }
    [this.version, this.keyframes, this.fetchedAt_s] = [answer.version, new Keyframes(answer.keyframes), Date.now() / 1000];
    this.pairs.put(answer.pairs, answer.passes);
    this.view.invalidate();
  }

  /** Fetch the present state of the map; whether that was answered. */
  async look() {
    const answer = await this.connection.command("map_look");
    if (!answer.ok) {
      this.say(answer.error, "error");
      return false;
    }
    [this.version, this.versions, this.keyframes] = [answer.version, answer.versions, new Keyframes(answer.keyframes)];
    if (!this.who.value) this.who.value = answer.user;
    this.update();
    this.pairs.put(answer.pairs, answer.passes);
    this.loops.put(answer.loops);
    this.view.invalidate();
    return true;
  }

  /** Of a running session: its loops, as the graph shows them. */
  putGraph({ evidence }) {
    this.evidence = evidence;
    if (this.isLive) this.loops.put(evidence);
  }

  /** Numbers of the two key frames of a loop, fetched where that was not done yet; null where they cannot be. */
  async keyframesOf({ keyframes, from_s, back_at_s }) {
    if (!this.isLive) return keyframes;
    if (!this.keyframes.reaches(back_at_s)) await this.#fetch();
    return this.keyframes.reaches(back_at_s) ? [from_s, back_at_s].map((at_s) => this.keyframes.closestTo(at_s)) : null;
  }

  /** The points of a key frame; resolves to {ok, pose?, points?, error?}. */
  keyframe(keyframe) {
    return this.isLive ? this.live.keyframe(keyframe) : this.connection.command("map_keyframe", { version: this.version, keyframe });
  }

  /** Make a change; whether it was made. */
  change(change, label) {
    const who = this.who.value.trim();
    if (!this.isLive) return this.#carryOut(label, () => this.connection.command("map_edit", { version: this.version, who, change: asStored(change) }));
    return this.#carryOut(label, () => this.live.change(change, who));
  }

  /** make(): resolves to {ok, done?, error?, looked?}. */
  async #carryOut(label, make) {
    this.endTool();
    this.isBusy = true;
    this.update();
    this.note.dataset.level = "none";
    setText(this.note, `${label}: the map is being changed \u2026`);
    this.compare.keep();
    const answer = await make();
    if (answer.ok) this.compare.made();
    const isSeen = this.isLive || await this.look();
    if (answer.looked) this.#take(answer.looked);
    this.isBusy = false; // the outcome is shown when the next change can be made, not before
    const unseen = answer.looked && !answer.looked.ok ? `; its key frames could not be fetched: ${answer.looked.error}` : "";
    if (isSeen || !answer.ok) this.say(`${label}: ${answer.ok ? answer.done + unseen : answer.error}`, answer.ok && !unseen ? "ok" : "error");
    this.update();
    return answer.ok;
  }

  undo() {
    return this.change({ what: "undo" }, "Undo");
  }

  /** On top of the area, until the next change; as a notice where the area is not shown. */
  say(words, level) {
    this.reported = { words: `${words}.`, level };
    this.#showNote(this.connection.mayControl);
    if (this.note.offsetParent === null) notice(`${words}.`, level);
  }

  #showNote(may) {
    const { words, level } = !may ? { level: "none", words: "You may look. To edit, enter the token under Control." }
      : this.isLive && this.whyNot ? { level: "none", words: this.whyNot }
      : this.reported ?? { level: "none", words: this.isLive ? LIVE_WORDS : "Each change is a new version of the stored map, and can be taken back." };
    this.note.dataset.level = level;
    setText(this.note, words);
  }

  /** Have a key frame clicked on the map. */
  pickKeyframe(what, chosen) {
    this.beginTool(new KeyframeTool(this.view, this.keyframes, what, (k) => {
      this.endTool();
      chooseTab("edit", { onlyOnPhone: true });
      chosen(k);
    }));
  }

  /** ended(): the tool is at work no more, for whatever reason. */
  beginTool(tool, ended = () => {}) {
    if (!(tool instanceof PairTool) && !(tool instanceof KeyframeTool)) this.pairs.closePane(); // one map to draw on
    this.setTool(tool); // ends the one before
    byId("map").focus({ preventScroll: true }); // for who works with keys
    this.tool = tool;
    tool.ended = () => {
      this.tool = null;
      ended();
      this.pairs.update();
    };
    this.pairs.update();
  }

  endTool() {
    if (this.tool) this.setTool(null);
  }

  draw(context, camera, colours) {
    if (this.view.showsBefore) return; // what is chosen lies on the map as it is
    this.cut.draw(context, camera, colours);
    this.pairs.draw(context, camera, colours);
  }

  #showVersions() {
    const newest = [...this.versions].reverse(), shown = this.showsAll ? newest : newest.slice(0, SHOWN);
    setText(this.count, this.version ? `now ${this.version}` : "");
    const canUndo = this.isLive ? this.live.undoable : newest.some((version) => version.is_current && version.what !== "saved");
    setRefused(this.undoButton, canUndo ? "" : "There is no change to take back");
    this.list.replaceChildren(...shown.map((version) => this.#entry(version)));
    if (newest.length <= shown.length) return;
    const all = () => { this.showsAll = true; this.#showVersions(); };
    this.list.append(element("li", {}, element("button", { type: "button", onclick: all }, `Show all ${newest.length}`)));
  }

  #entry({ version, is_current, saved, who, words }) {
    const when = new Date(saved).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
    const entry = element("li", {}, element("p", { className: "stored-name" }, `${version}: ${words}`),
      element("p", { className: "note" }, `${who === "-" ? "" : `${who}, `}${when}${is_current ? ", the present one" : ""}`));
    if (!is_current) {
      entry.append(element("div", { className: "row" },
        element("button", { type: "button", onclick: () => this.#goBack(version) }, `Go back to version ${version}\u2026`),
        element("button", { type: "button", onclick: () => this.#compareWith(version) }, "Compare")));
    }
    return entry;
  }

  async #compareWith(version) {
    const answer = await this.connection.command("map_version", { version });
    if (!answer.ok) this.say(answer.error, "error");
    else {
      await this.swipe.show(answer, this.version);
      chooseTab("map", { onlyOnPhone: true });
    }
  }

  async #goBack(version) {
    const isSure = await confirmed(`Go back to version ${version}?`, "What it holds becomes the newest version; those between stay, and Undo leads forward again.", "Go back");
    if (isSure) this.change({ what: "undo", to: version }, "Go back");
  }
}
