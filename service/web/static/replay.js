// The strip of a replay: where it is, how fast it goes, and the controls for that.

import { byId, element, setRefused, setText } from "./dom.js";
import { duration } from "./format.js";

const RATES = [[0, "as fast as it maps"], [0.5, "0.5 times"], [1, "real time"], [2, "2 times"], [5, "5 times"], [10, "10 times"], [50, "50 times"]];
const STEP_S = 1;
const FORWARD = "Goes forward only; when the replay has finished, any moment of it can be gone to";

export class Replay {
  /** ask(verb, request): give a command. */
  constructor(root, connection, ask) {
    this.root = root;
    this.connection = connection;
    this.ask = ask;
    this.position_s = this.duration_s = 0;
    this.state = "";
    this.toggle = element("button", { type: "button", id: "replay-toggle", onclick: () => this.#toggle() }, "Pause");
    this.step = element("button", { type: "button", id: "replay-step", title: `Go on by ${STEP_S} s, then pause`,
      onclick: () => this.#goTo(this.position_s + STEP_S) }, `+${STEP_S} s`);
    this.slider = element("input", { type: "range", id: "replay-position", min: "0", max: "1", step: "0.1", value: "0",
      "aria-label": "Time in the recording: go forward to it, then pause", title: FORWARD });
    this.slider.addEventListener("change", () => this.#goTo(Number(this.slider.value)));
    this.slider.addEventListener("input", () => this.#drag());
    this.words = element("span", { className: "replay-time", id: "replay-time" });
    this.rate = element("select", { id: "replay-rate", "aria-label": "Speed of the replay" },
      ...RATES.map(([rate, text]) => element("option", { value: String(rate) }, text)));
    this.rate.addEventListener("change", () => this.ask("replay_rate", { rate: Number(this.rate.value) }));
    this.note = element("span", { className: "note replay-note", id: "replay-note" });
    root.append(element("strong", {}, "Replay"), this.toggle, this.step, this.slider, this.words, this.rate, this.note);
  }

  putHealth({ statuses }) {
    const values = statuses.find((status) => status.name === "replay")?.values;
    this.root.hidden = !values || values.state === "finished"; // then any of its moments can be gone to
    this.state = values?.state ?? "";
    if (!values) return;
    this.position_s = Number(values.position_s);
    this.duration_s = Number(values.duration_s);
    this.slider.max = values.duration_s;
    if (!this.isDragged) {
      this.slider.value = values.position_s;
      this.slider.setAttribute("aria-valuetext", this.#time(this.position_s));
      setText(this.words, this.#time(this.position_s));
    }
    if (document.activeElement !== this.rate) this.#showRate(values.rate);
    const speed = Number(values.speed);
    setText(this.note, this.state !== "replaying" ? this.state : `${speed.toFixed(speed < 9.95 ? 1 : 0)} times real time`);
    setText(this.toggle, this.state === "paused" ? "Go on" : "Pause");
    this.update();
  }

  update() {
    const isAtWork = this.state === "replaying" || this.state === "paused";
    const refused = !this.connection.mayControl ? "The controls need the token: open the address that the replay printed" : isAtWork ? "" : "The replay has not begun yet";
    for (const control of [this.toggle, this.step, this.slider, this.rate]) setRefused(control, refused);
  }

  /** A speed that was given on the command line stands in the list, too. */
  #showRate(rate) {
    if (![...this.rate.options].some((option) => Number(option.value) === Number(rate))) {
      this.rate.append(element("option", { value: rate }, `${rate} times`));
    }
    const option = [...this.rate.options].find(({ value }) => Number(value) === Number(rate));
    this.rate.value = option.value;
  }

  #toggle() {
    this.ask(this.state === "paused" ? "replay_resume" : "replay_pause");
  }

  async #goTo(position_s) {
    if (position_s <= this.position_s) { // dragged back
      this.isDragged = false;
      return;
    }
    await this.ask("replay_go_to", { position_s: Math.min(position_s, this.duration_s) });
    this.isDragged = false;
  }

  /** Not back: what is mapped stays mapped until the end. */
  #drag() {
    this.isDragged = true;
    if (Number(this.slider.value) < this.position_s) {
      this.slider.value = String(this.position_s);
      setText(this.note, "forward only");
    }
    setText(this.words, this.#time(Number(this.slider.value)));
  }

  #time(position_s) {
    return `${duration(position_s)} of ${duration(this.duration_s)}`;
  }
}

export const setUpReplay = (connection, ask) => new Replay(byId("replay"), connection, ask);
