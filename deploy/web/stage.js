/** Pictures on the page: chosen, dropped, from the camera; with something drawn over them. */

const MOST_PX = 4096; // of a picture's side
const CAMERA = { facingMode: "environment", width: { ideal: 640 }, height: { ideal: 480 } };

async function decoded(blob) {
  const options = { colorSpaceConversion: "none", premultiplyAlpha: "none" };
  try {
    return await createImageBitmap(blob, options);
  } catch {
    throw new Error("This is no picture that the browser can read: choose a PNG or JPEG.");
  }
}

/** Pixels of a bitmap or of what a video shows. */
function pixelsOf(source) {
  const [wide, high] = [source.videoWidth ?? source.width, source.videoHeight ?? source.height];
  const scale = Math.min(1, MOST_PX / Math.max(wide, high));
  const canvas = document.createElement("canvas");
  canvas.width = Math.round(wide * scale);
  canvas.height = Math.round(high * scale);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(source, 0, 0, canvas.width, canvas.height);
  return context.getImageData(0, 0, canvas.width, canvas.height);
}

/** A place for a picture: its canvas, with something drawn over it. */
export class Stage {
  constructor(id, over) {
    this.root = document.getElementById(id);
    this.canvas = this.root.querySelector("canvas");
    this.video = this.root.querySelector("video");
    this.over = over;
    this.image = null;
  }

  show(image) {
    this.image = image;
    this.back = null;
    this.root.classList.add("full");
    this.draw();
  }

  draw() {
    const { canvas, image } = this;
    if (!this.back) {
      [canvas.width, canvas.height] = [image.width, image.height];
      this.back = document.createElement("canvas");
      [this.back.width, this.back.height] = [image.width, image.height];
      this.back.getContext("2d").putImageData(image, 0, 0);
    }
    const context = canvas.getContext("2d");
    context.drawImage(this.back, 0, 0);
    this.over(context, image.width / 460);
  }

  /** Start the camera, or stop it; while it runs `see` gets its pictures one after the other. */
  async film(button, see) {
    if (this.video.srcObject) return this.stop();
    const stream = await navigator.mediaDevices?.getUserMedia({ video: CAMERA }).catch(() => null);
    if (!stream) throw new Error("There is no camera that this page may use: choose a photograph.");
    this.video.srcObject = stream;
    await this.video.play();
    this.button = button;
    this.label = button.textContent;
    button.textContent = "Stop the camera";
    try {
      while (this.video.srcObject) {
        await see(pixelsOf(this.video));
        await new Promise(requestAnimationFrame);
      }
    } finally {
      this.stop();
    }
  }

  stop() {
    if (!this.video.srcObject) return;
    for (const track of this.video.srcObject.getTracks()) track.stop();
    this.video.srcObject = null;
    this.button.textContent = this.label;
  }

  /** Take pictures that are chosen or dropped; how others can be handed over is returned. */
  takes(input, doing, use) {
    const take = doing(async (blob) => {
      if (!blob) return;
      this.stop();
      await use(pixelsOf(await decoded(blob)));
    });
    input.addEventListener("change", () => take(input.files[0]).then(() => (input.value = "")));
    this.root.addEventListener("dragover", (event) => {
      event.preventDefault();
      this.root.classList.add("over");
    });
    this.root.addEventListener("dragleave", () => this.root.classList.remove("over"));
    this.root.addEventListener("drop", (event) => {
      event.preventDefault();
      this.root.classList.remove("over");
      if (!input.disabled) take(event.dataTransfer.files[0]);
    });
    return take;
  }
}

/** A line that can be seen on any ground. */
export function stroke(context, width, color, path) {
  for (const [w, style] of [[width + 2.5, "#0009"], [width, color]]) {
    context.lineWidth = w;
    context.strokeStyle = style;
    context.lineCap = "round";
    context.beginPath();
    path();
    context.stroke();
  }
}
