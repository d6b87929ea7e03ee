// The strips of a replay and of a recording: where it is, how fast it goes, and the controls for that.

import { byId, element, onClick, setRefused, setText } from "./dom.js";
import { duration, fixed } from "./format.js";
import { hasModifier } from "./gestures.js";
import { valuesOf } from "./health.js";

const STEP_S = 1, FINE_STEP_S = 0.1, LEAP_S = 10;
const PLAY_PERIOD_MS = 100;
const ASK_PERIOD_MS = 60; // the service reads 20 messages a second
const NO_TOKEN = { replay: "The controls need the token: open the address that the replay printed",
  past: "To go to another moment needs the token: open the address that corridor view printed" };

class Strip {
  /** ask(...): have the service do what a control says. */
  constructor(name, connection, ask) {
    Object.assign(this, { name, connection, ask, root: byId(name) });
    for (const part of ["time", "rate", "note"]) this[part] = byId(`${name}-${part}`);
    this.slider = byId(`${name}-position`);
  }

  showPosition(position_s, words) {
    this.slider.value = String(position_s);
    this.slider.setAttribute("aria-valuetext", words);
    setText(this.time, words);
  }

  /** whyNot: with the token. */
  refuse(whyNot = "") {
    const reason = this.connection.mayControl ? whyNot : NO_TOKEN[this.name];
    for (const control of this.root.querySelectorAll("button, input, select")) setRefused(control, reason);
  }
}

export class Replay extends Strip {
  position_s = 0;
  duration_s = 0;
  state = "";

  constructor(connection, ask) {
    super("replay", connection, ask);
    onClick("replay-toggle", () => this.ask(this.state === "paused" ? "replay_resume" : "replay_pause"));
    onClick("replay-step", () => this.#goTo(this.position_s + STEP_S));
    this.slider.onchange = () => this.#goTo(Number(this.slider.value));
    this.slider.oninput = () => this.#drag();
    this.rate.onchange = () => this.ask("replay_rate", { rate: Number(this.rate.value) });
  }

  putHealth(health) {
    const { state = "", position_s, duration_s, rate, speed } = valuesOf(health, "replay");
    this.root.hidden = state === "" || state === "finished"; // then any of its moments can be gone to
    this.state = state;
    if (state === "") return;
    [this.position_s, this.duration_s] = [Number(position_s), Number(duration_s)];
    this.slider.max = duration_s;
    if (!this.isDragged) this.showPosition(position_s, this.#timeAt(this.position_s));
    if (document.activeElement !== this.rate) this.#showRate(rate);
    setText(this.note, state !== "replaying" ? state : `${Number(speed).toFixed(speed < 9.95 ? 1 : 0)} times real time`);
    setText(byId("replay-toggle"), state === "paused" ? "Go on" : "Pause");
    this.update();
  }

  update() {
    this.refuse(["replaying", "paused"].includes(this.state) ? "" : "The replay has not begun yet");
  }

  /** A speed that was given on the command line stands in the list, too. */
  #showRate(rate) {
    const find = () => [...this.rate.options].find(({ value }) => Number(value) === Number(rate));
    if (!find()) this.rate.append(element("option", { value: rate }, `${rate} times`));
    this.rate.value = find().value;
  }

  async #goTo(position_s) {
    if (position_s > this.position_s) await this.ask("replay_go_to", { position_s: Math.min(position_s, this.duration_s) }); // else it was dragged back
    this.isDragged = false;
  }

  /** Not back: what is mapped stays mapped until the end. */
  #drag() {
    this.isDragged = true;
    if (Number(this.slider.value) < this.position_s) {
      this.slider.value = String(this.position_s);
      setText(this.note, "forward only");
    }
    setText(this.time, this.#timeAt(Number(this.slider.value)));
  }

  #timeAt(position_s) {
    return `${duration(position_s)} of ${duration(this.duration_s)}`;
  }
}

export class Past extends Strip {
  moment = null; // the newest that came
  wanted_s = null; // where a person wants to go; the newest request counts
  shown_s = 0;
  isAsking = false;
  playing = null; // timer

  constructor(connection, ask) {
    super("past", connection, ask);
    for (const step_s of [-LEAP_S, -STEP_S, STEP_S, LEAP_S]) onClick(`past-by${step_s}`, () => this.step(step_s));
    onClick("past-play", () => (this.playing === null ? this.#play() : this.#pause()));
    this.slider.oninput = () => { this.#pause(); this.go(Number(this.slider.value)); };
    this.slider.onkeydown = (event) => this.#key(event);
    this.rate.onchange = () => { if (this.playing !== null) this.#play(); };
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
    if (!this.connection.mayControl) this.#pause();
    this.refuse();
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
    return this.wanted_s ?? this.shown_s;
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
      if (!answer.ok) this.#pause();
      if (!answer.ok && this.moment) this.#show(this.moment.position_s);
    }
    this.isAsking = false;
  }

  #show(position_s) {
    const { moment } = this;
    this.shown_s = position_s;
    this.showPosition(position_s, `${fixed(position_s, 2)} of ${fixed(moment.duration_s, 2, " s")}, ${utc(moment.at_s - moment.position_s + position_s)}`);
  }

  #key(event) {
    const arrow_s = event.shiftKey ? FINE_STEP_S : STEP_S;
    const by_s = { ArrowLeft: -arrow_s, ArrowDown: -arrow_s, ArrowRight: arrow_s, ArrowUp: arrow_s, PageDown: -LEAP_S, PageUp: LEAP_S,
      Home: -Infinity, End: Infinity }[event.key];
    if (by_s === undefined || hasModifier(event)) return;
    event.preventDefault();
    this.step(by_s);
  }

  #play() {
    this.#pause();
    const { duration_s } = this.moment, rate = Number(this.rate.value), began_ms = performance.now();
    const from_s = this.position_s >= duration_s ? 0 : this.position_s; // from the end it starts over
    setText(byId("past-play"), "Pause");
    this.playing = setInterval(() => {
      const position_s = from_s + (rate * (performance.now() - began_ms)) / 1000;
      this.go(position_s);
      if (position_s >= duration_s) this.#pause();
    }, PLAY_PERIOD_MS);
  }

  #pause() {
    clearInterval(this.playing);
    this.playing = null;
    setText(byId("past-play"), "Play");
  }
}

const utc = (unix_s) => `${new Date(100 * Math.round(10 * unix_s)).toISOString().replace("T", " ").slice(0, 21)} UTC`;
