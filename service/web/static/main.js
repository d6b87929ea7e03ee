// Joins the parts of the page.

import { drawCrossHair } from "./canvas.js";
import { Connection } from "./connection.js";
import { Control } from "./control.js";
import { byId, onClick, setPressed, setText, showTitlesOnTap } from "./dom.js";
import { Edit } from "./edit.js";
import { fixed } from "./format.js";
import { Gestures } from "./gestures.js";
import { hasOwnPose, LEVELS, statusOf } from "./health.js";
import { History } from "./history.js";
import { Information } from "./information.js";
import { drawFleet } from "./layers.js";
import { Legend } from "./legend.js";
import { drawCompass, drawMetres, drawScale, northOf, savePicture } from "./map_frame.js";
import { MapView } from "./map_view.js";
import { Resources } from "./resources.js";
import { Past, Replay } from "./strips.js";
import { chooseTab, setUpTabs } from "./tabs.js";
import { setUpTheme } from "./theme.js";
import { MeasureTool, PoseTool } from "./tools.js";

const POSE_WORDS_MS = 200; // figures that change faster cannot be read

const view = new MapView(byId("map")), legend = new Legend(view), fleet = { vehicles: [] };
const information = new Information((sensor) => view.colourOf(sensor));
let tool = null, runId = "", isOpen = false, poseTimer = null, health = null;

const connection = new Connection({
  open: () => { isOpen = true; showState(); },
  closed: () => {
    isOpen = false;
    showState();
    information.putLost();
    for (const part of [control, replay, past, edit]) part.update();
  },
  hello: (hello) => {
    if (hello.run_id !== runId) {
      for (const part of [view, edit.compare, past, information, history]) part.clear();
      edit.putGraph({ evidence: {} });
      legend.update();
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
  tiles: (message) => { view.putTiles(message); legend.update("change"); byId("empty").hidden = view.tiles.tiles.size > 0; },
  graph: (message) => { view.put("graph", message); edit.putGraph(message); legend.update("graph"); },
  standing: (message) => { view.put("standing", message); legend.update("standing"); },
  changes: (message) => { view.put("stored", message); legend.update("stored"); },
  path: (message) => view.putPath(message),
  vehicles: ({ vehicles }) => { fleet.vehicles = vehicles; view.invalidate(); },
  scan: (message) => { if (view.putScan(message)) legend.update("scans"); information.putScan(message); },
  mountings: ({ pose_base_sensor }) => { view.mountings = pose_base_sensor; },
  moment: (moment) => {
    for (const part of [view, information, history]) part.putMoment(moment);
    past.put(moment);
    replay.root.hidden = true; // finished: its pace matters no more
    information.putPose(view.track.last);
  },
  moment_over: () => { view.endMoment(); past.clear(); },
  pose: (pose) => {
    view.putPose(pose);
    poseTimer ??= setTimeout(() => { // the newest is shown when it is due
      poseTimer = null;
      if (view.track.last) information.putPose(view.track.last);
    }, POSE_WORDS_MS);
  },
  health: (message) => {
    health = message;
    for (const part of [information, control, replay, edit, resources]) part.putHealth(message);
    byId("tab-history").hidden = !hasOwnPose(message);
    view.isHeld = replay.state === "paused";
    showState();
  },
  series: (message) => history.put(message),
  event: (message) => { information.putEvent(message); history.putEvent(message); },
});

const control = new Control(byId("control"), connection, (chosen) => setTool(new PoseTool(view, { done: (pose) => { setTool(null); chosen(pose); } })));
const replay = new Replay(connection, (verb, request) => control.ask(verb, request, { quietly: "Replay" }));
const past = new Past(connection, (position_s) => control.ask("moment_go_to", { position_s }, { quietly: "Moment" }));
const history = new History(byId("history"), (stamp_s) => past.goTo(stamp_s));
const edit = new Edit(connection, view, setTool);
const resources = new Resources(byId("resources"), connection, () => (view.isLive ? view.track.last : null));
onClick("tab-resources", () => resources.refresh());

/** The one thing that everybody should see at once: is it well, and if not, why. */
function showState() {
  const mapping = statusOf(health, "mapping");
  const [level, word, reason] = !isOpen ? ["none", "no connection", "The service does not answer; this page goes on trying."]
    : !mapping ? ["none", "starting", "The service compiles or waits for its first scan."]
      : [LEVELS[mapping.level], mapping.values.state ?? "waiting", mapping.message === "ok" ? "" : mapping.message];
  byId("state").dataset.level = level;
  setText(byId("state"), word);
  setText(byId("reason"), reason);
}

view.overlays = [
  (...drawing) => drawFleet(...drawing, fleet.vehicles),
  (...drawing) => { if (view.layers.grid) drawMetres(...drawing, view.gridStep_m); },
  drawScale,
  (...drawing) => drawCompass(...drawing, northOf(health)),
  (...drawing) => edit.draw(...drawing),
  (...drawing) => {
    if (!tool) return;
    tool.draw(...drawing);
    if (byId("map").matches(":focus-visible")) drawCrossHair(...drawing);
    setText(byId("hint"), tool.hint);
  },
];

function setTool(next) {
  const before = tool;
  tool = next;
  if (before !== next) before?.ended?.();
  setPressed(byId("measure"), tool instanceof MeasureTool);
  byId("map").classList.toggle("pointing", tool !== null);
  byId("hint-bar").hidden = tool === null;
  setText(byId("hint"), tool?.hint ?? "");
  if (tool) chooseTab("map", { onlyOnPhone: true });
  view.invalidate();
}

function cancelTool() {
  const area = tool?.area;
  setTool(null);
  if (area) chooseTab(area, { onlyOnPhone: true }); // back to where it was chosen
}

const gestures = new Gestures(view, () => tool, {
  f: () => view.follow(!view.follows), 0: () => view.fit(),
  m: () => setTool(tool instanceof MeasureTool ? null : new MeasureTool(view)),
  b: () => edit.compare.show(!view.showsBefore), ",": () => past.step(-1), ".": () => past.step(1),
});
gestures.onHover = (point) => {
  tool?.hover?.(point);
  const [x_m, y_m] = view.camera.toMap(...point), value = view.tiles.valueAt(x_m, y_m);
  const stands = view.layers.standing ? view.standing.valueAt(x_m, y_m) : -1;
  setText(byId("cursor"), `x ${fixed(x_m, 2, " m")}  y ${fixed(y_m, 2, " m")}  ${value < 0 ? "unknown" : `${value} % occupied`}${stands < 0 ? "" : `  static score ${stands} %`}`);
};
const BUTTONS = { follow: "f", fit: "0", "zoom-in": "+", "zoom-out": "-", "turn-left": "[", "turn-right": "]", north: "n", measure: "m" };
for (const [id, key] of Object.entries(BUTTONS)) onClick(id, () => gestures.key(key));
view.onFollows = () => setPressed(byId("follow"), view.follows);
onClick("picture", () => savePicture(view, byId("vehicle").textContent, past.moment?.at_s ?? Date.now() / 1000));
document.addEventListener("keydown", (event) => { if (event.key === "Escape" && tool && !byId("confirm").open) cancelTool(); });
onClick("cancel-tool", cancelTool);
for (const answer of ["no", "other"]) onClick(`confirm-${answer}`, () => byId("confirm").close(answer));
setUpTabs();
showTitlesOnTap();
setUpTheme(() => {
  view.readColours();
  legend.update();
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
    moment: past.moment, graph: view.graph.counts, change: view.change.counts, stored: view.stored.counts, rows: history.series.rows.length, bytes: connection.bytes,
    scanPoints: Object.fromEntries([...view.scans].map(([sensor, { points }]) => [sensor, points?.length / 2])),
  }),
};
