/** One run as it goes on: curves, gradients in numbers, crops, and what it came to. */

import { drawChart } from "./charts.js";

const CROP_PX = 128;
const $ = (id) => document.getElementById(id);
export const percent = (share) => `${Math.round(100 * share)} %`;

export class Course {
  /** `layers`: those with an SGM behind them. */
  constructor(layers, epochs) {
    this.epochs = epochs;
    this.loss = [];
    this.wrong = [];
    this.turn = [];
    this.layers = layers.map((k) => ({ k, int8: [], float: [], last: null }));
  }

  /** Take in what the run tells. */
  hear({ kind, epoch = 0, loss, scores, layers }) {
    if (scores) {
      this.wrong.push([epoch, 1 - scores.detection]);
      this.turn.push([epoch, scores.angleDeg]);
    }
    if (kind === "epoch") this.loss.push([epoch, loss]);
    if (kind !== "probe") return;
    for (const layer of this.layers) {
      layer.last = layers[layer.k];
      layer.int8.push([epoch, layer.last.int8True]);
      layer.float.push([epoch, layer.last.floatTrue]);
    }
  }

  draw() {
    const chart = (id, curves, say, top, least = 0) => {
      const most = Math.max(top, ...curves.flatMap(({ points }) => points.map(([, v]) => v)));
      drawChart($(id), curves, { epochs: this.epochs, least, most, say });
    };
    chart("loss", [{ points: this.loss, color: 0 }], (v) => v.toFixed(2), 0.2);
    chart("wrong", [{ points: this.wrong, color: 1 }], percent, 0.2);
    chart("angle", [{ points: this.turn, color: 2 }], (v) => `${v.toFixed(1)}°`, 5);
    const curves = this.layers.flatMap(({ k, int8, float }, i) => [
      { name: `layer ${k}`, points: int8, color: i % 3 },
      { points: float, color: i % 3, dotted: true },
    ]);
    const lowest = Math.min(0.9, ...curves.flatMap(({ points }) => points.map(([, v]) => v)));
    chart("cosine", curves, (v) => v.toFixed(2), 1, Math.max(Math.floor(lowest * 10) / 10, -1));
    $("cosines").replaceChildren(...this.layers.map(({ k, last }) => {
      const row = document.createElement("tr");
      const head = document.createElement("th");
      head.scope = "row";
      head.textContent = `Layer ${k}`;
      row.append(head);
      for (const [key, digits] of [["int8Float", 5], ["int8True", 3], ["floatTrue", 3]]) {
        row.insertCell().textContent = last ? last[key].toFixed(digits) : "–";
      }
      return row;
    }));
  }
}

/** Put crops on the page; those that show the object are marked. */
export function addCrops(thumbnails) {
  for (const { pixels, object } of thumbnails) {
    const canvas = document.createElement("canvas");
    canvas.width = CROP_PX;
    canvas.height = CROP_PX;
    canvas.className = object ? "object" : "";
    canvas.getContext("2d").putImageData(new ImageData(pixels, CROP_PX), 0, 0);
    $("crops").append(canvas);
  }
}

/** What a run came to: a headline, and the figures behind it. */
export function verdictOn({ scores, untouched, strength, seconds }) {
  const told = scores.toldApart ?? 1;
  const total = Object.values(seconds).reduce((a, b) => a + b, 0);
  const figures = `${percent(scores.detection)} of held-out crops are right (${percent(untouched.detection)} before), `
    + `${percent(told)} of other things are refused, the turn is good to ${scores.angleDeg.toFixed(1)}°. `
    + `It took ${total.toFixed(1)} s.`;
  if (scores.detection < 0.9 || told < 0.75) {
    return ["It may be missed or confused: try a plainer table, or come closer.", figures];
  }
  if (strength < 0.5) return ["It will be found, but it looks round: its turn means nothing.", figures];
  return ["It will be found and told apart.", figures];
}
