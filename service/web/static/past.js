// The strip of a recording: which of its moments is shown, and the way to any other, back as well as forward.

import { byId, element, setRefused, setText } from "./dom.js";
import { fixed } from "./format.js";

const STEP_S = 1, FINE_STEP_S = 0.1, LEAP_S = 10;
const PLAY_PERIOD_MS = 100;
const ASK_PERIOD_MS = 60; // the service reads 20 messages a second
const RATES = [[1, "real time"], [2, "2 times"], [5, "5 times"], [10, "10 times"], [50, "50 times"]];

export class Past {
  /** ask(position_s): have the service show that moment; resolves to {ok}. */
  constructor(root, connection, ask) {
    this.root = root;
    this.connection = connection;
    this.ask = ask;
    this.moment = null; // the newest that came
    this.wanted_s = null; // where a person wants to go; the newest request counts
    this.isAsking = false;
    this.playing = null; // timer
    const step = (step_s) => element("button", { type: "button", id: `past-by${step_s}`, onclick: () => this.step(step_s),
      title: `${Math.abs(step_s)} s ${step_s > 0 ? "forward" : "back"}` }, `${step_s > 0 ? "+" : "\u2212"}${Math.abs(step_s)} s`);
    this.toggle = element("button", { type: "button", id: "past-play", onclick: () => this.#togglePlay() }, "Play");
    this.slider = element("input", { type: "range", id: "past-position", min: "0", max: "1", step: "0.01", value: "0",
      "aria-label": "Moment of the recording", title: "Arrow keys: 1 s, with Shift 0.1 s; page keys: 10 s" });
    this.slider.addEventListener("input", () => { this.#pause(); this.go(Number(this.slider.value)); });
    this.slider.addEventListener("keydown", (event) => this.#key(event));
    this.words = element("span", { className: "replay-time", id: "past-time" });
    this.rate = element("select", { id: "past-rate", "aria-label": "Speed" }, ...RATES.map(([rate, text]) => element("option", { value: String(rate) }, text)));
    this.rate.addEventListener("change", () => { if (this.playing !== null) this.#play(); });
    this.note = element("span", { className: "note replay-note", id: "past-note" });
    this.controls = [step(-LEAP_S), step(-STEP_S), this.toggle, step(STEP_S), step(LEAP_S), this.rate, this.slider];
    root.append(...this.controls.slice(0, 5), this.slider, this.words, this.rate, this.note);
  }

  put(moment) {
    this.moment = moment;
    this.root.hidden = false;
    this.slider.max = String(moment.duration_s);
    setText(this.note, moment.map_words);
    if (this.wanted_s === null && !this.isAsking) this.#show(moment.position_s);
    this.update();
  }

  update() {
    const may = this.connection.mayControl;
    if (!may) this.#pause();
    for (const control of this.controls) setRefused(control, may ? "" : "To go to another moment needs the token: open the address that corridor view printed");
  }

  clear() {
    this.#pause();
    this.moment = this.wanted_s = null;
    this.root.hidden = true;
  }

  /** Go to a Unix time, s; false where there is no moment to go to. */
  goTo(at_s) {
    if (!this.moment) return false;
    this.#pause();
    if (this.connection.mayControl) this.go(at_s - this.moment.at_s + this.moment.position_s);
    return true;
  }

  get position_s() {
    return this.wanted_s ?? this.shown_s ?? 0;
  }

  step(step_s) {
    if (!this.moment) return;
    this.#pause();
    this.go(this.position_s + step_s);
  }

  /** Go to this many seconds after the beginning; while the service is at work, the newest request waits. */
  async go(position_s) {
    this.wanted_s = Math.min(Math.max(position_s, 0), this.moment.duration_s);
    this.#show(this.wanted_s);
    if (this.isAsking) return;
    this.isAsking = true;
    while (this.wanted_s !== null) {
      const asked_s = this.wanted_s;
      const [answer] = await Promise.all([this.ask(asked_s), new Promise((done) => setTimeout(done, ASK_PERIOD_MS))]);
      if (this.wanted_s === asked_s || !answer.ok) this.wanted_s = null;
      if (!answer.ok) {
        this.#pause();
        if (this.moment) this.#show(this.moment.position_s);
      }
    }
    this.isAsking = false;
  }

  #show(position_s) {
    const { moment } = this;
    this.shown_s = position_s;
    this.slider.value = String(position_s);
    const words = `${fixed(position_s, 2)} of ${fixed(moment.duration_s, 2, " s")}, ${utc(moment.at_s - moment.position_s + position_s)}`;
    this.slider.setAttribute("aria-valuetext", words);
    setText(this.words, words);
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrow_s = event.shiftKey ? FINE_STEP_S : STEP_S;
    const by_s = { ArrowLeft: -arrow_s, ArrowDown: -arrow_s, ArrowRight: arrow_s, ArrowUp: arrow_s, PageDown: -LEAP_S, PageUp: LEAP_S,
      Home: -Infinity, End: Infinity }[event.key];
    if (by_s === undefined) return;
    event.preventDefault();
    this.step(by_s);
  }

  #togglePlay() {
    if (this.playing === null) this.#play();
    else this.#pause();
  }

  #play() {
    this.#pause();
    const { duration_s } = this.moment, rate = Number(this.rate.value), began_ms = performance.now();
    const from_s = this.position_s >= duration_s ? 0 : this.position_s; // from the end it starts over
    setText(this.toggle, "Pause");
    this.playing = setInterval(() => {
      const position_s = from_s + (rate * (performance.now() - began_ms)) / 1000;
      this.go(position_s);
      if (position_s >= duration_s) this.#pause();
    }, PLAY_PERIOD_MS);
  }

  #pause() {
    clearInterval(this.playing);
    this.playing = null;
    setText(this.toggle, "Play");
  }
}

/** A Unix time as wall-clock time, to a tenth of a second. */
const utc = (unix_s) => `${new Date(100 * Math.round(10 * unix_s)).toISOString().replace("T", " ").slice(0, 21)} UTC`;

export const setUpPast = (connection, ask) => new Past(byId("past"), connection, ask);
