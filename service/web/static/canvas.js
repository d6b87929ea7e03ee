// What several pictures on a canvas have in common. Points are [x, y] in the units of the context.

export const FONT = "system-ui, sans-serif";
const ARROW = [[0.6, 0], [-0.4, -0.35], [-0.2, 0], [-0.4, 0.35]]; // of length 1, to the right

export const trace = (path, points, isClosed = false) => {
  points.forEach(([x, y], i) => (i ? path.lineTo(x, y) : path.moveTo(x, y)));
  if (isClosed) path.closePath();
};

export const strokeLine = (context, ...points) => {
  context.beginPath();
  trace(context, points);
  context.stroke();
};

export const dot = (context, [x, y], radius) => {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
};

export const square = (context, [x, y], size) => context.fillRect(x - size / 2, y - size / 2, size, size);

export const drawArrow = (context, length, fill, edge) => {
  context.beginPath();
  trace(context, ARROW.map(([x, y]) => [length * x, length * y]), true);
  context.fillStyle = fill;
  context.fill();
  context.strokeStyle = edge;
  context.stroke();
};

export const haloed = (context, words, x, y) => {
  context.lineWidth = 3;
  context.strokeText(words, x, y);
  context.fillText(words, x, y);
};

export const drawCrossHair = (context, { width, height }, { measure }) => {
  context.strokeStyle = measure;
  context.lineWidth = 1.5;
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    strokeLine(context, ...[4, 16].map((pixels) => [width / 2 + pixels * dx, height / 2 + pixels * dy]));
  }
};

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** 1, 2 or 5 times a power of ten, at least `least`. */
export const niceLength = (least) => {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((k) => k * power).find((length) => length >= least * (1 - 1e-9));
};
