/** Line charts as SVG: a few curves over epochs, named at their ends. */

const [LEFT, RIGHT, TOP, BOTTOM, HEIGHT] = [34, 46, 8, 20, 128];

function shape(kind, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

/**
 * Draw curves: {name, points: [[epoch, value]...], color, dotted} between `least` and `most`.
 *
 * `say` puts a value into words: labels of the axis, a curve's last value, what a screen reader says.
 */
export function drawChart(svg, curves, { epochs, least, most, say }) {
  const width = svg.clientWidth || 300;
  const share = (value) => Math.min(Math.max((value - least) / (most - least), 0), 1);
  const x = (epoch) => LEFT + (epoch / epochs) * (width - LEFT - RIGHT);
  const y = (value) => TOP + (1 - share(value)) * (HEIGHT - TOP - BOTTOM);
  svg.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
  svg.replaceChildren();
  for (const value of [least, (least + most) / 2, most]) {
    svg.append(shape("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }));
    svg.append(shape("text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end" }, say(value)));
  }
  for (const [epoch, text] of [[0, "0"], [epochs, `${epochs} epochs`]]) {
    const anchor = epoch ? "end" : "middle";
    svg.append(shape("text", { x: x(epoch), y: HEIGHT - 4, "text-anchor": anchor }, text));
  }
  const ends = [];
  for (const { name, points, color, dotted } of curves) {
    if (!points.length) continue;
    const line = points.map(([epoch, value]) => `${x(epoch).toFixed(1)},${y(value).toFixed(1)}`);
    const look = `line c${color}${dotted ? " dotted" : ""}`;
    svg.append(shape("polyline", { class: look, points: line.join(" ") }));
    if (!dotted) ends.push({ name: name ?? say(points.at(-1)[1]), color, at: y(points.at(-1)[1]) + 4 });
  }
  ends.sort((a, b) => a.at - b.at).forEach((end, i) => {
    end.at = Math.max(end.at, i ? ends[i - 1].at + 13 : TOP + 4);
    svg.append(shape("text", { class: `end c${end.color}`, x: width - RIGHT + 5, y: end.at }, end.name));
  });
  const last = curves.filter(({ points, dotted }) => points.length && !dotted)
    .map(({ name = "", points }) => `${name} ${say(points.at(-1)[1])}`.trim());
  svg.setAttribute("aria-label", last.join(", ") || "nothing yet");
}
