/** Zip files: written without compression, read with deflate as well. */

const LOCAL = 0x04034b50;
const CENTRAL = 0x02014b50;
const END = 0x06054b50;
const UTF8 = 0x0800;
const JAN_1_1980 = 0x21; // the first day that the format knows: files say when they were saved
const MOST_BYTES = 64_000_000;

const CRC_TABLE = Int32Array.from({ length: 256 }, (_, byte) => {
  for (let bit = 0; bit < 8; bit++) byte = byte & 1 ? (byte >>> 1) ^ 0xedb88320 : byte >>> 1;
  return byte;
});

function crc32(bytes) {
  let sum = -1;
  for (const byte of bytes) sum = CRC_TABLE[(sum ^ byte) & 255] ^ (sum >>> 8);
  return ~sum >>> 0;
}

/** Little-endian numbers as bytes: pairs of a size (2 or 4) and a value. */
function packed(...fields) {
  const bytes = [];
  for (const [size, value] of fields) {
    for (let i = 0; i < size; i++) bytes.push(Math.floor(value / 256 ** i) & 255);
  }
  return bytes;
}

/** A zip file (a Blob) of files {name: bytes}. */
export function zipped(files) {
  const parts = [];
  const directory = [];
  let offset = 0;
  for (const [name, bytes] of Object.entries(files)) {
    const text = new TextEncoder().encode(name);
    const about = packed([2, 20], [2, UTF8], [2, 0], [2, 0], [2, JAN_1_1980], [4, crc32(bytes)],
      [4, bytes.length], [4, bytes.length], [2, text.length], [2, 0]);
    const head = Uint8Array.from([...packed([4, LOCAL]), ...about, ...text]);
    directory.push(...packed([4, CENTRAL], [2, 20]), ...about,
      ...packed([2, 0], [2, 0], [2, 0], [4, 0], [4, offset]), ...text);
    parts.push(head, bytes);
    offset += head.length + bytes.length;
  }
  const count = Object.keys(files).length;
  const end = packed([4, END], [2, 0], [2, 0], [2, count], [2, count], [4, directory.length],
    [4, offset], [2, 0]);
  parts.push(Uint8Array.from([...directory, ...end]));
  return new Blob(parts, { type: "application/zip" });
}

/** The files of a zip: {name: bytes}, without the folders they lie in. */
export async function unzipped(zip) {
  const view = new DataView(zip.buffer, zip.byteOffset, zip.byteLength);
  let end = zip.length - 22;
  while (end >= 0 && view.getUint32(end, true) !== END) end--;
  if (end < 0) throw new Error("This is no zip file.");
  const files = {};
  let [at, room] = [view.getUint32(end + 16, true), MOST_BYTES];
  for (let left = view.getUint16(end + 10, true); left > 0; left--) {
    if (view.getUint32(at, true) !== CENTRAL) throw new Error("The zip file is damaged.");
    const [method, size, full] = [view.getUint16(at + 10, true), view.getUint32(at + 20, true),
      view.getUint32(at + 24, true)];
    const lengths = [28, 30, 32].map((field) => view.getUint16(at + field, true));
    const start = view.getUint32(at + 42, true);
    const name = new TextDecoder().decode(zip.subarray(at + 46, at + 46 + lengths[0]));
    const data = start + 30 + view.getUint16(start + 26, true) + view.getUint16(start + 28, true);
    room -= full;
    if (room < 0) throw tooMuch();
    const bytes = zip.subarray(data, data + size);
    if (!name.endsWith("/")) files[name.split("/").pop()] = method ? await inflated(bytes, full) : bytes;
    at += 46 + lengths[0] + lengths[1] + lengths[2];
  }
  return files;
}

/** What was packed, if it is as large as it was said to be. */
async function inflated(bytes, size) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  const whole = new Uint8Array(size);
  let done = 0;
  for (const reader = stream.getReader(); ;) {
    const { value } = await reader.read();
    if (!value) break;
    if (done + value.length > size) throw tooMuch();
    whole.set(value, done);
    done += value.length;
  }
  if (done < size) throw new Error("The zip file is damaged.");
  return whole;
}

const tooMuch = () => new Error("The zip file holds more than an object.");
