/**
 * What deploy/web makes of files, for tests to compare: `node web_job.js JOB.json`.
 *
 * The job names the folder of the page's modules, onnxruntime-web's module, a bundle, raw frames
 * (BGRA bytes), settings, and where crops, plan, answers and the tuned network are written.
 */

import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";

const job = JSON.parse(fs.readFileSync(process.argv[2], "utf-8"));
const load = (name) => import(pathToFileURL(path.join(job.web, name)));
const ort = await import(pathToFileURL(job.ort));
ort.env.wasm.numThreads = 1;

const { Generator } = await load("rng.js");
const { loadBundle, openSession } = await load("bundle.js");
const { CROPS, cutCrops, planCrops } = await load("crops.js");
const { spritesOf } = await load("clutter.js");
const { prepare, tune } = await load("finetune.js");
const { locate } = await load("predict.js");
const { scaled } = await load("resize.js");
const { picture } = await load("pixels.js");

const read = async (name) => new Uint8Array(fs.readFileSync(path.join(job.bundle, name)));
const frameOf = ({ file, width, height }) =>
  picture(width, height, 4, new Uint8ClampedArray(fs.readFileSync(file)));
const out = (name) => path.join(job.out, name);
const plain = (_, value) => (ArrayBuffer.isView(value) ? [...value] : value);
const answers = {};

if (job.draws) {
  const rng = new Generator(job.draws.seed);
  const many = (n, draw) => Array.from({ length: n }, draw);
  answers.draws = {
    random: rng.randoms(9),
    integers: rng.integers(0, 65, 101),
    permutation: rng.permutation(1000),
    choice: rng.choice(800, 32),
    uniform: rng.uniform(-3, 5, 7),
    normal: many(job.draws.count, () => rng.normal()),
    exponential: many(job.draws.count, () => rng.exponential()),
  };
}
if (job.scale) fs.writeFileSync(out("scaled.bin"), scaled(frameOf(job.frame), job.scale).data);
if (job.plan) {
  const { sheet } = await loadBundle(read, job.layers);
  const sprites = sheet ? spritesOf(sheet) : [];
  const frame = frameOf(job.frame);
  answers.plan = planCrops(frame, job.center, new Generator(job.seed), sprites.length);
  const crops = new Uint8ClampedArray(CROPS * 128 * 128 * 3);
  cutCrops(frame, answers.plan, sprites, 0, CROPS, crops);
  fs.writeFileSync(out("crops.bin"), crops);
}
let network = job.network ? new Uint8Array(fs.readFileSync(job.network)) : null;
let about = job.about;
if (job.tune) {
  const bundle = await loadBundle(read, job.layers);
  const told = [];
  const tell = async ({ samples, plan, ...event }) => void told.push(event);
  const began = process.cpuUsage();
  const lesson = await prepare(ort, bundle, frameOf(job.frame), job.center, job.tune.seed, tell);
  if (job.given) {
    lesson.features = new Uint8Array(fs.readFileSync(job.given.features));
    lesson.labels = new Float32Array(fs.readFileSync(job.given.labels).slice().buffer);
  }
  const result = await tune(ort, bundle, lesson, job.tune, tell);
  const { user, system } = process.cpuUsage(began);
  network = result.network;
  about = { encoding: "double", offset_rad: result.orientation.angle, scale: 1 };
  fs.writeFileSync(out("network.onnx"), network);
  answers.told = told.filter(({ kind }) => kind !== "crops");
  fs.writeFileSync(out("features.bin"), lesson.features);
  answers.result = { ...result, network: undefined, cpu: (user + system) / 1e6 };
}
if (job.scenes) {
  const session = await openSession(ort, network);
  answers.found = [];
  for (const scene of job.scenes) answers.found.push(await locate(ort, session, about, frameOf(scene)));
}
fs.writeFileSync(out("answers.json"), JSON.stringify(answers, plain));
