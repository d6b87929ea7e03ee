// The map before the newest change, drawn in place of the map as it is: by hand, or in turn.

import { element } from "./dom.js";

const FLICKER_MS = 700; // slower than three changes a second, which may harm people

export class BeforeAfter {
  constructor(view) {
    this.view = view;
    this.timer = null;
    this.toggle = element("button", { type: "button", id: "show-before", "aria-pressed": "false", title: "The map before the newest change (B)",
      onclick: () => this.show(!this.view.showsBefore) }, "Show before");
    this.flicker = element("button", { type: "button", id: "flicker", "aria-pressed": "false", onclick: () => this.#flicker() }, "Flicker");
    this.clear();
  }

  /** Keep the map as it is shown now: a change is about to be made. */
  keep() {
    this.#stop();
    this.show(false);
    this.next = this.view.snapshot();
  }

  /** The change was made: what was kept is what was before. */
  made() {
    this.view.before = this.next;
    this.toggle.hidden = this.flicker.hidden = false;
  }

  clear() {
    this.#stop();
    this.show(false);
    this.view.before = this.next = null;
    this.toggle.hidden = this.flicker.hidden = true;
  }

  show(isBefore) {
    this.view.showsBefore = isBefore && this.view.before !== null;
    this.toggle.setAttribute("aria-pressed", String(this.view.showsBefore));
    this.view.invalidate();
  }

  #flicker() {
    if (this.timer !== null) {
      this.#stop();
      this.show(false);
      return;
    }
    this.timer = setInterval(() => this.show(!this.view.showsBefore), FLICKER_MS);
    this.flicker.setAttribute("aria-pressed", "true");
  }

  #stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.flicker.setAttribute("aria-pressed", "false");
  }
}
