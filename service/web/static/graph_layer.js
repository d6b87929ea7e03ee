// Draws the pose graph: key frames along the path, loops between them, borders of sub-maps. Context draws in metres.

const NODE_PIXELS = 3;

export class GraphLayer {
  constructor() {
    this.clear();
  }

  clear() {
    this.ways = this.borders = [];
    this.accepted = this.refused = new Float32Array(0);
  }

  put({ ways, borders, accepted, refused }) {
    Object.assign(this, { ways, borders, accepted, refused });
  }

  copy() {
    const made = new GraphLayer();
    made.put(this);
    return made;
  }

  /** How many of each there are. */
  get counts() {
    return {
      keyFrames: this.ways.reduce((sum, path) => sum + path.length / 2, 0), borders: this.borders.length,
      accepted: this.accepted.length / 4, refused: this.refused.length / 4,
    };
  }

  draw(context, scale, colours) {
    const stroke = (colour, pixels, dash, trace) => {
      context.beginPath();
      trace();
      context.strokeStyle = colour;
      context.lineWidth = pixels / scale;
      context.setLineDash(dash.map((part) => part / scale));
      context.stroke();
    };
    stroke(colours.borders, 1.5, [6, 4], () => this.borders.forEach((border) => polyline(context, border, true)));
    stroke(colours.keyFrames, 1, [], () => this.ways.forEach((path) => polyline(context, path, false)));
    stroke(colours.refused, 1.5, [5, 4], () => segments(context, this.refused));
    stroke(colours.accepted, 2, [], () => segments(context, this.accepted));
    context.setLineDash([]);
    const size_m = NODE_PIXELS / scale;
    context.fillStyle = colours.keyFrames;
    for (const path of this.ways) {
      for (let i = 0; i < path.length; i += 2) {
        context.fillRect(path[i] - size_m / 2, path[i + 1] - size_m / 2, size_m, size_m);
      }
    }
  }
}

const polyline = (context, points, isClosed) => {
  if (points.length < 4) return;
  context.moveTo(points[0], points[1]);
  for (let i = 2; i < points.length; i += 2) context.lineTo(points[i], points[i + 1]);
  if (isClosed) context.closePath();
};

const segments = (context, ends) => {
  for (let i = 0; i < ends.length; i += 4) {
    context.moveTo(ends[i], ends[i + 1]);
    context.lineTo(ends[i + 2], ends[i + 3]);
  }
};
