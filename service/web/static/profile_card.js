// Which method makes the map, and the switch to another one.

import { card, confirmed, element, notice, setRefused, setText } from "./dom.js";

export const GRAPH_PROFILE = "corridor"; // the one whose graph takes poses, modes and edits

const NEEDS = { corridor: "The default: needs a laser; wheels or a gyro improve it.", contour_lm: "Needs a laser.",
  owolm_eskf: "Needs a laser; an inertial unit improves it.", imle: "Needs a laser; keeps the map on disk.",
  submap_graph: "Needs a laser and wheels." };
const CONFIRM = "The map is saved and closed. Mapping begins a new, empty map where the vehicle stands; up to about "
  + "a second of scans is not mapped. The recording goes on and notes the switch.";

export class ProfileCard {
  /** command(verb, request): asks the service. */
  constructor(command) {
    this.command = command;
    this.profile = "";
    this.profiles = [];
    this.isSwitching = false;
    const { node, aside } = card("Profile");
    this.node = node;
    this.aside = aside;
    this.choice = element("select", { id: "profile", onchange: () => this.#explain() });
    this.needs = element("p", { className: "note" });
    this.button = element("button", { type: "button", id: "do-switch_profile", onclick: () => this.#switch() }, "Switch\u2026");
    node.append(element("p", { className: "note" }, "The method that makes the map."),
      element("div", { className: "row" }, element("label", { for: "profile" }, "Switch to"), this.choice, this.button), this.needs);
  }

  putProfiles(profiles) {
    this.profiles = profiles;
    this.#offer();
  }

  putProfile(profile) {
    if (profile === undefined || profile === this.profile) return;
    this.profile = profile;
    setText(this.aside, profile);
    this.#offer();
  }

  /** refused: why no other profile can be switched to; "": one can. */
  update(verbs, refused) {
    this.node.hidden = !verbs.includes("switch_profile") || this.profiles.length < 2;
    const whyNot = this.isSwitching ? "The switch before is being made" : refused;
    for (const control of [this.button, this.choice]) setRefused(control, whyNot);
    setText(this.button, this.isSwitching ? "Switching\u2026" : "Switch\u2026");
    this.refresh = () => this.update(verbs, refused);
  }

  /** All but the one that maps; what was chosen stays chosen. */
  #offer() {
    const before = this.choice.value, others = this.profiles.filter((name) => name !== this.profile);
    this.choice.replaceChildren(...others.map((name) => element("option", { value: name }, name)));
    if (others.includes(before)) this.choice.value = before;
    this.#explain();
  }

  #explain() {
    setText(this.needs, NEEDS[this.choice.value] ?? "");
  }

  async #switch() {
    const profile = this.choice.value;
    if (!(await confirmed(`Map with ${profile}?`, CONFIRM, "Switch profile"))) return;
    this.isSwitching = true;
    this.refresh?.();
    notice(`Switching to ${profile}: it is made ready first, which can take minutes the first time; mapping goes on meanwhile.`);
    const answer = await this.#untilDone({ profile, id: `switch-${Date.now()}` });
    this.isSwitching = false;
    this.refresh?.();
    if (!answer.ok) notice(`Switch profile: ${answer.error}.`, "error");
    else notice(`${profile} maps now${answer.folder_before ? `; the map before is in ${answer.folder_before}` : ""}.`, "ok");
  }

  /** What takes longer than the service waits with an answer is asked for again, by its id. */
  async #untilDone(request) {
    for (;;) {
      const answer = await this.command("switch_profile", request);
      if (answer.ok || !answer.error.startsWith("taken up, but not finished")) return answer;
    }
  }
}
