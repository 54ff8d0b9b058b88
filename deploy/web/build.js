/**
 * Collect the page, onnxruntime-web, a bundle and the example into a folder that any server can
 * serve: `node build.js [BUNDLE [DIST]]`, the bundle as `qsgm slim` wrote it.
 */

import { createHash } from "node:crypto";
import fs from "node:fs";
import path from "node:path";
import { fileURLToPath } from "node:url";

const here = path.dirname(fileURLToPath(import.meta.url));
const [bundle = path.join(here, "bundle"), dist = path.join(here, "dist")] = process.argv.slice(2);
const runtime = process.env.ONNXRUNTIME_WEB ?? path.join(here, "node_modules/onnxruntime-web");
const PAGE = [
  "index.html", "style.css", "icon.svg", "app.webmanifest", "page.js", "stage.js", "course.js",
  "charts.js", "worker.js",
  "angles.js", "bundle.js", "clutter.js", "crops.js", "fidelity.js",
  "finetune.js", "object.js", "pixels.js", "predict.js", "resize.js", "rng.js", "zip.js",
];
const calib = path.join(here, "../../calib");
const CITED = [
  [path.join(runtime, "dist/ort.wasm.bundle.min.mjs"), "ort/ort.js"],
  [path.join(runtime, "dist/ort-wasm-simd-threaded.wasm"), "ort/ort.wasm"],
  [path.join(calib, "demo_object.png"), "example/object.png"],
  [path.join(calib, "demo_scene.png"), "example/scene.png"],
];

for (const [needed, how] of [[runtime, "npm install"], [path.join(bundle, "manifest.json"), "qsgm slim -o bundle"]]) {
  if (fs.existsSync(needed)) continue;
  console.error(`${needed} is missing: run \`${how}\` in ${here} first`);
  process.exit(1);
}

/** A module without its comments, its indentation and empty lines. */
function stripped(text) {
  return text.replace(/^\s*\/\*\*[\s\S]*?\*\/\n/gm, "").replace(/^\s*\/\/.*\n/gm, "")
    .replace(/^[ \t]+/gm, "").replace(/\n{2,}/g, "\n");
}

const files = Object.fromEntries(PAGE.map((name) => {
  const text = fs.readFileSync(path.join(here, name), "utf-8");
  return [name, Buffer.from(name.endsWith(".js") ? stripped(text) : text)];
}));
for (const [from, name] of CITED) files[name] = fs.readFileSync(from);
for (const name of fs.readdirSync(bundle)) files[`bundle/${name}`] = fs.readFileSync(path.join(bundle, name));
const sum = createHash("sha256");
for (const name of Object.keys(files).sort()) sum.update(name).update(files[name]);
const version = sum.digest("hex").slice(0, 16);
const list = JSON.stringify(["./", ...Object.keys(files).filter((name) => name !== "index.html")]);
const worker = stripped(fs.readFileSync(path.join(here, "sw.js"), "utf-8"));
files["sw.js"] = Buffer.from(`const VERSION = "${version}";\nconst FILES = ${list};\n${worker}`);

fs.rmSync(dist, { recursive: true, force: true });
for (const [name, bytes] of Object.entries(files)) {
  const to = path.join(dist, name);
  fs.mkdirSync(path.dirname(to), { recursive: true });
  fs.writeFileSync(to, bytes);
}
const bytes = (names) => names.reduce((total, name) => total + files[name].length, 0);
const own = [...PAGE, "sw.js"];
console.log(JSON.stringify({
  dist, version, own: bytes(own), modules: bytes(own.filter((name) => name.endsWith(".js"))),
  runtime: bytes(["ort/ort.js", "ort/ort.wasm"]),
  bundle: bytes(Object.keys(files).filter((name) => name.startsWith("bundle/"))),
}));
