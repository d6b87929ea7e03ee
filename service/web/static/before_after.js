// The map before the newest change, drawn in place of the map as it is: by hand, or in turn.

import { card, element, setText } from "./dom.js";

const FLICKER_MS = 700; // slower than three changes a second, which may harm people

export class BeforeAfter {
  constructor(view) {
    this.view = view;
    this.timer = null;
    this.words = element("p", { className: "note", id: "compare-words", role: "status" });
    this.toggle = element("button", { type: "button", id: "show-before", "aria-pressed": "false", title: "B",
      onclick: () => this.show(!this.view.showsBefore) }, "Show before");
    this.flicker = element("button", { type: "button", id: "flicker", "aria-pressed": "false", onclick: () => this.#flicker() }, "Flicker");
    this.card = card("Before and after");
    this.card.node.append(this.words, element("div", { className: "row" }, this.toggle, this.flicker));
    this.clear();
  }

  /** Keep the map as it is shown now: a change is about to be made. */
  keep() {
    this.#stop();
    this.show(false);
    this.next = this.view.snapshot();
  }

  /** The change was made: what was kept is what was before. */
  made(version, words) {
    this.view.before = this.next;
    this.card.node.hidden = false;
    setText(this.words, `Version ${version}: ${words}`);
  }

  clear() {
    this.#stop();
    this.show(false);
    this.view.before = this.next = null;
    this.card.node.hidden = true;
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
