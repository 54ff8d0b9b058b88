/** `cv2.resize`, to the bit: smaller by area, larger by bilinear interpolation. */

import { halfToEven, picture } from "./pixels.js";

const f32 = Math.fround;

/** Width and height [px] of a scaled frame. */
export function scaledShape({ width, height }, scale) {
  return [width, height].map((side) => Math.max(halfToEven(side * scale), 1));
}

/** A frame (four channels) at another scale. */
export function scaled(frame, scale) {
  if (scale === 1) return frame;
  const out = picture(...scaledShape(frame, scale), 4);
  if (scale > 1) byLines(frame, out);
  else byArea(frame, out);
  return out;
}

/** Where a point [x, y] of a frame lies in the same frame at another size. */
export function movedPoint(point, from, to) {
  const sides = [to.width / from.width, to.height / from.height];
  return point.map((value, axis) => (value + 0.5) * sides[axis] - 0.5);
}

function byArea(from, to) {
  const [stepX, stepY] = [1 / (to.width / from.width), 1 / (to.height / from.height)];
  const whole = (step) => Math.abs(step - Math.round(step)) < Number.EPSILON;
  if (whole(stepX) && whole(stepY)) return byBlocks(from, to, Math.round(stepX), Math.round(stepY));
  const across = shares(from.width, to.width, stepX);
  const down = shares(from.height, to.height, stepY);
  const row = new Float32Array(4 * to.width);
  const sum = new Float32Array(4 * to.width);
  for (let j = 0; j < down.at.length; j++) {
    row.fill(0);
    const line = 4 * from.width * down.at[j];
    for (let i = 0; i < across.at.length; i++) {
      const s = line + 4 * across.at[i];
      const d = 4 * across.to[i];
      for (let c = 0; c < 4; c++) row[d + c] += f32(from.data[s + c] * across.share[i]);
    }
    const y = down.to[j];
    const first = j === 0 || down.to[j - 1] !== y;
    for (let i = 0; i < row.length; i++) {
      const part = f32(row[i] * down.share[j]);
      sum[i] = first ? part : sum[i] + part;
    }
    if (down.to[j + 1] !== y) to.data.set(sum, 4 * to.width * y);
  }
}

/** Which share of a pixel `at` of a line goes into which pixel `to` of the smaller line. */
function shares(many, few, step) {
  const out = { at: [], to: [], share: [] };
  const add = (at, to, share) => {
    out.at.push(at);
    out.to.push(to);
    out.share.push(f32(share));
  };
  for (let i = 0; i < few; i++) {
    const [begin, end] = [i * step, i * step + step];
    const size = Math.min(step, many - begin);
    const last = Math.min(Math.floor(end), many - 1);
    const first = Math.min(Math.ceil(begin), last);
    if (first - begin > 1e-3) add(first - 1, i, (first - begin) / size);
    for (let at = first; at < last; at++) add(at, i, 1 / size);
    if (end - last > 1e-3) add(last, i, Math.min(end - last, 1, size) / size);
  }
  return out;
}

function byBlocks(from, to, stepX, stepY) {
  const share = f32(1 / (stepX * stepY));
  for (let y = 0, o = 0; y < to.height; y++) {
    for (let x = 0; x < to.width; x++) {
      for (let c = 0; c < 4; c++, o++) {
        let sum = 0;
        for (let j = 0; j < stepY; j++) {
          const line = ((y * stepY + j) * from.width + x * stepX) * 4 + c;
          for (let i = 0; i < stepX; i++) sum += from.data[line + 4 * i];
        }
        to.data[o] = stepX === 2 && stepY === 2 ? (sum + 2) >> 2 : f32(sum * share);
      }
    }
  }
}

function byLines(from, to) {
  const across = weights(from.width, to.width, true);
  const down = weights(from.height, to.height, false);
  for (let y = 0, o = 0; y < to.height; y++) {
    const [upper, lower] = [4 * from.width * down.at[y], 4 * from.width * down.next[y]];
    for (let x = 0; x < to.width; x++) {
      for (let c = 0; c < 4; c++, o++) {
        const [left, right] = [4 * across.at[x] + c, 4 * across.next[x] + c];
        const [a, b] = [across.near[x], across.far[x]];
        const above = from.data[upper + left] * a + from.data[upper + right] * b;
        const below = from.data[lower + left] * a + from.data[lower + right] * b;
        const sum = ((down.near[y] * (above >> 4)) >> 16) + ((down.far[y] * (below >> 4)) >> 16);
        to.data[o] = (sum + 2) >> 2;
      }
    }
  }
}

/**
 * Which two pixels of a line each pixel of the longer line lies between, and their weights.
 *
 * Beyond the outermost pixel both are that one: `sure` of it, or with weights as anywhere, which
 * are rounded each.
 */
function weights(few, many, sure) {
  const out = { at: [], next: [], near: [], far: [] };
  const inside = (at) => Math.min(Math.max(at, 0), few - 1);
  for (let i = 0; i < many; i++) {
    const place = f32((i + 0.5) * (1 / (many / few)) - 0.5);
    const at = Math.floor(place);
    const part = sure && (at < 0 || at >= few - 1) ? 0 : f32(place - at);
    out.at.push(inside(at));
    out.next.push(inside(at + 1));
    out.near.push(halfToEven(f32(1 - part) * 2048));
    out.far.push(halfToEven(part * 2048));
  }
  return out;
}
