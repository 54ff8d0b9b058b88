/**
 * Arithmetic on pictures, to the bit as docs/bundle.md has it.
 *
 * A picture is {data, width, height, channels}, bytes row by row. A `Uint8ClampedArray` rounds half
 * to even and saturates when a number is stored in it, as is wanted; fused multiply-adds are sums
 * in doubles, rounded once.
 */

const f32 = Math.fround;

export function picture(width, height, channels, data) {
  return { width, height, channels, data: data ?? new Uint8ClampedArray(width * height * channels) };
}

/** Canvas pixels (RGBA) as BGR with an unused fourth channel, in which windows are quick to cut. */
export function fromCanvas({ width, height, data }) {
  const out = new Uint8ClampedArray(data.length);
  for (let i = 0; i < data.length; i += 4) {
    out[i] = data[i + 2];
    out[i + 1] = data[i + 1];
    out[i + 2] = data[i];
    out[i + 3] = 255;
  }
  return picture(width, height, 4, out);
}

/** Index mirrored into 0 to n - 1 without repeating the border (BORDER_REFLECT_101). */
function mirrored(i, n) {
  while (i < 0 || i >= n) i = i < 0 ? -i : 2 * n - 2 - i;
  return i;
}

/**
 * warpAffine with bilinear interpolation of a picture of four channels; a mirrored one is a frame,
 * whose fourth channel is 255 throughout.
 *
 * `matrix` (6) maps pixels of `to` to pixels of `from`. What lies outside is the mirrored picture,
 * or nothing where `mirror` is false. Coordinates are in single precision.
 */
export function warp(from, to, matrix, mirror) {
  const { data, width, height } = from;
  const out = to.data;
  const m = Float32Array.from(matrix);
  const at = new Int32Array(4);
  for (let y = 0, o = 0; y < to.height; y++) {
    const startX = f32(f32(m[1] * y) + m[2]);
    const startY = f32(f32(m[4] * y) + m[5]);
    for (let x = 0; x < to.width; x++, o += 4) {
      const fromX = f32(m[0] * x + startX);
      const fromY = f32(m[3] * x + startY);
      const left = Math.floor(fromX);
      const top = Math.floor(fromY);
      const a = fromX - left;
      const b = fromY - top;
      if (left >= 0 && top >= 0 && left < width - 1 && top < height - 1) {
        const p = (top * width + left) * 4;
        const q = p + 4 * width;
        out[o] = between(data[p], data[p + 4], data[q], data[q + 4], a, b);
        out[o + 1] = between(data[p + 1], data[p + 5], data[q + 1], data[q + 5], a, b);
        out[o + 2] = between(data[p + 2], data[p + 6], data[q + 2], data[q + 6], a, b);
        out[o + 3] = mirror ? 255 : between(data[p + 3], data[p + 7], data[q + 3], data[q + 7], a, b);
      } else {
        corners(at, left, top, width, height, mirror);
        for (let c = 0; c < 4; c++) {
          const [p, q, r, s] = [...at].map((i) => (i < 0 ? 0 : data[i + c]));
          out[o + c] = between(p, q, r, s, a, b);
        }
      }
    }
  }
}

function between(p00, p01, p10, p11, a, b) {
  const upper = f32(p00 + a * (p01 - p00));
  const lower = f32(p10 + a * (p11 - p10));
  return f32(upper + b * f32(lower - upper));
}

/** Where the four pixels around a point lie, -1 outside unless it is mirrored. */
function corners(at, left, top, width, height, mirror) {
  for (let i = 0; i < 4; i++) {
    let x = left + (i & 1);
    let y = top + (i >> 1);
    if (mirror) [x, y] = [mirrored(x, width), mirrored(y, height)];
    at[i] = x >= 0 && y >= 0 && x < width && y < height ? (y * width + x) * 4 : -1;
  }
}

/**
 * An affine map of BGR pixels: `color` (12 float32 from `at`) in fixed point with 10 bits.
 *
 * From four channels into three, packed, from byte `start` of `out`.
 */
export function recolor({ data }, color, at, out, start) {
  const m = new Int32Array(12);
  for (let i = 0; i < 12; i++) {
    const value = i % 4 === 3 ? f32(color[at + i] + 0.5) : color[at + i];
    m[i] = halfToEven(value * 1024);
  }
  for (let i = 0, o = start; i < data.length; i += 4, o += 3) {
    const blue = data[i];
    const green = data[i + 1];
    const red = data[i + 2];
    out[o] = (m[0] * blue + m[1] * green + m[2] * red + m[3]) >> 10;
    out[o + 1] = (m[4] * blue + m[5] * green + m[6] * red + m[7]) >> 10;
    out[o + 2] = (m[8] * blue + m[9] * green + m[10] * red + m[11]) >> 10;
  }
}

/** To the nearest integer, of two the even one. */
export function halfToEven(value) {
  const big = 6755399441055744; // beyond it doubles are integers
  return value + big - big;
}

/** `(a b + 127) / 255` of bytes, rounded down. */
export function times255(a, b) {
  return ((a * b + 127) / 255) | 0;
}

/** The mean of each byte's box of side `2 radius + 1`, nothing outside; one channel. */
export function boxBlur(bytes, width, height, radius) {
  const side = 2 * radius + 1;
  const sums = new Int32Array(width * height);
  for (let y = 0; y < height; y++) {
    let sum = 0;
    for (let x = -radius; x < width; x++) {
      if (x + radius < width) sum += bytes[y * width + x + radius];
      if (x - radius > 0) sum -= bytes[y * width + x - radius - 1];
      if (x >= 0) sums[y * width + x] = sum;
    }
  }
  const out = new Uint8Array(width * height);
  const half = (side * side) >> 1;
  for (let x = 0; x < width; x++) {
    let sum = 0;
    for (let y = -radius; y < height; y++) {
      if (y + radius < height) sum += sums[(y + radius) * width + x];
      if (y - radius > 0) sum -= sums[(y - radius - 1) * width + x];
      if (y >= 0) out[y * width + x] = ((sum + half) / (side * side)) | 0;
    }
  }
  return out;
}
