// The list of layers: a switch for each, and below it what its colours mean.

import { button, byId, element, swatched } from "./dom.js";
import { clockTime, counted } from "./format.js";

const GRAPH_PARTS = { keyFrames: "Key frames", accepted: "Loops that hold", refused: "Loops not accepted", borders: "Sub-maps" };

export class Legend {
  constructor(view) {
    this.view = view;
    this.fromNow = button("From now", () => { view.compare(true); this.update("change"); }, { id: "change-now" });
    for (const [layer, isOn] of Object.entries(view.layers)) {
      const box = byId(`layer-${layer}`);
      box.checked = isOn;
      box.onchange = () => {
        view.layers[layer] = box.checked;
        if (layer === "change") view.compare(box.checked);
        this.update();
        view.invalidate();
      };
    }
    this.update();
  }

  /** Of those layers; none are named: of all. */
  update(...layers) {
    const parts = { graph: () => this.#graph(), change: () => this.#change(), standing: () => this.#standing(), stored: () => this.#stored(),
      scans: () => this.view.sensors.map((sensor) => swatched(sensor, this.view.colourOf(sensor), "laser")) };
    for (const layer of layers.length ? layers : Object.keys(parts)) byId(`parts-${layer}`).replaceChildren(...parts[layer]());
  }

  #graph() {
    const { graph: { counts }, colours: { graph } } = this.view;
    return Object.entries(GRAPH_PARTS).filter(([part]) => counts[part] > 0).map(([part, words]) => swatched(`${words}: ${counts[part]}`, graph[part], "graph-part"));
  }

  #change() {
    const { change: { before, since, counts }, layers, colours } = this.view;
    byId("layer-change").checked = layers.change;
    if (!before) return [];
    return [swatched(`Occupied since ${clockTime(since / 1000)}: ${counted(counts.appeared, "cell")}`, colours.change.appeared, "change-part"),
      swatched(`Free since then: ${counted(counts.gone, "cell")}`, colours.change.gone, "change-part"), this.fromNow];
  }

  #standing() {
    const { layers, standing, colours: { standing: { fresh, full } } } = this.view, css = (rgba) => `rgb(${rgba.slice(0, 3)})`;
    if (!layers.standing) return [];
    return !standing.isKnown ? [element("span", {}, "Not known now")]
      : [swatched("Just come: counts little", css(fresh), "standing-part"), swatched("Stands for long: counts in full", css(full), "standing-part")];
  }

  /** Offered while the vehicle is only localised in a stored map. */
  #stored() {
    const { stored: { isKnown, counts }, colours } = this.view;
    byId("layer-stored").parentElement.hidden = byId("parts-stored").hidden = !isKnown;
    return [swatched(`Stands there now: ${counted(counts.appeared, "cell")}`, colours.change.appeared, "stored-part"),
      swatched(`Is gone: ${counted(counts.gone, "cell")}`, colours.change.gone, "stored-part")];
  }
}
