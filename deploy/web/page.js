/** What one sees and does; all work is the worker's. */

import { addCrops, Course, percent, verdictOn } from "./course.js";
import { Stage, stroke } from "./stage.js";

const EPOCHS = 10;
const PATIENCE_MS = 3000;
const $ = (id) => document.getElementById(id);

// ---- the worker

/**
 * Once the service worker has fetched everything it answers for the server: nothing is fetched twice.
 *
 * Where there is none, or the page was loaded past it, the server goes on answering.
 */
async function kept() {
  const workers = navigator.serviceWorker;
  const registered = await workers?.register("sw.js").catch(() => null);
  if (!registered) return;
  await workers.ready;
  if (workers.controller) return;
  await new Promise((ready) => {
    workers.addEventListener("controllerchange", ready, { once: true });
    setTimeout(ready, PATIENCE_MS);
  });
}

const waiting = new Map();
let asked = 0;
const started = kept().then(() => new Promise((ready, failed) => {
  // From a blob it obeys this page's Content-Security-Policy; from a file it would have its own.
  const source = `import ${JSON.stringify(new URL("worker.js", import.meta.url).href)};`;
  const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
  const worker = new Worker(url, { type: "module" });
  worker.addEventListener("error", () => failed(new Error("This browser runs no module workers.")));
  worker.addEventListener("message", ({ data: { id, event, done, error } }) => {
    // Until its modules are there, what is sent to it would be lost: then it says so, without an id.
    if (id === undefined) return ready(worker);
    if (event) return waiting.get(id).hear?.(event);
    const { give, fail } = waiting.get(id);
    waiting.delete(id);
    if (error === undefined) give(done);
    else fail(new Error(error));
  });
}));

async function ask(job, input, hear) {
  const worker = await started;
  const id = ++asked;
  return new Promise((give, fail) => {
    waiting.set(id, { give, fail, hear });
    worker.postMessage({ id, job, input });
  });
}

function say(text, bad = false) {
  if ($("status").textContent === text) return; // else it would be read out again
  $("status").textContent = text;
  $("status").className = bad ? "bad" : "";
}

/** Run what a button does; what goes wrong is said. */
function doing(action) {
  return async (...given) => {
    try {
      await action(...given);
    } catch (error) {
      say(error.message, true);
    }
  };
}

// ---- show it

const ring = { x: 0, y: 0, span: 0 };
const taught = new Stage("taught", (context, unit) => {
  const radius = ring.span / 2;
  stroke(context, 2.5 * unit, "#ffc145", () => {
    context.arc(ring.x, ring.y, radius, 0, 7);
    for (const way of [-1, 1]) {
      context.moveTo(ring.x + way * radius, ring.y);
      context.lineTo(ring.x + 1.6 * way * radius, ring.y);
    }
  });
});

function place(x, y) {
  const { width, height } = taught.image;
  ring.x = Math.min(Math.max(x, 0), width);
  ring.y = Math.min(Math.max(y, 0), height);
  ring.span = $("size").value * Math.min(width, height);
  $("px").textContent = `${Math.round(ring.span)} px`;
  taught.draw();
}

function shown(image) {
  taught.image = image;
  taught.back = null;
  taught.root.classList.add("full");
  $("size").disabled = false;
  $("teach").disabled = !ready || busy;
  place(image.width / 2, image.height / 2);
}

const takeTaught = taught.takes($("choose"), doing, async (image) => {
  shown(image);
  say("Put the ring around the object, then teach it.");
});
$("example").addEventListener("click", () => takeTaught(examples[0]));
$("camera").addEventListener("click", doing(() => taught.film($("camera"), async (image) => {
  const kept = { ...ring };
  const first = taught.image?.width !== image.width;
  shown(image);
  if (!first) place(kept.x, kept.y);
  say("Put the object into the ring; Teach takes the picture.");
})));
$("size").addEventListener("input", () => place(ring.x, ring.y));
const photo = taught.canvas;
photo.addEventListener("pointerdown", (event) => photo.setPointerCapture(event.pointerId));
photo.addEventListener("pointermove", (event) => {
  if (!event.buttons) return;
  const scale = photo.width / photo.clientWidth;
  place(event.offsetX * scale, event.offsetY * scale);
});
photo.addEventListener("click", (event) => {
  const scale = photo.width / photo.clientWidth;
  place(event.offsetX * scale, event.offsetY * scale);
});
photo.addEventListener("keydown", (event) => {
  const step = photo.width / (event.shiftKey ? 320 : 64);
  const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  const grow = { "+": 1, "-": -1 }[event.key];
  if (!way && !grow) return;
  event.preventDefault();
  if (grow) $("size").value = Number($("size").value) + 0.02 * grow;
  place(ring.x + step * (way?.[0] ?? 0), ring.y + step * (way?.[1] ?? 0));
});

// ---- watch it learn

let ready = false;
let busy = false;
let object = null;
let examples = [];

function useable() {
  $("teach").disabled = !ready || busy || !taught.image;
  for (const id of ["look", "live", "again", "save"]) $(id).disabled = !object || busy;
  $("example").disabled = !ready;
  $("open").disabled = !ready || busy;
}

let layers = [];
let course = new Course([], EPOCHS);
addEventListener("resize", () => course.draw());
$("teach").addEventListener("click", doing(async () => {
  taught.stop();
  [busy, object] = [true, null];
  useable();
  $("crops").replaceChildren();
  $("verdict").replaceChildren();
  say("Cutting crops.");
  course = new Course(layers.slice(0, -1), EPOCHS);
  let drawn = true;
  const draw = () => {
    if (drawn) requestAnimationFrame(() => (course.draw(), drawn = true));
    drawn = false;
  };
  try {
    const { image } = taught;
    const input = {
      image: { width: image.width, height: image.height, data: image.data },
      center: [ring.x, ring.y], span: ring.span, name: $("name").value.trim() || "object",
      precision: "int8", epochs: EPOCHS,
    };
    object = await ask("teach", input, (event) => {
      course.hear(event);
      if (event.thumbnails) addCrops(event.thumbnails);
      if (event.kind === "crops") $("progress").value = (0.4 * event.done) / event.of;
      if (event.kind === "epoch") {
        $("progress").value = 0.4 + (0.6 * event.epoch) / event.epochs;
        say(`Epoch ${event.epoch} of ${event.epochs}.`);
      }
      if (event.kind !== "crops") draw();
    });
    const [headline, figures] = verdictOn(object);
    $("verdict").append(Object.assign(document.createElement("strong"), { textContent: headline }), ` ${figures}`);
    say(`“${object.about.name}” is taught. Find it in a second photograph.`);
  } finally {
    busy = false;
    useable();
  }
}));

// ---- find it

let last = null;
const scene = new Stage("scene", (context, unit) => {
  if (!last?.found) return;
  const [[x, y], radius] = [last.center, 24 * unit];
  const turn = (-last.turnDeg * Math.PI) / 180;
  context.setLineDash([unit, 8 * unit]);
  stroke(context, 2.5 * unit, "#fff", () => {
    context.moveTo(context.canvas.width / 2, context.canvas.height / 2);
    context.lineTo(x, y);
  });
  context.setLineDash([]);
  stroke(context, 3 * unit, "#ffc145", () => {
    context.arc(x, y, radius, 0, 7);
    for (const way of [-radius, radius]) {
      context.moveTo(x + way * Math.cos(turn), y + way * Math.sin(turn));
      context.lineTo(x + 2 * way * Math.cos(turn), y + 2 * way * Math.sin(turn));
    }
  });
});

function answer(found) {
  last = found;
  const [right, down] = found.move.map(Math.round);
  const texts = {
    found: `${found.found ? "found" : "not found"}\nquality ${found.quality.toFixed(2)}`,
    move: `${Math.abs(right)} px ${right < 0 ? "left" : "right"}\n${Math.abs(down)} px ${down < 0 ? "up" : "down"}`,
    turn: `${Math.abs(found.turnDeg).toFixed(1)}°\n${found.turnDeg < 0 ? "clockwise" : "counter-clockwise"}`,
  };
  for (const [id, text] of Object.entries(texts)) {
    $(id).textContent = found.found || id === "found" ? text : "–";
  }
}

async function find(image) {
  const { width, height, data } = image;
  answer(await ask("find", { image: { width, height, data } }));
  scene.show(image);
}

const takeScene = scene.takes($("look"), doing, async (image) => {
  await find(image);
  say(last.found ? `Found in ${last.seconds.toFixed(2)} s.` : "It is not there, or hidden, or too far away.");
});
$("again").addEventListener("click", () => takeScene(examples[1]));
$("live").addEventListener("click", doing(async () => {
  $("answer").ariaLive = "off"; // many a second are too many to be read out
  try {
    await scene.film($("live"), async (image) => {
      await find(image);
      say("Live.");
    });
  } finally {
    $("answer").ariaLive = "polite";
  }
}));

// ---- keep it

$("save").addEventListener("click", doing(async () => {
  const { zip } = await ask("save", { name: $("name").value.trim() || object.about.name });
  const link = document.createElement("a");
  link.href = URL.createObjectURL(zip);
  link.download = "object.zip";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  say(`Saved: ${link.download}.`);
}));
$("open").addEventListener("change", doing(async () => {
  const files = {};
  for (const file of $("open").files) files[file.name] = new Uint8Array(await file.arrayBuffer());
  $("open").value = "";
  object = await ask("open", { files });
  $("name").value = object.about.name;
  useable();
  const patch = object.views ? " Its patch is left aside: the network alone answers here." : "";
  say(`“${object.about.name}” is open.${patch}`);
}));

// ---- loading

doing(async () => {
  course.draw();
  if (!isSecureContext) {
    throw new Error("Open this page over https: without, browsers withhold checksums and the camera.");
  }
  say("Loading 15 MB, once.");
  ({ layers } = await ask("load", null, ({ done, of }) => {
    $("loading").value = done / of;
  }));
  const names = ["example/object.png", "example/scene.png"];
  examples = await Promise.all(names.map((name) => fetch(name).then((file) => file.blob())));
  ready = true;
  $("loading").hidden = true;
  useable();
  say("Ready. From here on nothing is loaded.");
  document.body.dataset.ready = "";
})();
