// The area Edit: what a person changes in a stored map, or in that of a running session. Of a stored map each change is
// a version. The service makes the change.

import { BeforeAfter, Swipe } from "./compare.js";
import { button, byId, confirmed, element, note, notice, onClick, row, setRefused, setText } from "./dom.js";
import { EditCut, EditDraw } from "./edit_draw.js";
import { EditLoops } from "./edit_loops.js";
import { Keyframes, LiveMap, StoredMap } from "./edit_maps.js";
import { EditPairs } from "./edit_pairs.js";
import { KeyframeTool, PairTool } from "./edit_tools.js";
import { clockTime, counted, dateTime } from "./format.js";
import { GRAPH_PROFILE, valuesOf } from "./health.js";
import { chooseTab } from "./tabs.js";

const SHOWN = 8; // versions; the rest on demand
const LIVE_VERBS = ["save_map", "edit_map"]; // by which the map of a running session is changed
const LIVE_WORDS = "Each change is made beside the mapping, which goes on; Undo takes the newest one back.";
const STORED_WORDS = "Each change is a new version of the stored map, and can be taken back.";
const NO_TOKEN_WORDS = "You may look. To edit, enter the token under Control.";
const GO_BACK_WORDS = "What it holds becomes the newest version; those between stay, and Undo leads forward again.";
const NO_KEYFRAMES = "there are none; the profile makes none, or the vehicle is not found in the map yet";

/** Why the map of a running session takes no change; "": it does. */
const whyNot = ({ mode, configured_mode, profile = GRAPH_PROFILE }) => {
  if (profile !== GRAPH_PROFILE) return `The profile ${profile} changes no map while it maps; ${GRAPH_PROFILE} does. A saved map can be edited with corridor view.`;
  if (mode !== "localization") return "";
  return `The vehicle is only localised, and the map stays as it is. To edit it, ${configured_mode === mode ? "change mode: localization in the config" : "choose Map again under Control"}.`;
};

export class Edit {
  whyNot = ""; // the map of the running session is not changed
  isStored = false; // a stored map is changed; isLive: that of a running session
  isLive = false;
  isBusy = false;
  showsAll = false;
  version = 0; // of the map that is shown; 0: not known yet
  versions = [];
  keyframes = new Keyframes();
  evidence = {}; // of the loops of a running session
  reported = null; // of the newest change: {words, level}
  tool = null;

  /** setTool(tool): put a tool to work on the map, null: none. */
  constructor(connection, view, setTool) {
    Object.assign(this, { connection, view, setTool });
    [this.live, this.stored] = [new LiveMap(connection), new StoredMap(connection)];
    for (const name of ["note", "who", "undo", "all"]) this[name] = byId(`edit-${name}`);
    onClick("edit-undo", () => this.change({ what: "undo" }, "Undo"));
    onClick("fetch-keyframes", () => this.#fetch());
    this.compare = new BeforeAfter(view);
    this.swipe = new Swipe(view);
    this.pairs = new EditPairs(this);
    this.loops = new EditLoops(this);
    this.drawing = new EditDraw(this);
    this.cut = new EditCut(this);
    this.update();
  }

  putVerbs({ verbs }) {
    this.isStored = verbs.includes("map_edit");
    this.isLive = !this.isStored && LIVE_VERBS.every((verb) => verbs.includes(verb));
    byId("tab-edit").hidden = !this.isStored && !this.isLive;
    if (this.isLive) {
      this.#take(null);
      this.loops.put(this.evidence);
    }
    this.update();
  }

  putAccess() {
    if (this.connection.mayControl && this.isStored) this.#look();
    this.update();
  }

  putHealth(health) {
    const values = valuesOf(health, "mapping"), version = Number(values.version ?? 0), why = whyNot(values);
    if (why !== this.whyNot) {
      this.whyNot = why;
      this.update();
    }
    if (this.version && version && version !== this.version && !this.isBusy) this.#look();
  }

  update() {
    const isSeen = this.version > 0, hasKeyframes = this.keyframes.count > 0;
    this.all.disabled = !this.connection.mayControl || this.isBusy || (this.isLive ? this.whyNot !== "" : !isSeen);
    if (!this.isBusy) this.#showNote();
    byId("versions-card").hidden = this.isLive;
    byId("fetch").hidden = !this.isLive;
    setText(byId("fetched"), hasKeyframes && this.isLive ? `${this.keyframes.count}, ${clockTime(this.fetchedAt_s)}` : "");
    setText(byId("fetch-keyframes"), hasKeyframes ? "Fetch them again" : "Fetch them");
    byId("join").hidden = byId("cut-card").hidden = !hasKeyframes && (this.isLive || isSeen);
    for (const part of [this.pairs, this.drawing, this.cut]) part.update();
    this.#showVersions();
  }

  async #fetch() {
    this.#take(null);
    this.#begin("Key frames: the map is saved, and they are read \u2026");
    const answer = await this.live.look(), isGraph = answer.ok && answer.keyframes;
    this.isBusy = false;
    this.#take(answer);
    if (isGraph) this.say(`Fetched: ${counted(answer.keyframes.count, "key frame")}`, "ok");
    else this.say(`Key frames: ${answer.error ?? NO_KEYFRAMES}`, "error");
    this.update();
  }

  /** Of a running session: what it answered of its map; null: what was looked at is of the map no more. */
  #take(answer) {
    const isSeen = answer?.ok && answer.keyframes;
    if (!isSeen) {
      this.live.forget();
      this.pairs.clear();
    }
    [this.version, this.keyframes, this.fetchedAt_s] = [isSeen ? answer.version : 0, new Keyframes(isSeen ? answer.keyframes : null), Date.now() / 1000];
    this.pairs.put(isSeen ? answer.pairs : [], isSeen ? answer.passes : []);
    this.view.invalidate();
  }

  /** Fetch the present state of the stored map; whether that was answered. */
  async #look() {
    const answer = await this.stored.look();
    if (!answer.ok) {
      this.say(answer.error, "error");
      return false;
    }
    [this.version, this.versions, this.keyframes] = [answer.version, answer.versions, new Keyframes(answer.keyframes)];
    this.who.value ||= answer.user;
    this.update();
    this.pairs.put(answer.pairs, answer.passes);
    this.loops.put(answer.loops);
    this.view.invalidate();
    return true;
  }

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

  get map() {
    return this.isLive ? this.live : this.stored;
  }

  /** question: that must be answered with yes first. Returns whether the change was made. */
  async change(change, label, question = null) {
    if (question && !await confirmed(...question)) return false;
    this.endTool();
    this.#begin(`${label}: the map is being changed \u2026`);
    this.compare.keep();
    const { ok, done, error, looked } = await this.map.change(change, this.who.value.trim(), this.version);
    if (ok) this.compare.made();
    const isSeen = this.isLive || await this.#look();
    if (looked) this.#take(looked);
    this.isBusy = false; // the outcome is shown when the next change can be made, not before
    const unseen = looked && !looked.ok ? `; its key frames could not be fetched: ${looked.error}` : "";
    if (isSeen || !ok) this.say(`${label}: ${ok ? done + unseen : error}`, ok && !unseen ? "ok" : "error");
    this.update();
    return ok;
  }

  #begin(words) {
    this.isBusy = true;
    this.update();
    this.#note({ words, level: "none" });
  }

  /** On top of the area, until the next change; as a notice where the area is not shown. */
  say(words, level) {
    this.reported = { words: `${words}.`, level };
    this.#showNote();
    if (this.note.offsetParent === null) notice(`${words}.`, level);
  }

  #showNote() {
    const words = !this.connection.mayControl ? NO_TOKEN_WORDS : this.isLive ? this.whyNot : "";
    this.#note(words ? { words, level: "none" } : this.reported ?? { words: this.isLive ? LIVE_WORDS : STORED_WORDS, level: "none" });
  }

  #note({ words, level }) {
    this.note.dataset.level = level;
    setText(this.note, words);
  }

  pickKeyframe(what, chosen) {
    this.beginTool(new KeyframeTool(this.view, { keyframes: this.keyframes, what, chosen: (k) => {
      this.endTool();
      chooseTab("edit", { onlyOnPhone: true });
      chosen(k);
    } }));
  }

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

  draw(...drawing) {
    if (this.view.showsBefore) return; // what is chosen lies on the map as it is
    this.cut.draw(...drawing);
    this.pairs.draw(...drawing);
  }

  #showVersions() {
    const newest = this.versions.toReversed(), shown = this.showsAll ? newest : newest.slice(0, SHOWN);
    setText(byId("version-now"), this.version ? `now ${this.version}` : "");
    const canUndo = this.isLive ? this.live.undoable : newest.some((version) => version.is_current && version.what !== "saved");
    setRefused(this.undo, canUndo ? "" : "There is no change to take back");
    byId("versions").replaceChildren(...shown.map((version) => this.#entry(version)));
    const showAll = () => { this.showsAll = true; this.#showVersions(); };
    if (newest.length > shown.length) byId("versions").append(element("li", {}, button(`Show all ${newest.length}`, showAll)));
  }

  #entry({ version, is_current, saved, who, words }) {
    const goBack = () => this.change({ what: "undo", to: version }, "Go back", [`Go back to version ${version}?`, GO_BACK_WORDS, "Go back"]);
    const choices = is_current ? [] : [row(button(`Go back to version ${version}\u2026`, goBack), button("Compare", () => this.#compareWith(version)))];
    return element("li", {}, element("p", { className: "stored-name" }, `${version}: ${words}`),
      note(`${who === "-" ? "" : `${who}, `}${dateTime(saved)}${is_current ? ", the present one" : ""}`), ...choices);
  }

  async #compareWith(version) {
    const answer = await this.connection.command("map_version", { version });
    if (!answer.ok) {
      this.say(answer.error, "error");
      return;
    }
    await this.swipe.show(answer, this.version);
    chooseTab("map", { onlyOnPhone: true });
  }
}
