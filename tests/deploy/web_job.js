/**
 * What deploy/web makes of files, for tests to compare: `node web_job.js JOB.json`.
 *
 * The job names the folder of the page's modules and what is to be done; a frame is {file, width,
 * height} of raw BGRA bytes. Answers and files are written to its folder `out`.
 */

import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";

const job = JSON.parse(fs.readFileSync(process.argv[2], "utf-8"));
const load = (name) => import(pathToFileURL(path.join(job.web, name)));
const ort = job.ort ? await import(pathToFileURL(job.ort)) : null;
if (ort) ort.env.wasm.numThreads = 1;

const { Generator } = await load("rng.js");
const { loadBundle, openSession } = await load("bundle.js");
const { CROPS, cutCrops, planCrops } = await load("crops.js");
const { spritesOf } = await load("clutter.js");
const { lessonOf, prepare, tune } = await load("finetune.js");
const { objectZip, readObject } = await load("object.js");
const { locate } = await load("predict.js");
const { scaled } = await load("resize.js");
const { picture } = await load("pixels.js");

const bytesOf = (file) => new Uint8Array(fs.readFileSync(file));
const frameOf = ({ file, width, height }) =>
  picture(width, height, 4, new Uint8ClampedArray(bytesOf(file).buffer));
const out = (name) => path.join(job.out, name);
const plain = (_, value) => (ArrayBuffer.isView(value) ? [...value] : value);
const bundle = job.bundle
  ? await loadBundle(async (name) => bytesOf(path.join(job.bundle, name)), job.layers) : null;
const answers = {};
let object = null;

function planned(seed) {
  const sprites = bundle.sheet ? spritesOf(bundle.sheet) : [];
  const plan = planCrops(frameOf(job.frame), job.center, new Generator(seed), sprites.length);
  return { sprites, plan };
}

function draws({ seed, count }) {
  const rng = new Generator(seed);
  const many = (draw) => Array.from({ length: count }, draw);
  return {
    random: rng.randoms(9),
    integers: rng.integers(0, 65, 101),
    permutation: rng.permutation(1000),
    choice: rng.choice(800, 32),
    uniform: rng.uniform(-3, 5, 7),
    normal: many(() => rng.normal()),
    exponential: many(() => rng.exponential()),
  };
}

async function tuned({ seed, precision, epochs, features }) {
  const told = [];
  const tell = async ({ samples, plan, ...event }) => void told.push(event);
  const began = process.cpuUsage();
  const lesson = features
    ? await lessonOf(ort, bundle, planned(seed).plan, { data: bytesOf(features.file), dims: features.dims })
    : await prepare(ort, bundle, frameOf(job.frame), job.center, seed, tell);
  const result = await tune(ort, bundle, lesson, { seed, precision, epochs }, tell);
  const { user, system } = process.cpuUsage(began);
  fs.writeFileSync(out("features.bin"), lesson.features);
  fs.writeFileSync(out("network.onnx"), result.network);
  const about = { name: job.name ?? "object", encoding: "double", offset_rad: result.orientation.angle,
    scale: 1, made: { seed } };
  object = { about, network: result.network };
  const weights = Object.entries(result.weights).map(([name, { data }]) => [name, data]);
  return {
    ...result, network: undefined, weights: Object.fromEntries(weights), labels: lesson.labels,
    told: told.filter(({ kind }) => kind !== "crops"), cpu: (user + system) / 1e6,
  };
}

if (job.draws) answers.draws = draws(job.draws);
if (job.scale) fs.writeFileSync(out("scaled.bin"), scaled(frameOf(job.frame), job.scale).data);
if (job.plan) {
  const { sprites, plan } = planned(job.plan.seed);
  const crops = new Uint8ClampedArray(CROPS * 128 * 128 * 3);
  cutCrops(frameOf(job.frame), plan, sprites, 0, CROPS, crops);
  fs.writeFileSync(out("crops.bin"), crops);
  answers.plan = plan;
}
if (job.tune) answers.tuned = await tuned(job.tune);
if (job.open) {
  const files = job.open.map((file) => [path.basename(file), bytesOf(file)]);
  try {
    object = await readObject(Object.fromEntries(files));
    answers.opened = { about: object.about, views: object.views };
  } catch ({ message }) {
    answers.refused = message;
  }
}
if (job.save) {
  const zip = await objectZip(object.about, object.network);
  fs.writeFileSync(out("object.zip"), new Uint8Array(await zip.arrayBuffer()));
}
if (job.scenes) {
  const session = await openSession(ort, object.network);
  answers.found = [];
  for (const scene of job.scenes) {
    answers.found.push(await locate(ort, session, object.about, frameOf(scene)));
  }
}
fs.writeFileSync(out("answers.json"), JSON.stringify(answers, plain));
