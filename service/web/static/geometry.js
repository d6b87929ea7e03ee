// Points [x, y] and poses {x_m, y_m, theta_rad} in the plane; pose_map_base takes base coordinates to map.

export const distance = ([x0, y0], [x1, y1]) => Math.hypot(x1 - x0, y1 - y0);

/** Points of [x, y, x, y ...]. */
export const pointsOf = (flat) => Array.from({ length: flat.length / 2 }, (_, i) => [flat[2 * i], flat[2 * i + 1]]);

/** Index of the one whose value(one, index) is least, and below `most`; -1 where there is none. */
export const leastIndex = (list, value, most = Infinity) => {
  let least = most, found = -1;
  list.forEach((one, i) => {
    const its = value(one, i);
    if (its < least) [least, found] = [its, i];
  });
  return found;
};

export const compose = (a, b) => {
  const c = Math.cos(a.theta_rad), s = Math.sin(a.theta_rad);
  return { x_m: a.x_m + c * b.x_m - s * b.y_m, y_m: a.y_m + s * b.x_m + c * b.y_m, theta_rad: a.theta_rad + b.theta_rad };
};

/** A point [x, y] of the map in the frame of pose_map_base [x_m, y_m, theta_rad]. */
export const seenFrom = ([x_m, y_m, theta_rad], [x, y]) => {
  const c = Math.cos(theta_rad), s = Math.sin(theta_rad);
  return [c * (x - x_m) + s * (y - y_m), c * (y - y_m) - s * (x - x_m)];
};

export const wrapAngle = (rad) => rad - 2 * Math.PI * Math.round(rad / (2 * Math.PI));

const interpolate = (a, b, share) => ({
  x_m: a.x_m + share * (b.x_m - a.x_m),
  y_m: a.y_m + share * (b.y_m - a.y_m),
  theta_rad: a.theta_rad + share * wrapAngle(b.theta_rad - a.theta_rad),
});

/** Where a base that moves by twist (m/s forward, m/s left, rad/s) is after dt_s. */
const moved = (pose, [x, y, theta], dt_s) => compose(pose, { x_m: x * dt_s, y_m: y * dt_s, theta_rad: theta * dt_s });

const root = (variance) => Math.sqrt(Math.max(variance, 0));

const CHI2_95_PLANE = 5.991; // 95 % of a normal distribution of two dimensions
const CHI_95_LINE = 1.96;

/** Half axes (m) and direction (rad, base frame) of the 95 % ellipse of a 3x3 covariance of x, y, theta. */
export const ellipse = (covariance) => {
  const [a, b, , , d] = covariance;
  const mean = (a + d) / 2, spread = Math.hypot((a - d) / 2, b);
  return {
    major_m: root(CHI2_95_PLANE * (mean + spread)), minor_m: root(CHI2_95_PLANE * (mean - spread)),
    direction_rad: Math.atan2(2 * b, a - d) / 2, heading_rad: CHI_95_LINE * root(covariance[8]),
  };
};

/** Standard deviations along the map's axes: the covariance of a pose is in the axes of its base. */
export const deviationsInMap = ({ theta_rad, covariance }) => {
  const c = Math.cos(theta_rad), s = Math.sin(theta_rad);
  const [xx, xy, , , yy] = covariance;
  return {
    x_std_m: root(c * c * xx - 2 * c * s * xy + s * s * yy),
    y_std_m: root(s * s * xx + 2 * c * s * xy + c * c * yy),
    theta_std_rad: root(covariance[8]),
  };
};

const KEPT_S = 3;
const MAX_AHEAD_S = 0.3; // of the last pose: farther on the pose is not known

/** The poses of the last seconds, by stamp. */
export class PoseTrack {
  poses = [];

  add(pose) {
    const last = this.poses.at(-1);
    if (last && pose.stamp_s < last.stamp_s) this.poses.length = 0; // another run
    else if (last?.stamp_s === pose.stamp_s) this.poses.pop(); // of another laser, less than a microsecond later
    this.poses.push(pose);
    while (this.poses[0].stamp_s < pose.stamp_s - KEPT_S) this.poses.shift();
  }

  get last() {
    return this.poses.at(-1) ?? null;
  }

  clear() {
    this.poses.length = 0;
  }

  /** {pose, twist, isFinal} at a stamp; before a later pose has come it is the last one, moved on. null: not known. */
  at(stamp_s) {
    const last = this.last;
    if (!last || stamp_s < this.poses[0].stamp_s) return null;
    if (stamp_s >= last.stamp_s) {
      const ahead_s = stamp_s - last.stamp_s;
      if (ahead_s > MAX_AHEAD_S) return null;
      return { pose: moved(last, last.twist, ahead_s), twist: last.twist, isFinal: stamp_s === last.stamp_s };
    }
    const i = this.poses.findLastIndex((pose) => pose.stamp_s <= stamp_s), a = this.poses[i], b = this.poses[i + 1];
    const share = (stamp_s - a.stamp_s) / (b.stamp_s - a.stamp_s);
    return { pose: interpolate(a, b, share), twist: a.twist, isFinal: true };
  }
}
