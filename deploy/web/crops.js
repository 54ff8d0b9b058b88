/** One frame becomes 1000 labelled crops: planned at random first, then cut by a fixed rule. */

import { addClutter, CROP_PX, dim, HALF_PX, planClutter } from "./clutter.js";
import { picture, recolor, warp } from "./pixels.js";

export const TRAIN_CROPS = 800;
export const CROPS = 1000;
const NEGATIVE_PX = 28; // closer, a window is neither clearly centred nor clearly not
const NEAR_MISS_PX = 64;
const LUMA = [0.114, 0.587, 0.299]; // of blue, green, red

/**
 * Where, how turned, in what colours and with what on it each crop is cut.
 *
 * `frame`: {width, height}; `center`: [x, y] of the object; `sprites`: how many things there are,
 * 0 for crops of the frame alone.
 */
export function planCrops(frame, center, rng, sprites, count = CROPS) {
  checkRoom(frame, center);
  const quality = rng.shuffle(Float32Array.from({ length: count }, (_, i) => i % 2));
  const inside = insideOf(frame);
  const jitter = rng.uniform(-4, 4, 2 * count);
  const negative = negativeCenters(frame, center, rng, count);
  const plan = {
    quality,
    center: Float32Array.from(jitter, (off, i) =>
      quality[i >> 1] ? inside(center[i & 1] + off, i & 1) : negative[i]),
    turn: Float32Array.from(rng.uniform(-Math.PI, Math.PI, count)),
    color: colors(rng, count),
    clutter: null,
  };
  if (sprites > 0) {
    dim(plan.color, rng, count);
    plan.clutter = planClutter(quality, sprites, rng);
  }
  return plan;
}

/** Cut crops `first` to `last` into `out` (N x 128 x 128 x 3 BGR bytes). */
export function cutCrops(frame, plan, sprites, first, last, out) {
  const window = picture(CROP_PX, CROP_PX, 4);
  for (let row = first; row < last; row++) {
    const [cos, sin] = [Math.cos(plan.turn[row]), Math.sin(plan.turn[row])];
    const shiftX = plan.center[2 * row] - (cos * HALF_PX - sin * HALF_PX);
    const shiftY = plan.center[2 * row + 1] - (sin * HALF_PX + cos * HALF_PX);
    warp(frame, window, [cos, -sin, shiftX, sin, cos, shiftY], true);
    if (plan.clutter) addClutter(window, plan.clutter, row, sprites);
    recolor(window, plan.color, 12 * row, out, (row - first) * CROP_PX * CROP_PX * 3);
  }
}

/** Refuse a frame whose object has no room around it. */
function checkRoom({ width, height }, [x, y]) {
  const fits = x >= HALF_PX && y >= HALF_PX && x <= width - HALF_PX && y <= height - HALF_PX;
  if (!fits) {
    throw new Error("The object is too close to the border: leave as much table around it as it is large.");
  }
  const steps = (side, at) =>
    Array.from({ length: 33 }, (_, i) => HALF_PX + (i / 32) * (side - 2 * HALF_PX) - at);
  const across = steps(width, x);
  const far = steps(height, y).map((v) => across.filter((u) => Math.hypot(u, v) >= NEGATIVE_PX));
  if (far.flat().length / 33 ** 2 < 0.05) {
    throw new Error("There is too little around the object to tell it from: step back.");
  }
}

function insideOf({ width, height }) {
  const most = [width - HALF_PX, height - HALF_PX];
  return (value, axis) => Math.min(Math.max(value, HALF_PX), most[axis]);
}

/** Window centres, half of them near misses, none of them on the object. */
function negativeCenters(frame, center, rng, count) {
  const near = rng.randoms(count);
  const direction = rng.uniform(-Math.PI, Math.PI, count);
  const radius = rng.uniform(NEGATIVE_PX, NEAR_MISS_PX, count);
  const anywhere = (n) => {
    const most = [frame.width - HALF_PX, frame.height - HALF_PX];
    return rng.randoms(2 * n).map((share, i) => HALF_PX + (most[i & 1] - HALF_PX) * share);
  };
  const inside = insideOf(frame);
  const centers = anywhere(count).map((value, i) => {
    const row = i >> 1;
    if (near[row] >= 0.5) return inside(value, i & 1);
    const unit = i & 1 ? Math.sin(direction[row]) : Math.cos(direction[row]);
    return inside(radius[row] * unit + center[i & 1], i & 1);
  });
  for (;;) {
    const bad = [];
    for (let row = 0; row < count; row++) {
      const [x, y] = [centers[2 * row] - center[0], centers[2 * row + 1] - center[1]];
      if (Math.sqrt(x * x + y * y) < NEGATIVE_PX) bad.push(row);
    }
    if (!bad.length) return centers;
    const others = anywhere(bad.length);
    for (const [i, row] of bad.entries()) centers.set(others.subarray(2 * i, 2 * i + 2), 2 * row);
  }
}

/** Affine maps (N x 3 x 4) of BGR: contrast, saturation, white balance and brightness. */
function colors(rng, count) {
  const contrast = rng.uniform(0.8, 1.25, count);
  const saturation = rng.uniform(0.7, 1.3, count);
  const white = rng.uniform(0.9, 1.1, 3 * count);
  const brightness = rng.uniform(-25, 25, count);
  const maps = new Float32Array(12 * count);
  for (let i = 0; i < 12 * count; i++) {
    const [crop, row, column] = [(i / 12) | 0, ((i % 12) / 4) | 0, i % 4];
    const c = contrast[crop];
    if (column === 3) {
      maps[i] = brightness[crop] + 128 * (1 - c);
      continue;
    }
    const s = saturation[crop];
    const mix = (row === column ? s : 0) + (1 - s) * LUMA[column];
    maps[i] = c * white[3 * crop + row] * mix;
  }
  return maps;
}
