// The physics of gymnasium's CartPole-v1, by the same steps of arithmetic. Pure functions.

const GRAVITY = 9.8;
const CART_MASS = 1.0;
const POLE_MASS = 0.1;
const TOTAL_MASS = POLE_MASS + CART_MASS;
const HALF_LENGTH = 0.5;
const POLE_MASS_LENGTH = POLE_MASS * HALF_LENGTH;
const FORCE = 10.0;
const SECONDS = 0.02; // of one step
const LARGEST_ANGLE = (12 * 2 * Math.PI) / 360;
const LARGEST_PLACE = 2.4;

/** Return the state [place, speed, angle, spin] after one step. Action 1 pushes to the right, 0 to the left. */
export function stepped([place, speed, angle, spin], action) {
  const force = action === 1 ? FORCE : -FORCE;
  const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
  const push = (force + POLE_MASS_LENGTH * spin * spin * sine) / TOTAL_MASS;
  const turn =
    (GRAVITY * sine - cosine * push) / (HALF_LENGTH * (4.0 / 3.0 - (POLE_MASS * cosine * cosine) / TOTAL_MASS));
  const acceleration = push - (POLE_MASS_LENGTH * turn * cosine) / TOTAL_MASS;
  return [place + SECONDS * speed, speed + SECONDS * acceleration, angle + SECONDS * spin, spin + SECONDS * turn];
}

/** Return whether the episode has terminated: the cart is too far away, or the pole has fallen. */
export function fallen([place, , angle]) {
  return place < -LARGEST_PLACE || place > LARGEST_PLACE || angle < -LARGEST_ANGLE || angle > LARGEST_ANGLE;
}

/** Return the state in which an episode begins. */
export function start(random = Math.random) {
  return Array.from({ length: 4 }, () => random() * 0.1 - 0.05);
}
