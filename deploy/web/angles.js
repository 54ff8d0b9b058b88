/** Angles of grasps [rad]: modulo half a turn, counter-clockwise as seen. */

const { PI } = Math;

/** Into (-pi/2, pi/2]. */
export function wrapped(angle) {
  const rest = (((PI / 2 - angle) % PI) + PI) % PI;
  return PI / 2 - rest <= -PI / 2 ? PI / 2 : PI / 2 - rest;
}

const factor = (encoding) => (encoding === "double" ? 2 : 1);

/** Sine and cosine that stand for an angle. */
export function encoded(angle, encoding) {
  const turned = factor(encoding) * wrapped(angle);
  return [Math.sin(turned), Math.cos(turned)];
}

/** The angle that they stand for. */
export function decoded(sine, cosine, encoding) {
  return wrapped(Math.atan2(sine, cosine) / factor(encoding));
}

/** Mean of line directions, and how much they agree on it, 0 to 1. */
export function meanDirection(angles) {
  let [x, y] = [0, 0];
  for (const angle of angles) {
    x += Math.cos(2 * angle) / angles.length;
    y += Math.sin(2 * angle) / angles.length;
  }
  return { angle: wrapped(Math.atan2(y, x) / 2), strength: Math.hypot(x, y) };
}
