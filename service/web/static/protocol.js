// The binary messages of service/web/protocol.py, which describes them.

const TILES = 1, SCAN = 2, PATH = 3, GRAPH = 4, STANDING = 5, CHANGED = 6;
export const RANGE_STEP_M = 0.005;
const FIRST_CAUSE = 65_280; // from here on a number says why a beam has no range

const inflate = async (bytes) => {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
};

const decodeTiles = async (view) => {
  const edge = view.getUint16(2, true), cell_m = view.getFloat32(4, true), count = view.getUint32(8, true);
  const body = await inflate(new Uint8Array(view.buffer, 12));
  const places = new Int32Array(body, 0, 2 * count);
  const cells = new Int8Array(body, 8 * count);
  const tiles = [];
  for (let i = 0; i < count; i += 1) {
    const of = cells.subarray(i * edge * edge, (i + 1) * edge * edge);
    tiles.push({ ix: places[2 * i], iy: places[2 * i + 1], cells: of });
  }
  return { type: "tiles", edge, cell_m: Math.round(cell_m * 1e6) / 1e6, tiles };
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
  const body = await inflate(new Uint8Array(view.buffer, 4));
  const [ways, borders, accepted, refused] = new Uint32Array(body, 0, 4);
  const counts = new Uint32Array(body, 16, ways + borders);
  let at = 16 + 4 * (ways + borders);
  const points = (count) => {
    const taken = new Float32Array(body, at, 2 * count);
    at += 8 * count;
    return taken;
  };
  const lines = Array.from(counts, points);
  return {
    type: "graph", ways: lines.slice(0, ways), borders: lines.slice(ways),
    accepted: points(2 * accepted), refused: points(2 * refused),
    evidence: JSON.parse(new TextDecoder().decode(new Uint8Array(body, at))),
  };
};

const decodePicture = async (type, view) => ({
  type,
  isKnown: view.getUint8(1) === 1,
  cell_m: Math.round(view.getFloat32(4, true) * 1e6) / 1e6,
  column: view.getInt32(8, true),
  row: view.getInt32(12, true),
  width: view.getUint32(16, true),
  height: view.getUint32(20, true),
  cells: new Int8Array(await inflate(new Uint8Array(view.buffer, 24))),
});

/** A message of the service as an object with a type; tiles take a moment to inflate. */
export const decode = (data) => {
  if (typeof data === "string") return JSON.parse(data);
  const view = new DataView(data);
  switch (view.getUint8(0)) {
    case TILES: return decodeTiles(view);
    case SCAN: return decodeScan(view);
    case PATH: return decodePath(view);
    case GRAPH: return decodeGraph(view);
    case STANDING: return decodePicture("standing", view);
    case CHANGED: return decodePicture("changes", view);
    default: throw new Error(`message of kind ${view.getUint8(0)}; expected 1 to 6`);
  }
};
