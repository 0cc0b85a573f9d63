// Geometry of poses [x, y, heading] in m and rad, headings counter-clockwise, as in protocol/motion.py.

export const TAU = 2 * Math.PI;

/** Returns the pose after driving with (v, omega) for `s` seconds. */
export function step([x, y, heading], v, omega, s) {
  const half = (omega * s) / 2;
  const length = half === 0 ? v * s : (v * s * Math.sin(half)) / half;
  return [x + length * Math.cos(heading + half), y + length * Math.sin(heading + half), heading + omega * s];
}

/** Returns the controls (v, omega) with which a robot drives from one pose to another in `s` seconds. */
export function controls(from, to, s) {
  const half = (to[2] - from[2]) / 2, course = from[2] + half;
  const length = (to[0] - from[0]) * Math.cos(course) + (to[1] - from[1]) * Math.sin(course);
  return [(half === 0 ? length : (length * half) / Math.sin(half)) / s, (2 * half) / s];
}

/** Returns the pose `local`, given in `frame`, in the parent frame of `frame`. */
export function compose(frame, local) {
  const c = Math.cos(frame[2]), s = Math.sin(frame[2]);
  return [frame[0] + c * local[0] - s * local[1], frame[1] + s * local[0] + c * local[1], frame[2] + local[2]];
}

/** Returns the inverse of a pose: compose(pose, inverse(pose)) is the origin. */
export function inverse([x, y, heading]) {
  const c = Math.cos(heading), s = Math.sin(heading);
  return [-x * c - y * s, x * s - y * c, -heading];
}

export const distance = (one, other) => Math.hypot(one[0] - other[0], one[1] - other[1]);

export function wrap(angle) {
  const turned = angle - TAU * Math.round(angle / TAU);
  return turned <= -Math.PI ? Math.PI : turned;
}

/** Returns the semi-axes and the direction of the error ellipse of a covariance [xx, xy, xh, yy, yh, hh]. */
export function ellipse([xx, xy, , yy], sigmas) {
  const mean = (xx + yy) / 2, spread = Math.hypot((xx - yy) / 2, xy);
  const root = (value) => sigmas * Math.sqrt(Math.max(0, value));
  return { major: root(mean + spread), minor: root(mean - spread), turn: Math.atan2(2 * xy, xx - yy) / 2 };
}

/** Returns the pose at the fraction `share` of a tick, driven from `from` and corrected towards `to` if known. */
export function between(from, to, driven, share, period) {
  if (share <= 0) return from;
  if (!driven) return share < 1 || !to ? from : to;
  const [v, omega] = driven;
  const end = step(from, v, omega, period), now = step(from, v, omega, period * share);
  if (!to) return now;
  return [
    now[0] + share * (to[0] - end[0]),
    now[1] + share * (to[1] - end[1]),
    now[2] + share * wrap(to[2] - end[2]),
  ];
}

/** Returns the robot's anchor frame. Its heading is the true one, or 0 if the ground truth is hidden. */
export function frame_of(robot, truth) {
  return truth && robot.frame ? robot.frame : [...(robot.anchor ?? [0, 0]), 0];
}
