// Where two walls meet: the corner that a person means by a click near it. Points are [x_m, y_m].

import { distance } from "./geometry.js";

const NEAR_M = 0.6; // from the point that was clicked; walls beyond it have no say
const OFF_WALL_M = 0.025; // of a point of a wall, at most
const MIN_POINTS = 4; // of a wall
const MIN_ANGLE_RAD = Math.PI / 6; // between two walls
const GAP_M = 0.15; // from a wall's nearest point to the corner
const MAX_POINTS = 80; // the nearest; the time goes with the cube of them
const MIN_SHARE = 0.85; // of the points that lie on the two walls: a column has no corner
const ROUNDS = 3; // of giving each point to the wall that it is nearer to

/** Line through points by least squares of the distances: {x, y, dx, dy}, a point of it and its direction. */
const fitted = (points) => {
  const sum = (value) => points.reduce((so_far, point) => so_far + value(...point), 0);
  const x = sum((px) => px) / points.length, y = sum((_, py) => py) / points.length;
  const angle = Math.atan2(2 * sum((px, py) => (px - x) * (py - y)), sum((px, py) => (px - x) ** 2 - (py - y) ** 2)) / 2;
  return { x, y, dx: Math.cos(angle), dy: Math.sin(angle) };
};

const offLine = ({ x, y, dx, dy }, [px, py]) => Math.abs(dx * (py - y) - dy * (px - x));

/** The line on which most points lie, and those; null where too few lie on one. Every pair of points is tried. */
const wallOf = (points) => {
  let best = [];
  for (let i = 0; i < points.length; i += 1) {
    for (let j = i + 1; j < points.length; j += 1) {
      const [x, y] = points[i], length = distance(points[i], points[j]);
      if (length < 2 * OFF_WALL_M) continue; // too short for a direction
      const line = { x, y, dx: (points[j][0] - x) / length, dy: (points[j][1] - y) / length };
      const on = points.filter((point) => offLine(line, point) < OFF_WALL_M);
      if (on.length > best.length) best = on;
    }
  }
  return best.length < MIN_POINTS ? null : { on: best, line: fitted(best) };
};

/** Both with the points that are theirs; null where there are no two, or where much lies on neither. */
const twoWalls = (near) => {
  const first = wallOf(near);
  const second = first && wallOf(near.filter((point) => offLine(first.line, point) >= OFF_WALL_M));
  if (!second) return null;
  let walls = [first, second];
  for (let round = 0; round < ROUNDS; round += 1) {
    const own = [[], []];
    for (const point of near) {
      const [toFirst, toSecond] = walls.map(({ line }) => offLine(line, point));
      if (Math.min(toFirst, toSecond) < OFF_WALL_M) own[Number(toSecond < toFirst)].push(point);
    }
    if (own.some((on) => on.length < MIN_POINTS)) return null;
    walls = own.map((on) => ({ on, line: fitted(on) }));
  }
  return walls[0].on.length + walls[1].on.length < MIN_SHARE * near.length ? null : walls;
};

const gap = (points, corner) => Math.min(...points.map((point) => distance(point, corner)));

/** Corner of the two walls around a point; null where there are no two, or where they do not reach it. */
export const cornerNear = (points, about) => {
  const away = (point) => distance(point, about);
  const walls = twoWalls(points.filter((point) => away(point) < NEAR_M).sort((p, q) => away(p) - away(q)).slice(0, MAX_POINTS));
  if (!walls) return null;
  const [a, b] = walls.map(({ line }) => line), cross = a.dx * b.dy - a.dy * b.dx;
  if (Math.abs(cross) < Math.sin(MIN_ANGLE_RAD)) return null;
  const along = ((b.x - a.x) * b.dy - (b.y - a.y) * b.dx) / cross;
  const corner = [a.x + along * a.dx, a.y + along * a.dy];
  return walls.every(({ on }) => gap(on, corner) < GAP_M) ? corner : null;
};
