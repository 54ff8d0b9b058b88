/** The page's worker: it holds the runtime, the bundle and the object, and answers one job at a time. */

import * as ort from "./ort/ort.js";
import { loadBundle, openSession, sha256 } from "./bundle.js";
import { finetune } from "./finetune.js";
import { objectZip, readObject } from "./object.js";
import { fromCanvas } from "./pixels.js";
import { locate } from "./predict.js";
import { movedPoint, scaled } from "./resize.js";

const RUNTIME = "ort/ort.wasm";
const LEAST_SPAN_PX = 45;
const LARGEST_SPAN_PX = 124;
const IDEAL_SPAN_PX = 90;
const LEAST_SIDE_PX = 256;
const THUMBNAILS = 24; // three of each of the first slices of 8 crops

let bundle = null;
let object = null; // about, network, session

/** Bytes of a file beside the page. */
async function read(name, tell) {
  const response = await fetch(new URL(name, import.meta.url));
  if (!response.ok) throw new Error(`${name} is missing: build the page again.`);
  const total = Number(response.headers.get("content-length"));
  const parts = [];
  let done = 0;
  for await (const part of chunks(response.body)) {
    parts.push(part);
    done += part.length;
    tell?.({ kind: "download", done, of: Math.max(total, done) });
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

async function* chunks(stream) {
  const reader = stream.getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    yield value;
  }
}

/** What a frame is scaled by so that its object fits the network's windows. */
function scaleFor(span, { width, height }) {
  if (span >= LEAST_SPAN_PX && span <= LARGEST_SPAN_PX) return 1;
  const ideal = Math.min(IDEAL_SPAN_PX / span, 2);
  const roomy = LEAST_SIDE_PX / Math.min(width, height);
  return ideal < roomy && span * roomy <= LARGEST_SPAN_PX ? roomy : ideal;
}

async function sumOf({ data }) {
  const pixels = data.filter((_, i) => (i & 3) !== 3);
  return sha256(pixels);
}

/** RGBA of a crop (BGR) for a canvas. */
function thumbnail(samples, at) {
  const size = 128 * 128;
  const pixels = new Uint8ClampedArray(4 * size);
  for (let i = 0, s = at * 3 * size; i < 4 * size; i += 4, s += 3) {
    pixels.set([samples[s + 2], samples[s + 1], samples[s], 255], i);
  }
  return pixels;
}

const jobs = {
  async load(_, tell) {
    ort.env.wasm.numThreads = 1;
    ort.env.wasm.wasmBinary = (await read(RUNTIME, tell)).buffer;
    bundle = await loadBundle((name) => read(`bundle/${name}`));
    await (await openSession(ort, bundle.files["network.onnx"])).release();
    return { layers: bundle.numbers };
  },

  async teach({ image, center, span, name, precision, epochs }, tell) {
    const frame = fromCanvas(image);
    const scale = scaleFor(span, frame);
    const seen = scaled(frame, scale);
    if (Math.min(seen.width, seen.height) < LEAST_SIDE_PX) {
      throw new Error("The object fills its picture: step back until it takes up a third of it.");
    }
    const watch = async ({ samples, plan, ...event }) => {
      if (event.kind === "crops" && event.first < (8 * THUMBNAILS) / 3) {
        event.thumbnails = [0, 1, 2].map((i) => ({
          pixels: thumbnail(samples, i), object: plan.quality[event.first + i] > 0,
        }));
      }
      tell(event);
    };
    const seed = 0;
    const result = await finetune(
      ort, bundle, seen, scale === 1 ? center : movedPoint(center, frame, seen),
      { precision, epochs, seed }, watch,
    );
    const about = {
      name, encoding: bundle.manifest.task.encoding, offset_rad: result.orientation.angle, scale,
      made: {
        by: "browser", onnxruntime: ort.env.versions.common, bundle_sha256: bundle.sha256, seed,
        frames_sha256: [await sumOf(frame)], others_sha256: [], frame_px: [image.width, image.height],
      },
    };
    await use(about, result.network);
    const { scores, untouched, orientation, fidelity, seconds } = result;
    return { about, scores, untouched, strength: orientation.strength, fidelity, seconds };
  },

  async open({ files }) {
    const { about, network, views } = await readObject(files);
    await use(about, network);
    return { about, views };
  },

  async save({ name }) {
    return { zip: await objectZip({ ...object.about, name }, object.network) };
  },

  /** A picture of another size than the one that was taught on is taken for the same view. */
  async find({ image }) {
    const began = performance.now();
    const taught = object.about.made?.frame_px;
    const larger = Array.isArray(taught)
      ? Math.max(...taught) / Math.max(image.width, image.height) : 1;
    const about = { ...object.about, scale: object.about.scale * (larger > 0 ? larger : 1) };
    const found = await locate(ort, object.session, about, fromCanvas(image));
    return { ...found, seconds: (performance.now() - began) / 1000 };
  },
};

async function use(about, network) {
  const session = await openSession(ort, network);
  const takes = session.inputNames.join() === "frame" && session.outputNames.join() === "heatmap";
  if (!takes) throw new Error("network.onnx is no network that finds an object.");
  await object?.session.release();
  object = { about, network, session };
}

let last = Promise.resolve();
addEventListener("message", ({ data: { id, job, input } }) => {
  last = last.then(async () => {
    try {
      postMessage({ id, done: await jobs[job](input, (event) => postMessage({ id, event })) });
    } catch (error) {
      postMessage({ id, error: error.message });
    }
  });
});
postMessage({});
