/** What lies on crops beside the object: drawn things, other surfaces, other light. */

import { boxBlur, halfToEven, picture, times255, warp } from "./pixels.js";

export const CROP_PX = 128;
export const HALF_PX = 64;
const TILE_PX = 128;
const GRAIN_PX = 192;
export const NOTHING = 0;
export const THING = 1;
export const EDGE = 2;
const THING_SHARE = 0.4;
const EDGE_SHARE = 0.12;
const BESIDE_SHARE = 0.3;
const DIM_SHARE = 0.4;
const DIMMEST = 0.45;
const f32 = Math.fround;

/** Sprites of a sheet (RGBA, its colours times opacity): BGRA tiles, and how far each reaches. */
export function spritesOf({ data, width, height }) {
  const sprites = [];
  for (let top = 0; top < height; top += TILE_PX) {
    for (let left = 0; left < width; left += TILE_PX) {
      const tile = picture(TILE_PX, TILE_PX, 4);
      const reach = [0, 0];
      for (let y = 0; y < TILE_PX; y++) {
        for (let x = 0; x < TILE_PX; x++) {
          const from = ((top + y) * width + left + x) * 4;
          const to = (y * TILE_PX + x) * 4;
          for (let c = 0; c < 4; c++) tile.data[to + (c === 3 ? 3 : 2 - c)] = data[from + c];
          if (data[from + 3] === 0) continue;
          for (const [axis, at] of [x, y].entries()) {
            reach[axis] = Math.max(reach[axis], (Math.abs(2 * at - (TILE_PX - 1)) + 1) >> 1);
          }
        }
      }
      sprites.push({ tile, reach });
    }
  }
  return sprites;
}

/** Some of the crops get less light; colours change in place. */
export function dim(color, rng, count) {
  const draw = rng.randoms(count);
  const light = rng.uniform(DIMMEST, 1, count);
  for (let i = 0; i < 12 * count; i++) {
    const crop = (i / 12) | 0;
    if (draw[crop] < DIM_SHARE) color[i] = f32(color[i] * light[crop]);
  }
}

/** What is put on each crop; `quality` says which ones are negatives. */
export function planClutter(quality, sprites, rng) {
  const count = quality.length;
  const draw = rng.randoms(count);
  const addition = Uint8Array.from(draw, (share, i) => {
    if (share < (quality[i] ? BESIDE_SHARE : THING_SHARE)) return THING;
    return !quality[i] && share < THING_SHARE + EDGE_SHARE ? EDGE : NOTHING;
  });
  const things = planThings(rng, count, sprites);
  const direction = rng.uniform(-Math.PI, Math.PI, count);
  const radius = rng.uniform(42, 84, count);
  for (let i = 0; i < count; i++) {
    if (!quality[i]) continue; // beside the object
    things.center[2 * i] = HALF_PX + radius[i] * Math.cos(direction[i]);
    things.center[2 * i + 1] = HALF_PX + radius[i] * Math.sin(direction[i]);
  }
  return { addition, things, edges: planEdges(rng, count) };
}

function planThings(rng, count, sprites) {
  const brightness = rng.uniform(0.75, 1.2, count);
  const tint = rng.uniform(0.9, 1.1, 3 * count);
  const direction = rng.uniform(-Math.PI, Math.PI, count);
  const length = rng.uniform(0, 8, count);
  const radius = rng.integers(1, 5, count);
  const strength = rng.uniform(0, 0.6, count);
  return {
    sprite: rng.integers(0, sprites, count),
    center: Float32Array.from(rng.uniform(-4, 4, 2 * count), (off) => HALF_PX + off),
    turn: Float32Array.from(rng.uniform(-Math.PI, Math.PI, count)),
    scale: Float32Array.from(rng.uniform(0.8, 1.2, count)),
    gain: Int32Array.from(tint, (t, i) => halfToEven(brightness[(i / 3) | 0] * t * 256)),
    shadow: Int32Array.from({ length: 4 * count }, (_, i) => {
      const [crop, what] = [i >> 2, i & 3];
      if (what === 0) return halfToEven(length[crop] * Math.cos(direction[crop]));
      if (what === 1) return halfToEven(length[crop] * Math.sin(direction[crop]));
      return what === 2 ? radius[crop] : halfToEven(strength[crop] * 255);
    }),
  };
}

/** Edges of tables, gaps and sheets: four half planes (p, q, r), a colour, grain. */
function planEdges(rng, count) {
  const kind = rng.integers(0, 3, count);
  const turn = rng.uniform(-Math.PI, Math.PI, count);
  const middle = rng.uniform(-24, 24, 2 * count).map((off) => HALF_PX + off);
  const [gap, sheet, along] = [[1.5, 20], [12, 60], [12, 60]].map((r) => rng.uniform(...r, count));
  const soft = rng.randoms(count);
  const softness = rng.uniform(3, 16, count).map((px, i) => (soft[i] < 0.3 ? px : 1));
  const grey = rng.randoms(count);
  const colour = Uint8ClampedArray.from({ length: 3 * count }, (_, i) => {
    const crop = (i / 3) | 0;
    const value = (grey[crop] * 255 + 30 * rng.normal()) * (kind[crop] === 1 ? 0.35 : 1);
    return Math.floor(Math.max(value, 0));
  });
  const strength = Float64Array.from({ length: count }, () => Math.min(10 * rng.exponential(), 60));
  const tile = rng.integers(0, 2, count);
  const corner = rng.integers(0, 65, 2 * count);
  const planes = new Int32Array(12 * count);
  for (let i = 0; i < count; i++) {
    const half = [[Infinity, gap[i], sheet[i]][kind[i]], kind[i] === 2 ? along[i] : Infinity];
    const steep = (255 * 256) / softness[i];
    for (let side = 0; side < 4; side++) {
      const inward = turn[i] + (side * Math.PI) / 2;
      const [cos, sin] = [Math.cos(inward), Math.sin(inward)];
      const far = half[side % 2];
      const near = far === Infinity ? (side === 0 ? 0 : 1e3) : far;
      const distance = near - (cos * middle[2 * i] + sin * middle[2 * i + 1]);
      planes[12 * i + 3 * side] = halfToEven(cos * steep);
      planes[12 * i + 3 * side + 1] = halfToEven(sin * steep);
      planes[12 * i + 3 * side + 2] = halfToEven((distance + softness[i] / 2) * steep);
    }
  }
  return { planes, colour, grain: Int32Array.from({ length: 4 * count }, (_, i) => {
    const crop = i >> 2;
    const parts = [tile[crop], corner[2 * crop], corner[2 * crop + 1], halfToEven(strength[crop])];
    return parts[i & 3];
  }) };
}

/** Put what is planned for one crop on it (128 x 128 BGRA), in place. */
export function addClutter(crop, plan, row, sprites) {
  if (plan.addition[row] === THING) pasteThing(crop, plan.things, row, sprites);
  if (plan.addition[row] === EDGE) paintEdge(crop, plan.edges, row);
}

function pasteThing(crop, plan, row, sprites) {
  const { tile, reach } = sprites[plan.sprite[row]];
  const [scale, turn] = [plan.scale[row], plan.turn[row]];
  const [cos, sin] = [scale * Math.cos(turn), scale * Math.sin(turn)];
  const [x, y] = plan.center.subarray(2 * row, 2 * row + 2);
  const halfX = Math.abs(cos) * reach[0] + Math.abs(sin) * reach[1] + 1;
  const halfY = Math.abs(sin) * reach[0] + Math.abs(cos) * reach[1] + 1;
  const box = clipped([x - halfX, y - halfY, x + halfX + 1, y + halfY + 1].map(
    (side, i) => (i < 2 ? Math.floor(side) : Math.ceil(side)),
  ));
  if (box[0] >= box[2] || box[1] >= box[3]) return;
  const [kCos, kSin] = [Math.cos(turn) / scale, Math.sin(turn) / scale];
  const [u, v, middle] = [x - box[0], y - box[1], (TILE_PX - 1) / 2];
  const toTile = [kCos, -kSin, middle - kCos * u + kSin * v, kSin, kCos, middle - kSin * u - kCos * v];
  const layer = picture(box[2] - box[0], box[3] - box[1], 4);
  const lit = gained(tile, reach, plan.gain.subarray(3 * row, 3 * row + 3));
  warp(lit, layer, toTile, false);
  blend(crop, layer, box, plan.shadow.subarray(4 * row, 4 * row + 4));
}

const clipped = (box) => box.map((side) => Math.min(Math.max(side, 0), CROP_PX));

/** The sprite with its colours times a gain [1/256]; what cannot be seen is left out. */
function gained(tile, [reachX, reachY], gain) {
  const out = picture(TILE_PX, TILE_PX, 4);
  const half = TILE_PX / 2;
  for (let y = half - reachY; y < half + reachY; y++) {
    for (let i = (y * TILE_PX + half - reachX) * 4; i < (y * TILE_PX + half + reachX) * 4; i += 4) {
      for (let c = 0; c < 3; c++) out.data[i + c] = (tile.data[i + c] * gain[c] + 128) >> 8;
      out.data[i + 3] = tile.data[i + 3];
    }
  }
  return out;
}

/** Lay a layer and its shadow (offset x and y, radius, strength) on a box of the crop. */
function blend(crop, layer, box, [offsetX, offsetY, radius, strength]) {
  const reach = Math.max(Math.abs(offsetX), Math.abs(offsetY)) + radius;
  const grown = box.map((side, i) => side + (i < 2 ? -reach : reach));
  const whole = strength > 0 ? clipped(grown) : box;
  const [width, height] = [whole[2] - whole[0], whole[3] - whole[1]];
  const opacity = new Uint8Array(width * height);
  const inBox = (x, y) => x >= box[0] && x < box[2] && y >= box[1] && y < box[3];
  const inLayer = (x, y) => ((y - box[1]) * layer.width + x - box[0]) * 4;
  for (let y = box[1]; y < box[3]; y++) {
    for (let x = box[0]; x < box[2]; x++) {
      opacity[(y - whole[1]) * width + x - whole[0]] = layer.data[inLayer(x, y) + 3];
    }
  }
  const soft = strength > 0 ? boxBlur(opacity, width, height, radius) : null;
  for (let y = whole[1]; y < whole[3]; y++) {
    for (let x = whole[0]; x < whole[2]; x++) {
      const [fromX, fromY] = [x - whole[0] - offsetX, y - whole[1] - offsetY];
      let seen = 255;
      if (soft && fromX >= 0 && fromY >= 0 && fromX < width && fromY < height) {
        seen = 255 - times255(strength, soft[fromY * width + fromX]);
      }
      const covered = inBox(x, y);
      const at = inLayer(x, y);
      if (covered) seen = times255(seen, 255 - layer.data[at + 3]);
      const to = (y * CROP_PX + x) * 4;
      for (let c = 0; c < 3; c++) {
        crop.data[to + c] = times255(crop.data[to + c], seen) + (covered ? layer.data[at + c] : 0);
      }
    }
  }
}

/** Cover what lies inside all half planes with another surface. */
function paintEdge(crop, plan, row) {
  const planes = plan.planes.subarray(12 * row, 12 * row + 12);
  const colour = plan.colour.subarray(3 * row, 3 * row + 3);
  const [tile, left, top, strength] = plan.grain.subarray(4 * row, 4 * row + 4);
  for (let y = 0, o = 0; y < CROP_PX; y++) {
    for (let x = 0; x < CROP_PX; x++, o += 4) {
      let least = 255 << 8;
      for (let i = 0; i < 12; i += 3) {
        least = Math.min(least, planes[i] * x + planes[i + 1] * y + planes[i + 2]);
      }
      const share = Math.max(least, 0) >> 8;
      if (!share) continue;
      const grain = GRAIN[tile][(y + top) * GRAIN_PX + x + left];
      const bump = ((grain - 128) * strength) >> 7;
      for (let c = 0; c < 3; c++) {
        const surface = Math.min(Math.max(colour[c] + bump, 0), 255);
        crop.data[o + c] = times255(surface, share) + times255(crop.data[o + c], 255 - share);
      }
    }
  }
}

/** Two tiles of noise about 128, fine and blotchy; the fine one a byte of Wellons' lowbias32. */
function grainTiles() {
  const fine = Uint8Array.from({ length: GRAIN_PX * GRAIN_PX }, (_, i) => {
    let bits = Math.imul(i ^ (i >>> 16), 0x7feb352d);
    bits = Math.imul(bits ^ (bits >>> 15), 0x846ca68b);
    return (bits ^ (bits >>> 16)) & 255;
  });
  const around = (at) => (at + GRAIN_PX) % GRAIN_PX;
  const blotchy = new Uint8ClampedArray(fine.length);
  for (let y = 0; y < GRAIN_PX; y++) {
    for (let x = 0; x < GRAIN_PX; x++) {
      let total = 0;
      for (let v = -2; v <= 2; v++) {
        for (let u = -2; u <= 2; u++) total += fine[around(y + v) * GRAIN_PX + around(x + u)];
      }
      blotchy[y * GRAIN_PX + x] = 128 + Math.floor(((total - 25 * 128) * 4) / 25);
    }
  }
  return [fine, blotchy];
}

const GRAIN = grainTiles();
