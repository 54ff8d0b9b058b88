/** Line charts as SVG: a few curves over epochs, named at their ends. */

const WIDTH = 300;
const [LEFT, RIGHT, TOP, BOTTOM] = [30, 58, 8, 20];

function shape(kind, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

/**
 * Draw curves: {name, points: [[epoch, value]...], dashed}; `most` is where the axis ends.
 *
 * `say` puts a value into words: labels of the axis, and what a screen reader is told.
 */
export function drawChart(svg, curves, { epochs, most, say, width = WIDTH, height = 150 }) {
  const x = (epoch) => LEFT + (epoch / epochs) * (width - LEFT - RIGHT);
  const y = (value) => TOP + (1 - Math.min(Math.max(value / most, 0), 1)) * (height - TOP - BOTTOM);
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.replaceChildren();
  for (const value of [0, most / 2, most]) {
    svg.append(shape("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }));
    svg.append(shape("text", { x: LEFT - 5, y: y(value) + 4, "text-anchor": "end" }, say(value)));
  }
  for (const epoch of [0, epochs]) {
    svg.append(shape("text", { x: x(epoch), y: height - 4, "text-anchor": "middle" }, epoch));
  }
  svg.append(shape("text", { x: x(epochs / 2), y: height - 4, "text-anchor": "middle" }, "epochs"));
  const ends = [];
  for (const { name, points, color, dashed } of curves) {
    if (!points.length) continue;
    const line = points.map(([epoch, value]) => `${x(epoch).toFixed(1)},${y(value).toFixed(1)}`);
    const look = `line c${color}${dashed ? " dashed" : ""}`;
    svg.append(shape("polyline", { class: look, points: line.join(" ") }));
    ends.push({ name, color, at: y(points.at(-1)[1]) + 4 });
  }
  ends.sort((a, b) => a.at - b.at).forEach((end, i) => {
    end.at = Math.max(end.at, i ? ends[i - 1].at + 13 : TOP);
    svg.append(shape("text", { class: `name c${end.color}`, x: width - RIGHT + 6, y: end.at }, end.name));
  });
  const last = curves.filter(({ points }) => points.length)
    .map(({ name, points }) => `${name} ${say(points.at(-1)[1])}`);
  svg.setAttribute("aria-label", last.join(", ") || "nothing yet");
}
