// The map beside another one: the one before the newest change, or a stored version.

import { byId, onClick, setPressed, setText } from "./dom.js";
import { decode } from "./protocol.js";
import { TileMap } from "./tiles.js";

/** The map before the newest change, shown in place of the map as it is. */
export class BeforeAfter {
  constructor(view) {
    this.view = view;
    this.toggle = byId("show-before");
    onClick("show-before", () => this.show(!view.showsBefore));
    this.clear();
  }

  keep() {
    this.show(false);
    this.next = { tiles: this.view.tiles.copy(), path: this.view.path, graph: this.view.graph };
  }

  made() {
    this.view.before = this.next;
    this.toggle.hidden = false;
  }

  clear() {
    this.show(false);
    this.view.before = this.next = null;
    this.toggle.hidden = true;
  }

  show(isBefore) {
    this.view.showsBefore = isBefore && this.view.before !== null;
    setPressed(this.toggle, this.view.showsBefore);
    this.view.invalidate();
  }
}

/** Another version of the map left of a line that a slider moves, the present one right of it. */
export class Swipe {
  constructor(view) {
    this.view = view;
    this.slider = byId("swipe-at");
    this.slider.oninput = () => this.#move();
    onClick("swipe-end", () => this.clear());
  }

  /** The answer to map_version; present: number of the version that is shown. */
  async show({ version, tiles }, present) {
    const message = await decode(Uint8Array.from(atob(tiles), (c) => c.charCodeAt(0)).buffer), other = new TileMap();
    for (const tile of message.tiles) other.put(tile, message.edge, message.cell_m);
    this.view.other = { tiles: other };
    setText(byId("swipe-words"), `Left: version ${version}. Right: ${present}, the present one.`);
    this.slider.value = "50";
    byId("swipe").hidden = false;
    this.#move();
  }

  clear() {
    byId("swipe").hidden = true;
    this.view.other = null;
    this.view.invalidate();
  }

  #move() {
    this.view.other.share = Number(this.slider.value) / 100;
    this.slider.setAttribute("aria-valuetext", `${this.slider.value} % of the map`);
    this.view.invalidate();
  }
}
