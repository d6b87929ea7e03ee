// Joins the parts of the page.

import { Connection } from "./connection.js";
import { Control } from "./control.js";
import { byId, element, setText, showTitlesOnTap, swatched } from "./dom.js";
import { clockTime, counted, fixed } from "./format.js";
import { Edit } from "./edit.js";
import { drawCrossHair } from "./edit_tools.js";
import { FleetLayer } from "./fleet_layer.js";
import { Gestures } from "./gestures.js";
import { History } from "./history.js";
import { hasOwnPose, Information, LEVELS } from "./information.js";
import { drawCompass, drawMetres, drawScale, northOf, savePicture } from "./map_frame.js";
import { MapView } from "./map_view.js";
import { setUpPast } from "./past.js";
import { setUpReplay } from "./replay.js";
import { Resources } from "./resources.js";
import { chooseTab, setUpTabs } from "./tabs.js";
import { setUpTheme } from "./theme.js";
import { MeasureTool, PoseTool } from "./tools.js";

const POSE_WORDS_MS = 200; // figures that change faster cannot be read

const view = new MapView(byId("map")), fleet = new FleetLayer();
const information = new Information(byId("information"), (sensor) => view.colourOf(sensor));
let tool = null, runId = "", isOpen = false, poseTimer = null, health = null;

const connection = new Connection({
  open: () => { isOpen = true; showState(); },
  closed: () => { isOpen = false; showState(); information.putLost(); control.update(); replay.update(); past.update(); edit.update(); },
  hello: (hello) => {
    if (hello.run_id !== runId) {
      view.clear();
      edit.compare.clear();
      edit.putGraph({ evidence: {} });
      past.clear();
      information.clear();
      history.clear();
      explainLayers();
      health = null;
      showState();
    }
    runId = hello.run_id;
    setText(byId("vehicle"), hello.vehicle);
    byId("vehicle").title = hello.vehicle; // it may be cut off
    document.title = `${hello.vehicle} \u00b7 corridor`;
    information.causes = hello.causes ?? [];
    information.putEvents([]); // all of them come again
    history.events = [];
    control.putHello(hello);
    resources.verbs = hello.verbs;
    byId("tab-resources").hidden = !hello.stores;
    edit.putVerbs(hello);
  },
  verbs: (message) => { resources.verbs = message.verbs; control.putVerbs(message); edit.putVerbs(message); },
  access: (access) => {
    control.putAccess(access);
    replay.update();
    past.update();
    edit.putAccess();
    if (!byId("resources").hidden) resources.refresh();
  },
  refused: ({ error }) => console.error(error),
  tiles: (message) => { view.putTiles(message); explainChange(); byId("empty").hidden = view.tiles.tiles.size > 0; },
  graph: (message) => { view.putGraph(message); edit.putGraph(message); explainLayers(); },
  standing: (message) => { view.putStanding(message); explainStanding(); },
  changes: (message) => { view.putStoredChanges(message); explainStoredChanges(); },
  path: (message) => view.putPath(message),
  vehicles: (message) => { fleet.put(message); view.invalidate(); },
  scan: (message) => { if (view.putScan(message)) explainLayers(); information.putScan(message); },
  mountings: ({ pose_base_sensor }) => { view.mountings = pose_base_sensor; },
  moment: (moment) => {
    view.putMoment(moment);
    past.put(moment);
    replay.root.hidden = true; // finished: its pace matters no more
    information.putMoment(moment);
    history.putMoment(moment);
    information.putPose(view.track.last);
  },
  moment_over: () => { view.endMoment(); past.clear(); },
  pose: (pose) => {
    view.putPose(pose);
    if (poseTimer !== null) return; // the newest is shown when it is due
    poseTimer = setTimeout(() => {
      poseTimer = null;
      if (view.track.last) information.putPose(view.track.last);
    }, POSE_WORDS_MS);
  },
  health: (message) => {
    health = message;
    information.putHealth(message);
    control.putHealth(message);
    replay.putHealth(message);
    edit.putHealth(message);
    resources.putHealth(message);
    byId("tab-history").hidden = !hasOwnPose(message);
    view.isHeld = replay.state === "paused";
    showState();
  },
  series: (message) => history.put(message),
  event: (message) => { information.putEvent(message); history.putEvent(message); },
});

const control = new Control(byId("control"), connection, (done) => setTool(new PoseTool(view, (pose) => {
  setTool(null);
  done(pose);
})));
const replay = setUpReplay(connection, (verb, request) => control.ask(verb, request, { quietly: "Replay" }));
const past = setUpPast(connection, (position_s) => control.ask("moment_go_to", { position_s }, { quietly: "Moment" }));
const history = new History(byId("history"), (stamp_s) => past.goTo(stamp_s));
const lastPose = () => (view.track.last && view.isLive ? view.track.last : null);
const edit = new Edit(byId("edit"), connection, view, setTool);
const resources = new Resources(byId("resources"), connection, lastPose);
byId("tab-resources").addEventListener("click", () => resources.refresh());
const gestures = new Gestures(byId("map"), view, () => tool, () => showFollow());

/** The one thing that everybody should see at once: is it well, and if not, why. */
function showState() {
  const mapping = health?.statuses.find((status) => status.name === "mapping");
  const [level, word, reason] = !isOpen ? ["none", "no connection", "The service does not answer; this page goes on trying."]
    : !mapping ? ["none", "starting", "The service compiles or waits for its first scan."]
      : [LEVELS[mapping.level], mapping.values.state ?? "waiting", mapping.message === "ok" ? "" : mapping.message];
  byId("state").dataset.level = level;
  setText(byId("state"), word);
  setText(byId("reason"), reason);
}

view.overlays = [
  (...drawing) => fleet.draw(...drawing),
  (context, camera, colours) => { if (view.layers.grid) drawMetres(context, camera, colours, view.gridStep_m); },
  drawScale,
  (context, camera, colours) => drawCompass(context, camera, colours, northOf(health)),
  (...drawing) => edit.draw(...drawing),
  (...drawing) => tool?.draw(...drawing),
  (...drawing) => { if (tool && byId("map").matches(":focus-visible")) drawCrossHair(...drawing); },
];

function setTool(next) {
  const before = tool;
  tool = next;
  if (before !== next) before?.ended?.();
  byId("measure").setAttribute("aria-pressed", String(tool instanceof MeasureTool));
  byId("map").classList.toggle("pointing", tool !== null);
  byId("hint-bar").hidden = tool === null;
  setText(byId("hint"), tool?.hint ?? "");
  if (tool) chooseTab("map", { onlyOnPhone: true });
  view.invalidate();
}

/** On a phone back to the area in which the tool was chosen. */
function cancelTool() {
  const area = tool?.area;
  setTool(null);
  if (area) chooseTab(area, { onlyOnPhone: true });
}

function showFollow() {
  byId("follow").setAttribute("aria-pressed", String(view.follows));
}

const LAYERS = { map: "Map", standing: "Static score", path: "Path", graph: "Pose graph", change: "Change", stored: "Changed since the map was stored", scans: "Scans", vehicle: "Vehicle with its 95 % ellipse", grid: "Grid" };

const GRAPH_PARTS = { keyFrames: "Key frames", accepted: "Loops that hold", refused: "Loops not accepted", borders: "Sub-maps" };

/** A switch for each layer; what its colours mean stands below it. */
function setUpLayers() {
  for (const [layer, words] of Object.entries(LAYERS)) {
    const box = element("input", { type: "checkbox", checked: view.layers[layer], id: `layer-${layer}` });
    box.addEventListener("change", () => {
      view.layers[layer] = box.checked;
      if (layer === "change") compareFromNow();
      if (layer === "standing") explainStanding();
      view.invalidate();
    });
    byId("layers").append(element("label", {}, box, words), element("div", { className: "parts", id: `parts-${layer}` }));
  }
  explainStoredChanges();
}

/** The change that is shown begins on request. */
function compareFromNow() {
  if (view.layers.change) view.change.start(view.tiles);
  else view.change.clear();
  explainLayers();
  view.invalidate();
}

function explainLayers() {
  const { counts } = view.graph, { graph } = view.colours;
  const parts = Object.entries(GRAPH_PARTS).filter(([part]) => counts[part] > 0);
  byId("parts-graph").replaceChildren(...parts.map(([part, words]) => swatched(`${words}: ${counts[part]}`, graph[part], "graph-part")));
  explainChange();
  explainStoredChanges();
  explainStanding();
  byId("parts-scans").replaceChildren(...view.sensors.map((sensor) => swatched(sensor, view.colourOf(sensor), "laser")));
}

/** What its colours mean, once it is on. */
function explainStanding() {
  const [fresh, full] = [view.colours.standing.fresh, view.colours.standing.full].map((rgba) => `rgb(${rgba.slice(0, 3)})`);
  byId("parts-standing").replaceChildren(...(!view.layers.standing ? []
    : !view.standing.isKnown ? [element("span", {}, "Not known now")]
      : [swatched("Just come: counts little", fresh, "standing-part"), swatched("Stands for long: counts in full", full, "standing-part")]));
}

/** Offered where somebody watches: a vehicle that is only localised in a stored map. */
function explainStoredChanges() {
  const { isKnown, counts } = view.stored, { change } = view.colours, parts = byId("parts-stored");
  byId("layer-stored").parentElement.hidden = parts.hidden = !isKnown;
  parts.replaceChildren(swatched(`Stands there now: ${counted(counts.appeared, "cell")}`, change.appeared, "stored-part"),
    swatched(`Is gone: ${counted(counts.gone, "cell")}`, change.gone, "stored-part"));
}

function explainChange() {
  const { since, counts } = view.change, { change } = view.colours;
  byId("layer-change").checked = view.layers.change;
  if (!since) {
    byId("parts-change").replaceChildren();
    return;
  }
  const button = byId("change-now") ?? element("button", { type: "button", id: "change-now", onclick: compareFromNow }, "From now");
  byId("parts-change").replaceChildren(
    swatched(`Occupied since ${clockTime(since / 1000)}: ${counted(counts.appeared, "cell")}`, change.appeared, "change-part"),
    swatched(`Free since then: ${counted(counts.gone, "cell")}`, change.gone, "change-part"), button);
}

view.onDrawn = () => {
  if (tool?.text) setText(byId("hint"), tool.text);
};

gestures.onHover = ([sx, sy]) => {
  tool?.hover?.([sx, sy]);
  const [x_m, y_m] = view.camera.toMap(sx, sy);
  const value = view.tiles.valueAt(x_m, y_m);
  const cell = value < 0 ? "unknown" : `${value} % occupied`;
  const stands = view.layers.standing ? view.standing.valueAt(x_m, y_m) : -1;
  const score = stands < 0 ? "" : `  static score ${stands} %`;
  setText(byId("cursor"), `x ${fixed(x_m, 2, " m")}  y ${fixed(y_m, 2, " m")}  ${cell}${score}`);
};

view.onFollows = showFollow;
const toggleFollow = () => view.follow(!view.follows);
const toggleMeasure = () => setTool(tool instanceof MeasureTool ? null : new MeasureTool(view));
const showBefore = () => edit.compare.show(!view.showsBefore);
const clickMiddle = () => tool?.click?.([view.camera.width / 2, view.camera.height / 2]);
const fit = () => { view.fit(); showFollow(); };

byId("follow").addEventListener("click", toggleFollow);
byId("fit").addEventListener("click", fit);
byId("zoom-in").addEventListener("click", () => gestures.key("+"));
byId("zoom-out").addEventListener("click", () => gestures.key("-"));
byId("turn-left").addEventListener("click", () => gestures.turn(1));
byId("turn-right").addEventListener("click", () => gestures.turn(-1));
byId("north").addEventListener("click", () => gestures.north());
byId("measure").addEventListener("click", toggleMeasure);
byId("picture").addEventListener("click", () => savePicture(view, byId("vehicle").textContent, past.moment?.at_s ?? Date.now() / 1000));
byId("map").addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || (event.repeat && event.key === "Enter")) return;
  const own = { f: toggleFollow, F: toggleFollow, 0: fit, m: toggleMeasure, M: toggleMeasure, b: showBefore, B: showBefore,
    ",": () => past.step(-1), ".": () => past.step(1),
    Enter: clickMiddle, Backspace: () => tool?.back?.() }[event.key];
  if (own) own();
  if (own || gestures.key(event.key)) event.preventDefault();
});
document.addEventListener("keydown", (event) => { if (event.key === "Escape" && tool && !byId("confirm").open) cancelTool(); });
byId("cancel-tool").addEventListener("click", cancelTool);
for (const change of ["focus", "blur"]) byId("map").addEventListener(change, () => view.invalidate()); // the cross-hair

byId("confirm-no").addEventListener("click", () => byId("confirm").close("no"));
byId("confirm-other").addEventListener("click", () => byId("confirm").close("other"));
setUpTabs();
showTitlesOnTap();
setUpLayers();
setUpTheme(() => {
  view.readColours();
  explainLayers();
  edit.update();
  history.update();
  if (health) information.putHealth(health); // colours of the lasers
});
showState();
connection.open();
setInterval(() => view.invalidate(), 1000); // what is stale shall look so

/** For tests and for people who look into a fault: what the page shows. */
window.corridor = {
  view, connection, edit, past, history, fleet,
  report: () => ({
    runId, isOpen, mayControl: connection.mayControl, tiles: view.tiles.tiles.size, bounds: view.tiles.bounds,
    pose: view.track.last, pathPoints: view.path.length / 2, sensors: view.sensors, shownSensors: view.shownSensors, health, follows: view.follows,
    moment: past.moment, graph: view.graph.counts, change: view.change.counts, stored: view.stored.counts, rows: history.series.rows.length, bytes: connection.bytes, frames: view.frames, drawn_ms: [...view.drawn_ms],
    scanPoints: Object.fromEntries([...view.scans].map(([sensor, shownScan]) => [sensor, shownScan.points?.length / 2])),
  }),
};
