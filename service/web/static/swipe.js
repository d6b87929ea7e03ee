// Another version of the map left of a line that a slider moves, the present one right of it.

import { byId, element, setText } from "./dom.js";
import { decode } from "./protocol.js";
import { TileMap } from "./tiles.js";

export class Swipe {
  /** view: of the map. */
  constructor(view) {
    this.view = view;
    this.words = element("span", { id: "swipe-words" });
    this.slider = element("input", { type: "range", id: "swipe-at", min: "0", max: "100", step: "1", value: "50", "aria-labelledby": "swipe-words" });
    this.slider.addEventListener("input", () => this.#move());
    byId("swipe").append(this.words, this.slider, element("button", { type: "button", id: "swipe-end", onclick: () => this.clear() }, "End"));
  }

  /** The answer to map_version; present: number of the version that is shown. */
  async show({ version, tiles }, present) {
    const { edge, cell_m, tiles: decoded } = await decode(Uint8Array.from(atob(tiles), (c) => c.charCodeAt(0)).buffer);
    const other = new TileMap();
    for (const { ix, iy, cells } of decoded) other.put(ix, iy, edge, cell_m, cells);
    this.view.other = { tiles: other, share: 0.5 };
    this.view.readColours(); // of its tiles, too
    setText(this.words, `Left: version ${version}. Right: ${present}, the present one.`);
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
