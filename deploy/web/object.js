/** A tuned object: `network.onnx`, and `object.json` that says how to read its answers. */

import { sha256 } from "./bundle.js";
import { FOUND_FROM } from "./predict.js";
import { unzipped, zipped } from "./zip.js";

const FORMAT = "qsgm-object";
const VERSIONS = [1, 2];
const LONGEST_NAME = 200;
const LARGEST_SCALE = 2;
const ADVICE = "choose the zip that this page saved, or object.json and network.onnx together";

/**
 * The files of an object.
 *
 * It has no views: what the object looks like, and the decision that weighs it, are made by Python
 * alone. `about`: `name`, `encoding`, `offset_rad`, `scale`, `made`.
 */
export async function objectFiles(about, network) {
  const description = {
    format: FORMAT, version: 2, sha256: await sha256(network), ...about, views: [], decision: null,
    threshold: { quality: FOUND_FROM, false_alarm_rate: null },
  };
  // Readers may tell 1 from 1.0, which JSON in JavaScript does not.
  const json = JSON.stringify(description, null, 1)
    .replace(/^( "(?:scale|offset_rad)": -?\d+)(?=,?$)/gm, "$1.0");
  return { "object.json": new TextEncoder().encode(`${json}\n`), "network.onnx": network };
}

/** An object's files in a folder of its name, as a zip (a Blob). */
export async function objectZip(about, network) {
  const files = await objectFiles(about, network);
  const folder = about.name.replaceAll(/[^\p{L}\p{N} ._-]/gu, "_").replace(/^\.+/, "_") || "object";
  return zipped(Object.fromEntries(Object.entries(files).map(([n, b]) => [`${folder}/${n}`, b])));
}

/** Read an object from files {name: bytes}: its own, or a zip of them. Everything is checked. */
export async function readObject(files) {
  const zip = Object.entries(files).find(([name]) => name.toLowerCase().endsWith(".zip"));
  if (zip) return readObject(await unzipped(zip[1]));
  const [description, network] = [files["object.json"], files["network.onnx"]];
  if (!description || !network) throw new Error(`This is no object: ${ADVICE}.`);
  let about;
  try {
    about = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(description));
  } catch {
    throw new Error(`object.json is damaged: ${ADVICE}.`);
  }
  const first = about?.version === VERSIONS[0];
  const scale = first ? 1 : about?.scale;
  const sane = about?.format === FORMAT && VERSIONS.includes(about.version) && !("task" in about)
    && typeof about.name === "string" && ["double", "paper"].includes(about.encoding)
    && Number.isFinite(about.offset_rad) && scale > 0 && scale <= LARGEST_SCALE;
  if (!sane) throw new Error(`object.json describes no object that this page can use: ${ADVICE}.`);
  if ((await sha256(network)) !== about.sha256) {
    throw new Error(`network.onnx is not the one that object.json means: ${ADVICE}.`);
  }
  const { encoding, offset_rad, made = {} } = about;
  const name = about.name.slice(0, LONGEST_NAME);
  return { about: { name, encoding, offset_rad, scale, made }, network, views: about.views?.length ?? 0 };
}
