/** Where a tuned object is in a frame and how far it is turned, as its network says. */

import { decoded, wrapped } from "./angles.js";
import { CROP_PX, HALF_PX } from "./clutter.js";
import { halfToEven } from "./pixels.js";
import { movedPoint, scaled, scaledShape } from "./resize.js";

const CELL_PX = 16;
const FINE_PX = 4;
const FINE_REACH_PX = 32;
const FINE_SIDE_PX = CROP_PX + 2 * FINE_REACH_PX;
const LARGEST_PX = 2048; // of a side at the object's scale: more takes too much memory
export const FOUND_FROM = 0.5;
const TINY = 1e-9;

/**
 * Find an object in a frame (a picture of four channels, BGR first).
 *
 * `about`: `encoding`, `offset_rad` and `scale` of its description. Centre and move [px] are in the
 * frame's own pixels; the turn since the demonstration is in degrees, counter-clockwise.
 */
export async function locate(ort, session, about, frame) {
  const sides = scaledShape(frame, about.scale);
  if (Math.min(...sides) < CROP_PX) throw new Error("The picture is too small for this object.");
  if (Math.max(...sides) > LARGEST_PX) {
    throw new Error("The picture is too large for this object: take it as the first one was taken.");
  }
  const seen = scaled(frame, about.scale);
  const heatmapOf = (part) => heatmap(ort, session, part);
  let found = coarse(await heatmapOf(seen), about);
  if (found.found) found = await refined(found, seen, heatmapOf, about);
  const center = about.scale === 1 ? found.center : movedPoint(found.center, seen, frame);
  const move = [center[0] - frame.width / 2, center[1] - frame.height / 2];
  return { ...found, center, move };
}

/** Quality, sine and cosine for every window of a frame. */
async function heatmap(ort, session, { width, height, data }) {
  const pixels = new Uint8Array(width * height * 3);
  for (let i = 0, o = 0; o < pixels.length; i += 4, o += 3) {
    pixels[o] = data[i];
    pixels[o + 1] = data[i + 1];
    pixels[o + 2] = data[i + 2];
  }
  const frame = new ort.Tensor("uint8", pixels, [height, width, 3]);
  const { heatmap: { dims, data: values } } = await session.run({ frame });
  if (!values.every(Number.isFinite)) throw new Error("The object answers with no numbers.");
  const [, rows, cols] = dims;
  const size = rows * cols;
  const plane = (i) => values.subarray(i * size, (i + 1) * size);
  return { rows, cols, quality: plane(0), sine: plane(1), cosine: plane(2) };
}

/** The mean of the cells around the strongest blob. */
function coarse(map, about) {
  const { rows, cols, quality, sine, cosine } = map;
  const [row, col] = peak(map);
  let [total, x, y, s, c] = [0, 0, 0, 0, 0];
  let best = 0;
  for (let j = Math.max(row - 1, 0); j < Math.min(row + 2, rows); j++) {
    for (let i = Math.max(col - 1, 0); i < Math.min(col + 2, cols); i++) {
      const at = j * cols + i;
      const weight = quality[at] + TINY;
      total += weight;
      x += weight * i;
      y += weight * j;
      s += weight * sine[at];
      c += weight * cosine[at];
      best = Math.max(best, quality[at]);
    }
  }
  const center = [x, y].map((sum) => HALF_PX + CELL_PX * (sum / total));
  return { found: best >= FOUND_FROM, quality: best, center, turnDeg: turned(s, c, about) };
}

const turned = (sine, cosine, about) =>
  (wrapped(decoded(sine, cosine, about.encoding) - about.offset_rad) * 180) / Math.PI;

/** Row and column of the middle of the strongest blob: the best supported of those as good. */
function peak({ rows, cols, quality }) {
  const best = quality.reduce((a, b) => Math.max(a, b), 0);
  const inside = (at, n) => Math.min(Math.max(at, 0), n - 1);
  let [row, col, most] = [0, 0, -2];
  for (let j = 0; j < rows; j++) {
    for (let i = 0; i < cols; i++) {
      let support = -1;
      if (quality[j * cols + i] >= Math.fround(Math.fround(0.9) * best)) {
        support = 0;
        for (let v = -1; v < 2; v++) {
          for (let u = -1; u < 2; u++) {
            const at = inside(j + v, rows) * cols + inside(i + u, cols);
            support += (2 - Math.abs(u)) * (2 - Math.abs(v)) * quality[at];
          }
        }
      }
      if (support > most) [row, col, most] = [j, i, support];
    }
  }
  return [row, col];
}

/** Look again with windows 4 px apart: sixteen small heatmaps, each shifted. */
async function refined(found, frame, heatmapOf, about) {
  const corner = [frame.width, frame.height].map((size, axis) => {
    const start = halfToEven(found.center[axis]) - FINE_REACH_PX - HALF_PX;
    return Math.max(Math.min(start, size - FINE_SIDE_PX), 0);
  });
  const cells = [];
  for (let down = 0; down < CELL_PX; down += FINE_PX) {
    for (let right = 0; right < CELL_PX; right += FINE_PX) {
      const [left, top] = [corner[0] + right, corner[1] + down];
      const part = cropped(frame, left, top, FINE_SIDE_PX - CELL_PX);
      if (Math.min(part.width, part.height) < CROP_PX) continue;
      const { rows, cols, quality, sine, cosine } = await heatmapOf(part);
      for (let at = 0; at < rows * cols; at++) {
        const x = left + HALF_PX + CELL_PX * (at % cols);
        const y = top + HALF_PX + CELL_PX * Math.floor(at / cols);
        cells.push({ x, y, quality: quality[at], sine: sine[at], cosine: cosine[at] });
      }
    }
  }
  const half = cells.reduce((most, cell) => Math.max(most, cell.quality), 0) / 2;
  let [total, x, y] = [0, 0, 0];
  for (const cell of cells) {
    const weight = Math.max(cell.quality - half, 0) + TINY;
    total += weight;
    x += weight * cell.x;
    y += weight * cell.y;
  }
  const center = [x / total, y / total];
  let [sine, cosine] = [0, 0];
  for (const cell of cells) {
    const away = (cell.x - center[0]) ** 2 + (cell.y - center[1]) ** 2;
    const near = Math.exp((-0.5 * away) / FINE_PX ** 2);
    sine += near * cell.sine;
    cosine += near * cell.cosine;
  }
  return { ...found, center, turnDeg: turned(sine, cosine, about) };
}

/** A square of a picture, or what of it lies inside. */
function cropped({ width, height, data }, left, top, side) {
  const [right, bottom] = [Math.min(left + side, width), Math.min(top + side, height)];
  const out = { width: Math.max(right - left, 0), height: Math.max(bottom - top, 0) };
  out.data = new Uint8ClampedArray(out.width * out.height * 4);
  for (let y = 0; y < out.height; y++) {
    const start = ((top + y) * width + left) * 4;
    out.data.set(data.subarray(start, start + 4 * out.width), y * 4 * out.width);
  }
  return out;
}
