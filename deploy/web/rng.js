/** numpy's `default_rng`: PCG64 seeded by SeedSequence, and what is drawn from it, in its order. */

const MASK64 = (1n << 64n) - 1n;
const MULTIPLIER = 0x2360ed051fc65da44385df649fccf645n;
const POOL = 4;

/** Words (n uint32) that SeedSequence makes of some uint32, as O'Neill's seed_seq_fe has it. */
function seedWords(entropy, n) {
  let constant = 0x43b0d7e5;
  const hashed = (value) => {
    let mixed = value ^ constant;
    constant = Math.imul(constant, 0x931e8875);
    mixed = Math.imul(mixed, constant);
    return mixed ^ (mixed >>> 16);
  };
  const mix = (x, y) => {
    const mixed = Math.imul(0xca01f9dd, x) - Math.imul(0x4973f715, y);
    return mixed ^ (mixed >>> 16);
  };
  const pool = Array.from({ length: POOL }, (_, i) => hashed(entropy[i] ?? 0));
  for (let from = 0; from < POOL; from++) {
    for (let to = 0; to < POOL; to++) if (to !== from) pool[to] = mix(pool[to], hashed(pool[from]));
  }
  for (const word of entropy.slice(POOL)) {
    for (let to = 0; to < POOL; to++) pool[to] = mix(pool[to], hashed(word));
  }
  constant = 0x8b51f9dd;
  return Array.from({ length: n }, (_, i) => {
    let word = pool[i % POOL] ^ constant;
    constant = Math.imul(constant, 0x58f38ded);
    word = Math.imul(word, constant);
    return BigInt((word ^ (word >>> 16)) >>> 0);
  });
}

/**
 * A ziggurat of 256 layers under a falling density f (Marsaglia and Tsang, 2000): where each layer
 * ends, x[1] to x[255] = r; x[0] is as wide as a box of the bottom layer's area would be.
 */
function ziggurat(r, area, f, inverse, bits) {
  const x = new Float64Array(256);
  x[255] = r;
  for (let i = 254; i > 0; i--) x[i] = inverse(area / x[i + 1] + f(x[i + 1]));
  x[0] = area / f(r);
  const unit = 2 ** bits;
  return {
    r,
    height: x.map((end, i) => (i ? f(end) : 1)),
    width: x.map((end) => end / unit),
    // Below it a draw lies under the density whatever its height.
    sure: x.map((end, i) => (i === 1 ? 0 : Math.floor((i ? x[i - 1] / end : r / end) * unit))),
  };
}

const NORMAL = ziggurat(
  3.654152885361009, 0.0049286732339746524, (x) => Math.exp(-0.5 * x * x),
  (y) => Math.sqrt(-2 * Math.log(y)), 52,
);
const EXPONENTIAL = ziggurat(
  7.69711747013105, 0.003949659822581557, (x) => Math.exp(-x), (y) => -Math.log(y), 53,
);

export class Generator {
  /** As `numpy.random.default_rng(seed)`; `seed`: a number below 2^32, or an array of them. */
  constructor(seed) {
    const w = seedWords([seed].flat(), 8);
    const word = (i) => (w[i + 1] << 96n) | (w[i] << 64n) | (w[i + 3] << 32n) | w[i + 2];
    this.increment = BigInt.asUintN(128, (word(4) << 1n) | 1n);
    this.state = 0n;
    this.half = null; // of a 64 bit draw, not yet used
    this.#step();
    this.state += word(0);
    this.#step();
  }

  #step() {
    this.state = BigInt.asUintN(128, this.state * MULTIPLIER + this.increment);
  }

  /** 64 bits, a BigInt. */
  bits64() {
    this.#step();
    const mixed = (this.state >> 64n) ^ (this.state & MASK64);
    const turn = this.state >> 122n;
    return ((mixed >> turn) | (mixed << (64n - turn))) & MASK64;
  }

  /** 32 bits; the other half of a draw waits for the next call. */
  bits32() {
    if (this.half !== null) {
      const kept = this.half;
      this.half = null;
      return kept;
    }
    const bits = this.bits64();
    this.half = Number(bits >> 32n);
    return Number(bits & 0xffffffffn);
  }

  /** In [0, 1), 53 bits. */
  random() {
    return Number(this.bits64() >> 11n) / 2 ** 53;
  }

  /** An integer from 0 to `most`, below 2^32 (Lemire, 2019). */
  upTo(most) {
    if (most === 0) return 0;
    const sides = BigInt(most) + 1n;
    let product = BigInt(this.bits32()) * sides;
    const least = ((1n << 32n) - sides) % sides;
    while ((product & 0xffffffffn) < least) product = BigInt(this.bits32()) * sides;
    return Number(product >> 32n);
  }

  /** An integer from 0 to `most` by rejection, as shuffling takes them. */
  below(most) {
    const mask = 2 ** (32 - Math.clz32(most)) - 1;
    for (;;) {
      const value = (this.bits32() & mask) >>> 0;
      if (value <= most) return value;
    }
  }

  normal() {
    const { r, height, width, sure } = NORMAL;
    for (;;) {
      const bits = this.bits64();
      const layer = Number(bits & 255n);
      const size = Number((bits >> 9n) & ((1n << 52n) - 1n));
      const x = ((bits >> 8n) & 1n ? -1 : 1) * size * width[layer];
      if (size < sure[layer]) return x;
      if (layer > 0) {
        const y = (height[layer - 1] - height[layer]) * this.random() + height[layer];
        if (y < Math.exp(-0.5 * x * x)) return x;
        continue;
      }
      for (;;) {
        const beyond = -Math.log1p(-this.random()) / r;
        const y = -Math.log1p(-this.random());
        if (2 * y > beyond * beyond) return (bits >> 17n) & 1n ? -(r + beyond) : r + beyond;
      }
    }
  }

  exponential() {
    const { r, height, width, sure } = EXPONENTIAL;
    for (;;) {
      const bits = this.bits64() >> 3n;
      const layer = Number(bits & 255n);
      const size = Number(bits >> 8n);
      const x = size * width[layer];
      if (size < sure[layer]) return x;
      if (layer === 0) return r - Math.log1p(-this.random());
      const y = (height[layer - 1] - height[layer]) * this.random() + height[layer];
      if (y < Math.exp(-x)) return x;
    }
  }

  randoms(n) {
    return Float64Array.from({ length: n }, () => this.random());
  }

  uniform(low, high, n) {
    return Float64Array.from({ length: n }, () => low + (high - low) * this.random());
  }

  /** Integers from `low` to below `high`. */
  integers(low, high, n) {
    return Int32Array.from({ length: n }, () => low + this.upTo(high - 1 - low));
  }

  /** In place. */
  shuffle(array) {
    for (let i = array.length - 1; i > 0; i--) {
      const j = this.below(i);
      [array[i], array[j]] = [array[j], array[i]];
    }
    return array;
  }

  permutation(n) {
    return this.shuffle(Int32Array.from({ length: n }, (_, i) => i));
  }

  /** `count` different integers below `n`, of at most 10000, in random order (Floyd's way). */
  choice(n, count) {
    const chosen = new Set();
    for (let j = n - count; j < n; j++) {
      const value = this.upTo(j);
      chosen.add(chosen.has(value) ? j : value);
    }
    const order = Int32Array.from(chosen);
    for (let i = count - 1; i > 0; i--) {
      const j = this.upTo(i);
      [order[i], order[j]] = [order[j], order[i]];
    }
    return order;
  }
}
