// The area Control: what changes something. It needs the token; the service checks it, the page only asks.

import { card, confirmed, element, NO_TOKEN, notice, setRefused, setText } from "./dom.js";
import { degrees, fixed } from "./format.js";
import { GRAPH_PROFILE, ProfileCard } from "./profile_card.js";

export class Control {
  /** startPoseTool(done): have a pose drawn on the map; done({x_m, y_m, theta_rad}), map frame. */
  constructor(root, connection, startPoseTool) {
    this.connection = connection;
    this.startPoseTool = startPoseTool;
    this.verbs = [];
    this.isPaused = this.isRecording = this.isLost = this.isLocalizing = this.isModeFixed = this.isMapped = false;
    this.buttons = new Map();

    this.access = card("Access");
    this.accessWords = element("p", { className: "note", id: "access-words" });
    this.token = element("input", { type: "password", id: "token", autocomplete: "off", maxLength: 200 });
    this.tokenForm = element("form", { className: "row", onsubmit: (event) => this.#showToken(event) },
      element("label", { for: "token" }, "Token"), this.token,
      element("button", { type: "submit", className: "primary" }, "Unlock"));
    this.access.node.append(this.accessWords, this.tokenForm);

    const mapping = card("Mapping");
    mapping.node.append(element("div", { className: "row" },
      this.#button("pause", "Pause", "Scans are recorded, not mapped"),
      this.#button("resume", "Resume"),
      this.#button("set_mode", "Localise only", "", "", () => this.#setMode()),
      this.#button("save_map", "Save map"),
      this.saveAs = element("button", { type: "button", id: "save-as", title: "Also under a name: a copy that can be edited", onclick: () => this.#saveAs() }, "Save as\u2026"),
      this.#button("reset_map", "Reset map\u2026", "", "danger", () => this.#reset())));
    const recording = card("Recording");
    this.mark = element("input", { type: "text", id: "mark-text", maxLength: 1000, placeholder: "What happened here" });
    recording.node.append(element("div", { className: "row" },
      this.#button("start_recording", "Start"), this.#button("stop_recording", "Stop")),
    element("form", { className: "row", onsubmit: (event) => this.#mark(event) },
      element("label", { for: "mark-text" }, "Mark"), this.mark, this.#button("mark", "Set mark", "", "", null, "submit")));
    this.pose = card("Pose");
    this.poseWords = element("p", { className: "note", id: "pose-words" });
    this.pose.node.append(this.poseWords,
      element("div", { className: "row" }, this.#button("set_pose", "Set pose on the map", "", "", () => this.#setPose())));
    this.profile = new ProfileCard((verb, request) => connection.command(verb, request));
    this.cards = [mapping, recording, this.pose].map(({ node }) => node);
    root.append(this.access.node, ...this.cards, this.profile.node);
    this.update();
  }

  /** profile: of the service's start; health tells of a later one. */
  putHello({ profile, profiles = [], verbs }) {
    this.profile.putProfiles(profiles);
    this.profile.putProfile(profile);
    this.putVerbs({ verbs });
  }

  putVerbs({ verbs }) {
    this.verbs = verbs;
    this.update();
  }

  putHealth({ statuses }) {
    const values = (name) => statuses.find((status) => status.name === name)?.values ?? {};
    this.isPaused = values("mapping").state === "paused";
    this.isLost = values("mapping").state === "lost";
    this.isLocalizing = values("mapping").mode === "localization";
    this.isModeFixed = values("mapping").configured_mode === "localization";
    this.isMapped = values("mapping").state !== undefined;
    this.isRecording = values("recording").state === "recording";
    this.profile.putProfile(values("mapping").profile);
    this.update();
  }

  putAccess({ role, error }) {
    if (role) this.connection.keepToken();
    else this.connection.dropToken();
    if (error) notice(`Not unlocked: ${error}.`, "error");
    this.token.value = "";
    this.update();
  }

  update() {
    const may = this.connection.mayControl;
    setText(this.accessWords, may
      ? "Unlocked: this page may give commands."
      : this.connection.role ? "This token is that of a viewer: you may look."
      : "You may look. To give commands, enter the token of the service: the command corridor demo prints it, corridor run says at its start in which file it is.");
    this.tokenForm.hidden = may;
    const hasGraph = [GRAPH_PROFILE, ""].includes(this.profile.profile);
    const noPose = !hasGraph ? `The profile ${this.profile.profile} takes no pose; ${GRAPH_PROFILE} does.`
      : this.isLost ? "" : "The pose is known. It can be set while the vehicle is lost.";
    setText(this.poseWords, noPose || "Tell the vehicle where it is: press on the map where it stands, drag to where it looks.");
    const mode = this.buttons.get("set_mode");
    setText(mode, this.isLocalizing ? "Map again" : "Localise only");
    mode.hint = this.isLocalizing ? "The map is extended again" : "The map stays as it is";
    const noMap = this.isMapped ? "" : "There is no map yet: it begins with the first scan that is mapped";
    const notRecording = this.isRecording ? "" : "Nothing is being recorded: press Start first";
    const refused = { pause: this.isPaused ? "Mapping is paused already" : "", resume: this.isPaused ? "" : "Mapping is not paused",
      start_recording: this.isRecording ? "A recording is being written already" : "", stop_recording: notRecording, mark: notRecording,
      set_pose: noPose, set_mode: this.#whyNotMode(hasGraph), save_map: noMap };
    const whyNot = (verb) => (may ? refused[verb] ?? "" : NO_TOKEN);
    for (const [verb, button] of this.buttons) {
      button.hidden = !this.verbs.includes(verb);
      setRefused(button, whyNot(verb));
    }
    this.saveAs.hidden = this.buttons.get("save_map").hidden;
    setRefused(this.saveAs, whyNot("save_map"));
    setRefused(this.mark, whyNot("mark"));
    this.profile.update(this.verbs, !may ? NO_TOKEN : this.isModeFixed ? `The config says mode: localization, and only ${GRAPH_PROFILE} does that` : "");
    for (const node of this.cards) node.hidden = [...node.querySelectorAll("button")].every((button) => button.hidden);
  }

  #whyNotMode(hasGraph) {
    if (!hasGraph) return `Only with the profile ${GRAPH_PROFILE}`;
    if (this.isModeFixed) return "The config says mode: localization; to map, change it and start the service again";
    return this.isMapped ? "" : "There is no map yet to be localised in";
  }

  /** quietly: what was done can be seen elsewhere; only a refusal is reported, by that name. */
  async ask(verb, request = {}, { quietly = "" } = {}) {
    const answer = await this.connection.command(verb, request);
    const label = this.buttons.get(verb)?.textContent.replace("\u2026", "") ?? (quietly || verb);
    if (answer.ok && quietly) return answer;
    if (answer.ok) notice(`${label}: done${words(answer)}.`, "ok");
    else notice(`${label}: ${answer.error}.`, "error");
    return answer;
  }

  #button(verb, text, title = "", className = "", act = () => this.ask(verb), type = "button") {
    const button = element("button", { type, className, title, id: `do-${verb}` }, text);
    if (act) button.addEventListener("click", act);
    this.buttons.set(verb, button);
    return button;
  }

  #showToken(event) {
    event.preventDefault();
    if (this.token.value.trim()) this.connection.showToken(this.token.value.trim());
  }

  /** What it is then is seen on the button. */
  #setMode() {
    return this.ask("set_mode", { mode: this.isLocalizing ? "mapping" : "localization" });
  }

  async #reset() {
    const isSure = await confirmed("Reset the map?",
      "The present map is saved and closed, and mapping begins a new one where the vehicle stands.", "Reset map");
    if (isSure) this.ask("reset_map");
  }

  async #saveAs() {
    const name = await confirmed("Save the map as", "Name of the copy: letters, digits, _ . and -. A map of that name gets a new version; its older ones stay. "
      + "Mapping goes on in the map that it is in; the copy can be edited (corridor view) and loaded again under Resources.", "Save", "map");
    if (name) this.ask("save_map", { name });
  }

  async #mark(event) {
    event.preventDefault();
    const text = this.mark.value.trim();
    if (text && (await this.ask("mark", { text })).ok) this.mark.value = "";
  }

  #setPose() {
    this.startPoseTool(({ x_m, y_m, theta_rad }) => this.ask("set_pose", { x_m, y_m, theta_rad }));
  }
}

const words = (answer) => {
  if (answer.folder_before) return `, the map before is in ${answer.folder_before}`;
  if (answer.folder) return `, in ${answer.folder}`;
  if (answer.looked_for_at) {
    const [x_m, y_m, theta_rad] = answer.looked_for_at;
    return `, the vehicle is looked for at x ${fixed(x_m, 2, " m")}, y ${fixed(y_m, 2, " m")}, heading ${degrees(theta_rad)}`;
  }
  if (answer.changed === false) return ", it was so already";
  return "";
};
