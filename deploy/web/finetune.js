/** Fine-tuning with int8 SGMs: crops once, a step's graph in a loop, gradients looked at on the way. */

import { decoded, encoded, meanDirection, wrapped } from "./angles.js";
import { networkWith, openGraph, startWeights } from "./bundle.js";
import { CROP_PX, NOTHING, spritesOf, THING } from "./clutter.js";
import { CROPS, cutCrops, planCrops, TRAIN_CROPS } from "./crops.js";
import { compared, meanOver } from "./fidelity.js";
import { Generator } from "./rng.js";

const BATCH = 32;
const SLICE = 8; // crops that exist at once
const HEAD_SLICE = 40;
const PROBED = ["int8", "float", "true", "clipped"];
const f32 = Math.fround;

/**
 * Tune the bundle's network to an object.
 *
 * `frame`: a picture of four channels, BGR first, at the network's scale; `center`: [x, y] of the
 * object in it; `options`: `precision` of the SGMs ("int8", "float"), `epochs`, `seed`; `tell` gets
 * an object with a `kind` ("crops", "start", "probe", "epoch") whenever there is something new.
 */
export async function finetune(ort, bundle, frame, center, options, tell) {
  const lesson = await prepare(ort, bundle, frame, center, options.seed, tell);
  return tune(ort, bundle, lesson, options, tell);
}

/** One run on a lesson that was prepared. */
export async function tune(ort, bundle, lesson, { precision, epochs, seed }, tell) {
  const began = performance.now();
  const run = await Run.open(ort, bundle, lesson, precision, epochs, seed);
  const untouched = lesson.scores(lesson.outputs.slice(3 * TRAIN_CROPS));
  await tell({ kind: "start", scores: untouched });
  const losses = [];
  let scores = untouched;
  for (let epoch = 1; epoch <= epochs; epoch++) {
    losses.push(await run.epoch(tell));
    scores = await run.validate();
    await tell({ kind: "epoch", epoch, epochs, loss: losses.at(-1), scores });
  }
  const tuning = (performance.now() - began) / 1000 - run.looking;
  const weights = run.weights();
  await run.release();
  return {
    weights, losses, untouched, scores,
    network: networkWith(bundle, weights),
    orientation: lesson.orientation,
    fidelity: meanOver(run.probes),
    seconds: { ...lesson.seconds, tuning, probes: run.looking },
  };
}

/** Features of all crops, labels, and what the untouched network makes of them. */
export async function prepare(ort, bundle, frame, center, seed, tell) {
  const sprites = bundle.sheet ? spritesOf(bundle.sheet) : [];
  const plan = planCrops(frame, center, new Generator(seed), sprites.length);
  const trunk = await openGraph(ort, bundle, bundle.names.trunk);
  const seconds = { crops: 0, features: 0 };
  let features = null;
  let dims = null;
  for (let first = 0; first < CROPS; first += SLICE) {
    const cut = performance.now();
    const samples = new Uint8ClampedArray(SLICE * CROP_PX * CROP_PX * 3);
    cutCrops(frame, plan, sprites, first, first + SLICE, samples);
    const seen = performance.now();
    const input = new ort.Tensor("uint8", new Uint8Array(samples.buffer), [SLICE, CROP_PX, CROP_PX, 3]);
    const output = (await trunk.run({ samples: input })).features;
    features ??= new output.data.constructor((output.data.length / SLICE) * CROPS);
    dims = output.dims.slice(1);
    features.set(output.data, (output.data.length / SLICE) * first);
    seconds.crops += (seen - cut) / 1000;
    seconds.features += (performance.now() - seen) / 1000;
    await tell({ kind: "crops", done: first + SLICE, of: CROPS, samples, first, plan });
  }
  await trunk.release();
  return { ...(await lessonOf(ort, bundle, plan, { data: features, dims })), seconds };
}

/** Planned crops by their features: how the object lies, labels, scores. */
export async function lessonOf(ort, bundle, plan, { data, dims }) {
  const lesson = { plan, dims, features: data, type: data instanceof Uint8Array ? "uint8" : "float32" };
  const head = await openGraph(ort, bundle, bundle.names.head);
  lesson.outputs = await outputsOf(ort, head, lesson, startWeights(bundle), 0, CROPS);
  await head.release();
  return labelled(lesson, bundle.manifest.task.encoding);
}

/** Features of some crops as a tensor. */
function gathered(ort, lesson, rows) {
  const size = lesson.features.length / CROPS;
  const data = new lesson.features.constructor(size * rows.length);
  rows.forEach((row, i) => data.set(lesson.features.subarray(row * size, (row + 1) * size), i * size));
  return new ort.Tensor(lesson.type, data, [rows.length, ...lesson.dims]);
}

/** Activated outputs (N x 3) of the head for crops `first` to `last`. */
async function outputsOf(ort, head, lesson, weights, first, last) {
  const outputs = [];
  const feeds = tensorsOf(ort, weights);
  for (let at = first; at < last; at += HEAD_SLICE) {
    const rows = Array.from({ length: Math.min(HEAD_SLICE, last - at) }, (_, i) => at + i);
    feeds.features = gathered(ort, lesson, rows);
    outputs.push(...(await head.run(feeds)).outputs.data);
  }
  return outputs;
}

const tensorsOf = (ort, weights) => Object.fromEntries(
  Object.entries(weights).map(([name, { data, dims }]) => [name, new ort.Tensor("float32", data, dims)]),
);

/** The lesson with labels, shifted by how the object lies as the untouched network sees it. */
function labelled(lesson, encoding) {
  const { plan, outputs } = lesson;
  const angleOf = (values, row) =>
    decoded(values[3 * row + 1], values[3 * row + 2], encoding);
  const lying = [];
  for (let row = 0; row < TRAIN_CROPS; row++) {
    if (plan.quality[row]) lying.push(angleOf(outputs, row) - plan.turn[row]);
  }
  const orientation = meanDirection(lying);
  const shift = f32(orientation.angle);
  const labels = new Float32Array(3 * CROPS);
  for (let row = 0; row < CROPS; row++) {
    if (!plan.quality[row]) continue;
    labels.set([1, ...encoded(f32(plan.turn[row] + shift), encoding)], 3 * row);
  }
  const errorOf = (values, at, row) =>
    Math.abs(wrapped(angleOf(values, at) - plan.turn[row] - orientation.angle));
  const scores = (values) => scoresOf(values, plan, errorOf);
  return { ...lesson, labels, orientation, scores };
}

/** Detection, angle error [degrees] and share of other things refused on the held-out crops. */
function scoresOf(values, plan, errorOf) {
  let [right, positives, error, things, refused] = [0, 0, 0, 0, 0];
  const count = CROPS - TRAIN_CROPS;
  for (let at = 0; at < count; at++) {
    const row = TRAIN_CROPS + at;
    const found = values[3 * at] > 0.5;
    right += found === plan.quality[row] > 0;
    if (plan.quality[row]) {
      positives++;
      error += errorOf(values, at, row);
    } else if ((plan.clutter?.addition[row] ?? NOTHING) === THING) {
      things++;
      refused += !found;
    }
  }
  return {
    detection: right / count,
    angleDeg: ((error / positives) * 180) / Math.PI,
    toldApart: things ? refused / things : null,
  };
}

/** A training step's graph in a loop: state in, state out. */
class Run {
  static async open(ort, bundle, lesson, precision, epochs, seed) {
    const run = new Run();
    const { manifest, names, numbers, blocks } = bundle;
    const steps = epochs * Math.ceil(TRAIN_CROPS / BATCH);
    const { rates, optimizer, short_gains: gains } = manifest.recipes.sgm;
    const shortness = Math.log(500 / Math.max(steps, 1)) / Math.log(500 / 75);
    const gain = optimizer === "sgd"
      ? (gains[blocks] ?? 1) ** Math.min(1, Math.max(0, shortness)) : 1;
    Object.assign(run, { ort, lesson, numbers, steps, done: 0, probes: [], looking: 0 });
    run.rates = rates[optimizer][blocks].map((rate) => gain * rate);
    run.step = await openGraph(ort, bundle, names[precision]);
    run.head = await openGraph(ort, bundle, names.head);
    run.probe = bundle.files[names.probe] ? await openGraph(ort, bundle, names.probe) : null;
    run.order = new Generator([seed, 1]);
    run.looks = new Generator([seed, 2]);
    run.state = tensorsOf(ort, startWeights(bundle));
    for (const { name, shape } of run.step.inputMetadata) {
      if (!run.step.outputNames.includes(`${name}_next`) || name in run.state) continue;
      const size = shape.reduce((a, b) => a * b, 1);
      run.state[name] = new ort.Tensor("float32", new Float32Array(size), shape);
    }
    return run;
  }

  /** One pass over the crops in random order; its mean loss. */
  async epoch(tell) {
    const order = this.order.permutation(TRAIN_CROPS);
    let sum = 0;
    const batches = Math.ceil(TRAIN_CROPS / BATCH);
    for (let i = 0; i < batches; i++) {
      if (this.done % batches === 0) await this.#look(tell);
      sum += await this.#step(order.subarray(i * BATCH, (i + 1) * BATCH));
    }
    if (this.done === this.steps) await this.#look(tell);
    return sum / batches;
  }

  async #step(rows) {
    const feeds = { ...this.state, ...this.#batch(rows) };
    this.numbers.forEach((k, i) => {
      const rate = (1 - this.done / this.steps) * this.rates[i];
      feeds[`rate${k}`] = new this.ort.Tensor("float32", Float32Array.of(rate), []);
    });
    const got = await this.step.run(feeds);
    for (const name of Object.keys(this.state)) this.state[name] = got[`${name}_next`];
    this.done++;
    const loss = got.loss.data[0];
    if (!Number.isFinite(loss)) throw new Error("Tuning diverged: try another photograph.");
    return loss;
  }

  /** Compare gradients on a random batch. */
  async #look(tell) {
    if (!this.probe) return;
    const began = performance.now();
    const rows = this.looks.choice(TRAIN_CROPS, BATCH);
    const layers = this.numbers.slice(0, -1);
    const names = layers.flatMap((k) => PROBED.map((kind) => kind + k));
    const feeds = { ...tensorsOf(this.ort, this.weights()), ...this.#batch(rows) };
    const found = { step: this.done, layers: compared(await this.probe.run(feeds, names), layers) };
    this.probes.push(found);
    this.looking += (performance.now() - began) / 1000;
    await tell({ kind: "probe", epoch: this.probes.length - 1, ...found });
  }

  /** A batch by itself, in order: all samples' features would be copied at every run. */
  #batch(rows) {
    const labels = new Float32Array(3 * rows.length);
    rows.forEach((row, i) => labels.set(this.lesson.labels.subarray(3 * row, 3 * row + 3), 3 * i));
    const order = BigInt64Array.from({ length: rows.length }, (_, i) => BigInt(i));
    return {
      features: gathered(this.ort, this.lesson, rows),
      labels: new this.ort.Tensor("float32", labels, [rows.length, 3]),
      rows: new this.ort.Tensor("int64", order, [rows.length]),
    };
  }

  /** Weights and biases as they are now. */
  weights() {
    const names = this.numbers.flatMap((k) => [`weight${k}`, `bias${k}`]);
    return Object.fromEntries(names.map((name) => [name, this.state[name]]));
  }

  async validate() {
    const { ort, head, lesson } = this;
    return lesson.scores(await outputsOf(ort, head, lesson, this.weights(), TRAIN_CROPS, CROPS));
  }

  release() {
    return Promise.all([this.step, this.head, this.probe].map((session) => session?.release()));
  }
}
