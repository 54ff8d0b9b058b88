/** A bundle of graphs as docs/bundle.md describes it, every file checked before it is used. */

const VERSION = 5;
const DISTRACTORS = "distractors.png";
const SHARED = ["weights.bin", "network.onnx"]; // constants that graphs refer to

/** Hexadecimal SHA-256 of some bytes. */
export async function sha256(bytes) {
  const digest = await crypto.subtle.digest("SHA-256", bytes);
  return [...new Uint8Array(digest)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

/**
 * Read a bundle.
 *
 * `read` gives the bytes of a file by its name; `layers`: how many of the last ones are tuned, null
 * for as many as the bundle has.
 */
export async function loadBundle(read, layers = null) {
  const bytes = await read("manifest.json");
  const manifest = JSON.parse(new TextDecoder().decode(bytes));
  if (manifest.format !== "qsgm-bundle" || manifest.version !== VERSION) {
    throw new Error(`This is no bundle of version ${VERSION}: write it with "qsgm slim".`);
  }
  if (manifest.task.name !== "grasp") throw new Error("The bundle's network grasps nothing.");
  const tuned = layers ?? Math.min(manifest.most_layers, 3);
  const last = manifest.network.layers.length;
  const numbers = Array.from({ length: tuned }, (_, i) => last - tuned + 1 + i);
  const blocks = numbers.join(",");
  if (!manifest.blocks.includes(blocks)) throw new Error(`The bundle cannot tune layers ${blocks}.`);
  const names = {
    trunk: `trunk_${manifest.trunk}_${tuned}.onnx`,
    head: `head_${tuned}.onnx`,
    probe: `probe_${tuned}.onnx`,
    float: `step_float_${manifest.recipes.sgm.optimizer}_${blocks}.onnx`,
    int8: `step_int8_${manifest.recipes.sgm.optimizer}_${blocks}.onnx`,
  };
  const wanted = [...SHARED, ...Object.values(names), DISTRACTORS];
  const files = {};
  await Promise.all(wanted.filter((name) => name in manifest.files).map(async (name) => {
    files[name] = await read(name);
    if ((await sha256(files[name])) !== manifest.files[name].sha256) {
      throw new Error(`${name} is not the file that the bundle means.`);
    }
  }));
  const sheet = files[DISTRACTORS] ? await sheetOf(files[DISTRACTORS]) : null;
  return { manifest, files, names, numbers, blocks, sheet, sha256: await sha256(bytes) };
}

/** A session of one of the bundle's graphs. */
export function openGraph(ort, bundle, name) {
  if (!bundle.files[name]) throw new Error(`The bundle was made without ${name}.`);
  const externalData = SHARED.map((path) => ({ path, data: bundle.files[path] }));
  return openSession(ort, bundle.files[name], externalData);
}

/** A session on one thread, in WebAssembly. */
export function openSession(ort, bytes, externalData = []) {
  const options = { executionProviders: ["wasm"], externalData, logSeverityLevel: 3 };
  return ort.InferenceSession.create(bytes, options);
}

const transposed = (values, rows, [height, width], into, backwards) => {
  const out = new Float32Array(values.length);
  const places = height * width;
  for (let row = 0; row < rows; row++) {
    for (let at = 0; at < places; at++) {
      for (let channel = 0; channel < into; channel++) {
        const step = (row * places + at) * into + channel;
        const conv = (row * into + channel) * places + at;
        if (backwards) out[conv] = values[step];
        else out[step] = values[conv];
      }
    }
  }
  return out;
};

/** Weights and biases of the tuned layers as they ship, in the steps' layout, by name. */
export function startWeights({ manifest, files, numbers }) {
  const weights = {};
  for (const k of numbers) {
    const { into, out, kernel } = manifest.network.layers[k - 1];
    const numbersAt = (name) => {
      const { offset, shape } = manifest.initializers[name];
      const count = shape.reduce((a, b) => a * b, 1);
      return new Float32Array(files["network.onnx"].slice(offset, offset + 4 * count).buffer);
    };
    const data = transposed(numbersAt(`weight${k}`), out, kernel, into, false);
    weights[`weight${k}`] = { data, dims: [out, data.length / out] };
    weights[`bias${k}`] = { data: numbersAt(`bias${k}`), dims: [out] };
  }
  return weights;
}

/** The whole network as an ONNX file with these weights in the place of its own. */
export function networkWith({ manifest, files, numbers }, weights) {
  const network = files["network.onnx"].slice();
  for (const k of numbers) {
    const { into, out, kernel } = manifest.network.layers[k - 1];
    const weight = transposed(weights[`weight${k}`].data, out, kernel, into, true);
    for (const [name, values] of [[`weight${k}`, weight], [`bias${k}`, weights[`bias${k}`].data]]) {
      network.set(new Uint8Array(values.slice().buffer), manifest.initializers[name].offset);
    }
  }
  return network;
}

/** The sheet of drawn things: an 8-bit RGBA PNG whose rows have no filter. */
async function sheetOf(png) {
  const view = new DataView(png.buffer, png.byteOffset, png.byteLength);
  const width = view.getUint32(16);
  const height = view.getUint32(20);
  const parts = [];
  for (let at = 8; at + 12 <= png.length; at += 12 + view.getUint32(at)) {
    const kind = String.fromCharCode(...png.subarray(at + 4, at + 8));
    if (kind === "IDAT") parts.push(png.subarray(at + 8, at + 8 + view.getUint32(at)));
  }
  const inflated = new Blob(parts).stream().pipeThrough(new DecompressionStream("deflate"));
  const rows = new Uint8Array(await new Response(inflated).arrayBuffer());
  const data = new Uint8Array(width * height * 4);
  for (let y = 0; y < height; y++) {
    const start = y * (1 + 4 * width) + 1;
    data.set(rows.subarray(start, start + 4 * width), y * 4 * width);
  }
  return { width, height, data };
}
