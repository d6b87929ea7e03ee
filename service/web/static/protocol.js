// The binary messages of service/web/protocol.py, which describes them.

export const RANGE_STEP_M = 0.005;
const FIRST_CAUSE = 65_280; // from here on a number says why a beam has no range

/** What is compressed from a byte on. */
const inflated = (view, from) =>
  new Response(new Blob([new Uint8Array(view.buffer, from)]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();

const edgeOfCell = (view) => Math.round(view.getFloat32(4, true) * 1e6) / 1e6;

const decodeTiles = async (view) => {
  const edge = view.getUint16(2, true), count = view.getUint32(8, true), body = await inflated(view, 12);
  const places = new Int32Array(body, 0, 2 * count), cells = new Int8Array(body, 8 * count);
  const tile = (_, i) => ({ ix: places[2 * i], iy: places[2 * i + 1], cells: cells.subarray(i * edge * edge, (i + 1) * edge * edge) });
  return { type: "tiles", edge, cell_m: edgeOfCell(view), tiles: Array.from({ length: count }, tile) };
};

const decodeScan = (view) => {
  const nameBytes = view.getUint8(1), beams = view.getUint16(2, true), start = 24 + nameBytes;
  const ranges = new Uint16Array(view.buffer.slice(start, start + 2 * beams));
  return {
    type: "scan",
    sensor: new TextDecoder().decode(new Uint8Array(view.buffer, 24, nameBytes)),
    stamp_s: view.getFloat64(4, true),
    first_angle_rad: view.getFloat32(12, true),
    angle_step_rad: view.getFloat32(16, true),
    beam_interval_s: view.getFloat32(20, true),
    ranges: ranges.map((steps) => (steps < FIRST_CAUSE ? steps : 0)),
    causes: Uint8Array.from(ranges, (steps) => (steps < FIRST_CAUSE ? 0 : steps - FIRST_CAUSE)),
  };
};

const decodePath = (view) => ({
  type: "path",
  goesOn: view.getUint8(1) === 1, // it lies behind the path so far
  points: new Float32Array(view.buffer, 8, 2 * view.getUint32(4, true)),
});

/** Every list of points is flat: [x_m, y_m, x_m, y_m ...]. */
const decodeGraph = async (view) => {
  const body = await inflated(view, 4);
  const [paths, borders, accepted, refused] = new Uint32Array(body, 0, 4);
  const counts = new Uint32Array(body, 16, paths + borders);
  let at = 16 + 4 * (paths + borders);
  const points = (count) => {
    const taken = new Float32Array(body, at, 2 * count);
    at += 8 * count;
    return taken;
  };
  const lines = Array.from(counts, points);
  return {
    type: "graph", paths: lines.slice(0, paths), borders: lines.slice(paths),
    accepted: points(2 * accepted), refused: points(2 * refused),
    evidence: JSON.parse(new TextDecoder().decode(new Uint8Array(body, at))),
  };
};

const decodePicture = async (type, view) => ({
  type,
  isKnown: view.getUint8(1) === 1,
  cell_m: edgeOfCell(view),
  column: view.getInt32(8, true),
  row: view.getInt32(12, true),
  width: view.getUint32(16, true),
  height: view.getUint32(20, true),
  cells: new Int8Array(await inflated(view, 24)),
});

const DECODERS = [decodeTiles, decodeScan, decodePath, decodeGraph, (view) => decodePicture("standing", view), (view) => decodePicture("changes", view)];

/** A message of the service as an object with a type; tiles take a moment to inflate. */
export const decode = (data) => {
  if (typeof data === "string") return JSON.parse(data);
  const view = new DataView(data), kind = view.getUint8(0); // from 1 on
  if (!DECODERS[kind - 1]) throw new Error(`message of kind ${kind}; expected 1 to ${DECODERS.length}`);
  return DECODERS[kind - 1](view);
};
