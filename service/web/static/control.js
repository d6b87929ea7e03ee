// The area Control: what changes something. It needs the token; the service checks it, the page only asks.

import { byId, confirmed, element, NO_TOKEN, notice, noticeOf, onClick, setRefused, setText } from "./dom.js";
import { degrees, fixed } from "./format.js";
import { GRAPH_PROFILE, valuesOf } from "./health.js";

const LOOK_WORDS = "You may look. To give commands, enter the token of the service: the command corridor demo prints it, corridor run says at its start in which file it is.";
const SAVE_AS_WORDS = "Name of the copy: letters, digits, _ . and -. A map of that name gets a new version; its older ones stay. "
  + "Mapping goes on in the map that it is in; the copy can be edited (corridor view) and loaded again under Resources.";
const RESET_WORDS = "The present map is saved and closed, and mapping begins a new one where the vehicle stands.";
const SWITCH_WORDS = "The map is saved and closed. Mapping begins a new, empty map where the vehicle stands; up to about "
  + "a second of scans is not mapped. The recording goes on and notes the switch.";
const NEEDS = { corridor: "The default: needs a laser; wheels or a gyro improve it.", contour_lm: "Needs a laser.",
  owolm_eskf: "Needs a laser; an inertial unit improves it.", imle: "Needs a laser; keeps the map on disk.",
  submap_graph: "Needs a laser and wheels." };

export class Control {
  verbs = [];
  mapping = {}; // values of health
  isRecording = false;
  profile = ""; // that maps
  profiles = [];
  isSwitching = false; // to another profile

  /** startPoseTool(done): have a pose drawn on the map; done({x_m, y_m, theta_rad}), map frame. */
  constructor(root, connection, startPoseTool) {
    this.connection = connection;
    this.buttons = new Map([...root.querySelectorAll('[id^="do-"]')].map((button) => [button.id.slice("do-".length), button]));
    const acts = {
      set_mode: () => this.ask("set_mode", { mode: this.mapping.mode === "localization" ? "mapping" : "localization" }),
      set_pose: () => startPoseTool((pose) => this.ask("set_pose", pose)),
      reset_map: async () => { if (await confirmed("Reset the map?", RESET_WORDS, "Reset map")) this.ask("reset_map"); },
      mark: () => {}, switch_profile: () => this.#switch(),
    };
    for (const [verb, button] of this.buttons) button.addEventListener("click", acts[verb] ?? (() => this.ask(verb)));
    onClick("save-as", async () => {
      const name = await confirmed("Save the map as", SAVE_AS_WORDS, "Save", "map");
      if (name) this.ask("save_map", { name });
    });
    byId("token-form").onsubmit = (event) => {
      event.preventDefault();
      if (byId("token").value.trim()) connection.showToken(byId("token").value.trim());
    };
    byId("mark-form").onsubmit = async (event) => {
      event.preventDefault();
      const text = byId("mark-text").value.trim();
      if (text && (await this.ask("mark", { text })).ok) byId("mark-text").value = "";
    };
    byId("profile").onchange = () => this.#explain();
    this.cards = [...root.children].slice(1);
    this.update();
  }

  putHello({ profile, profiles = [], verbs }) {
    this.#offer(profile, profiles);
    this.putVerbs({ verbs });
  }

  putVerbs({ verbs }) {
    this.verbs = verbs;
    this.update();
  }

  putHealth(health) {
    this.mapping = valuesOf(health, "mapping");
    this.isRecording = valuesOf(health, "recording").state === "recording";
    this.#offer(this.mapping.profile);
    this.update();
  }

  putAccess({ error }) {
    if (error) notice(`Not unlocked: ${error}.`, "error");
    byId("token").value = "";
    this.update();
  }

  /** All profiles but the one that maps; what was chosen stays chosen. */
  #offer(profile = this.profile, profiles = this.profiles) {
    if (profile === this.profile && profiles === this.profiles) return;
    const choice = byId("profile"), before = choice.value, others = profiles.filter((name) => name !== profile);
    Object.assign(this, { profile, profiles });
    setText(byId("profile-now"), profile);
    choice.replaceChildren(...others.map((name) => element("option", { value: name }, name)));
    if (others.includes(before)) choice.value = before;
    this.#explain();
  }

  #explain() {
    setText(byId("profile-needs"), NEEDS[byId("profile").value] ?? "");
  }

  update() {
    const { mayControl: may, role } = this.connection, { profile, profiles, isSwitching, isRecording } = this, { state, mode, configured_mode } = this.mapping;
    setText(byId("access-words"), may ? "Unlocked: this page may give commands." : role ? "This token is that of a viewer: you may look." : LOOK_WORDS);
    byId("token-form").hidden = may;
    const hasGraph = [GRAPH_PROFILE, ""].includes(profile), isFixed = configured_mode === "localization";
    const noPose = !hasGraph ? `The profile ${profile} takes no pose; ${GRAPH_PROFILE} does.`
      : state === "lost" ? "" : "The pose is known. It can be set while the vehicle is lost.";
    setText(byId("pose-words"), noPose || "Tell the vehicle where it is: press on the map where it stands, drag to where it looks.");
    const [change, hint] = mode === "localization" ? ["Map again", "The map is extended again"] : ["Localise only", "The map stays as it is"];
    setText(byId("do-set_mode"), change);
    byId("do-set_mode").hint = hint;
    setText(byId("do-switch_profile"), isSwitching ? "Switching\u2026" : "Switch\u2026");
    const notRecording = isRecording ? "" : "Nothing is being recorded: press Start first";
    const refused = {
      pause: state === "paused" ? "Mapping is paused already" : "", resume: state === "paused" ? "" : "Mapping is not paused",
      start_recording: isRecording ? "A recording is being written already" : "", stop_recording: notRecording, mark: notRecording,
      set_pose: noPose, save_map: state ? "" : "There is no map yet: it begins with the first scan that is mapped",
      set_mode: !hasGraph ? `Only with the profile ${GRAPH_PROFILE}`
        : isFixed ? "The config says mode: localization; to map, change it and start the service again"
          : state ? "" : "There is no map yet to be localised in",
      switch_profile: isSwitching ? "The switch before is being made"
        : isFixed ? `The config says mode: localization, and only ${GRAPH_PROFILE} does that` : "",
    };
    const refuse = (control, verb) => setRefused(control, may ? refused[verb] ?? "" : NO_TOKEN);
    for (const [verb, button] of this.buttons) {
      button.hidden = !this.verbs.includes(verb) || (verb === "switch_profile" && profiles.length < 2);
      refuse(button, verb);
    }
    byId("save-as").hidden = byId("do-save_map").hidden;
    refuse(byId("save-as"), "save_map");
    refuse(byId("mark-text"), "mark");
    refuse(byId("profile"), "switch_profile");
    for (const card of this.cards) card.hidden = [...card.querySelectorAll("button")].every((button) => button.hidden);
  }

  /** quietly: what was done can be seen elsewhere; only a refusal is reported, by that name. */
  async ask(verb, request = {}, { quietly = "" } = {}) {
    const answer = await this.connection.command(verb, request);
    const label = this.buttons.get(verb)?.textContent.replace("\u2026", "") ?? (quietly || verb);
    if (!answer.ok || !quietly) noticeOf(label, answer, `${label}: done${words(answer)}`);
    return answer;
  }

  async #switch() {
    const profile = byId("profile").value, request = { profile, id: `switch-${Date.now()}` };
    if (!(await confirmed(`Map with ${profile}?`, SWITCH_WORDS, "Switch profile"))) return;
    this.isSwitching = true;
    this.update();
    notice(`Switching to ${profile}: it is made ready first, which can take minutes the first time; mapping goes on meanwhile.`);
    let answer;
    do answer = await this.connection.command("switch_profile", request); // what takes longer than the service waits is asked for again, by its id
    while (!answer.ok && answer.error.startsWith("taken up, but not finished"));
    this.isSwitching = false;
    this.update();
    noticeOf("Switch profile", answer, `${profile} maps now${answer.folder_before ? `; the map before is in ${answer.folder_before}` : ""}`);
  }
}

const words = ({ folder_before, folder, looked_for_at, changed }) => {
  if (folder_before) return `, the map before is in ${folder_before}`;
  if (folder) return `, in ${folder}`;
  if (looked_for_at) {
    const [x_m, y_m, theta_rad] = looked_for_at;
    return `, the vehicle is looked for at x ${fixed(x_m, 2, " m")}, y ${fixed(y_m, 2, " m")}, heading ${degrees(theta_rad)}`;
  }
  return changed === false ? ", it was so already" : "";
};
