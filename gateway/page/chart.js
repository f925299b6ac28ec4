// A line chart in SVG: one line with its band, marks, and the lines of other runs.

import { element, setText, shape } from "./dom.js";
import { number } from "./format.js";

const MARGIN = { top: 8, right: 10, bottom: 20, left: 46 };

/** Return round numbers between two ends, about `count` of them. */
export function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= rough) * power;
  const first = Math.ceil(low / step - 1e-9);
  const more = Math.min(Math.floor(high / step + 1e-9) - first, 2 * count); // of ends that are nearly equal, too
  return Array.from({ length: Math.max(more + 1, 0) }, (_, index) => (first + index) * step);
}

/** Return at most two points for each pixel: the lowest and the highest of those that share it. */
export function thinned(points, width) {
  if (points.length <= 2 * width) return points;
  const size = Math.ceil(points.length / width);
  const kept = [];
  for (let first = 0; first < points.length; first += size) {
    const part = points.slice(first, first + size);
    const low = part.reduce((best, point) => (point[1] < best[1] ? point : best));
    const high = part.reduce((best, point) => (point[1] > best[1] ? point : best));
    kept.push(...(low[0] <= high[0] ? [low, high] : [high, low]));
  }
  return [...new Set(kept)];
}

/** Return the lowest and highest y of points with their bands; null without points. */
export function range(lists) {
  let [low, high] = [Infinity, -Infinity];
  for (const points of lists) {
    for (const [, y, width] of points) {
      low = Math.min(low, y - width);
      high = Math.max(high, y + width);
    }
  }
  if (low > high) return null;
  const isFlat = high - low <= 1e-9 * Math.max(Math.abs(low), Math.abs(high));
  const pad = isFlat ? Math.abs(high) * 0.1 || 1 : 0.05 * (high - low);
  return [low - pad, high + pad];
}

/** Return points whose values are the means of that many rows up to them. */
export function smoothed(points, rows) {
  if (rows <= 1) return points;
  return points.map(([at], index) => {
    const part = points.slice(Math.max(index + 1 - rows, 0), index + 1);
    const mean = (place) => part.reduce((sum, point) => sum + point[place], 0) / part.length;
    return [at, mean(1), mean(2)];
  });
}

const CLICK = 6; // pixels: a pointer that moves less chooses nothing

export class Chart {
  #series = { line: [], raw: [], marks: [], others: [] };
  #scale = null;
  #begun = null; // where a choice began, in pixels

  /**
   * `title` names the metric; `xText` returns the text of a place on the x axis. `onChoice` receives the ends of the part
   * that is chosen by dragging, or null after a double click. `onRemove`, if there is one, is called by a button.
   */
  constructor(title, { wide = false, xText = number, onChoice = () => {}, onRemove = null } = {}) {
    this.title = title;
    this.xText = xText;
    this.svg = shape("svg", { role: "img", "aria-label": `${title}: no values yet` });
    this.reading = element("span", { class: "reading" });
    const caption = element("figcaption", {}, element("h3", {}, title), this.reading);
    if (onRemove) {
      const button = element("button", { type: "button", class: "remove", "aria-label": `Remove ${title}` }, "×");
      button.onclick = onRemove;
      caption.append(button);
    }
    this.figure = element("figure", { class: wide ? "chart wide" : "chart" }, caption, this.svg);
    this.onChoice = onChoice;
    this.svg.addEventListener("pointerdown", ({ offsetX }) => (this.#begun = offsetX));
    this.svg.addEventListener("pointermove", ({ offsetX }) => this.#point(offsetX));
    this.svg.addEventListener("pointerup", ({ offsetX }) => this.#chooseTo(offsetX));
    this.svg.addEventListener("pointerleave", () => this.#leave());
    this.svg.addEventListener("dblclick", () => this.onChoice(null));
    new ResizeObserver(() => this.draw(this.#series)).observe(this.svg);
  }

  /**
   * Draw points [x, y, half width of the band] of the line, of the line before it was smoothed, the marks, and
   * [number, points] of other runs.
   */
  draw(series) {
    this.#series = series;
    if (this.#begun !== null) return; // the scale stays while a part is chosen
    const { clientWidth: width, clientHeight: height } = this.svg;
    if (!width) return; // hidden
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const all = [series.line, series.raw, series.marks, ...series.others.map(([, points]) => points)];
    const ys = range(all);
    if (ys === null) {
      this.#scale = null;
      const none = shape("text", { x: width / 2, y: height / 2, "text-anchor": "middle", class: "empty" }, "no values yet");
      this.svg.replaceChildren(none);
      return setText(this.reading, "");
    }
    const places = all.flatMap((points) => (points.length ? [points[0][0], points.at(-1)[0]] : []));
    const [first, last] = [Math.min(...places), Math.max(...places)];
    const plot = { left: MARGIN.left, right: width - MARGIN.right, top: MARGIN.top, bottom: height - MARGIN.bottom };
    const x = (value) => plot.left + ((value - first) / (last - first || 1)) * (plot.right - plot.left);
    const y = (value) => plot.bottom - ((value - ys[0]) / (ys[1] - ys[0])) * (plot.bottom - plot.top);
    const valueAt = (place) => first + ((place - plot.left) / (plot.right - plot.left)) * (last - first);
    this.#scale = { x, y, plot, valueAt };
    const points = thinned(series.line, plot.right - plot.left);
    this.svg.replaceChildren(
      ...this.#axes(first, last, ys, plot, x, y),
      ...(points.some(([, , size]) => size > 0) ? [shape("path", { class: "band", d: band(points, x, y) })] : []),
      ...series.others.map(([place, other]) =>
        shape("path", { class: `other series-${place}`, d: path(thinned(other, plot.right - plot.left), x, y) }),
      ),
      shape("path", { class: "raw", d: path(thinned(series.raw.map(([at, value]) => [at, value, 0]), plot.right - plot.left), x, y) }),
      shape("path", { class: "line", d: path(points, x, y) }),
      ...(points.length === 1 ? points : series.marks).map(([at, value]) => shape("circle", { class: "mark", cx: x(at), cy: y(value), r: 3 })),
    );
    this.#describe(first, last);
  }

  #axes(first, last, ys, plot, x, y) {
    const across = ticks(...ys, 4).map((value) => [
      shape("line", { class: "grid", x1: plot.left, x2: plot.right, y1: y(value), y2: y(value) }),
      shape("text", { x: plot.left - 6, y: y(value) + 4, "text-anchor": "end" }, number(value)),
    ]);
    const wanted = Math.max(3, Math.floor((plot.right - plot.left) / 110));
    const along = (last > first ? ticks(first, last, wanted) : [first]).map((value) =>
      shape("text", { x: x(value), y: plot.bottom + 15, "text-anchor": "middle" }, this.xText(value)),
    );
    return [...across.flat(), ...along];
  }

  #describe(first, last) {
    const { line } = this.#series;
    const newest = line.length ? number(line.at(-1)[1]) : "-";
    setText(this.reading, newest);
    const where = `from ${this.xText(first)} to ${this.xText(last)}`;
    this.svg.setAttribute("aria-label", `${this.title}: ${newest} at the end, ${where}`);
  }

  /** Choose the part from where the pointer went down to where it is. */
  #chooseTo(at) {
    const [from, scale] = [this.#begun, this.#scale];
    this.#begun = null;
    if (scale === null || from === null || Math.abs(at - from) < CLICK) return;
    this.onChoice([from, at].sort((one, other) => one - other).map(scale.valueAt));
  }

  #leave() {
    this.#begun = null;
    this.draw(this.#series);
  }

  /** Show the value below the pointer, and the part that is being chosen. */
  #point(at) {
    const { line } = this.#series;
    if (!line.length || this.#scale === null) return;
    const { x, y, plot } = this.#scale;
    const nearest = line.reduce((best, point) => (Math.abs(x(point[0]) - at) < Math.abs(x(best[0]) - at) ? point : best));
    this.svg.querySelectorAll(".cursor").forEach((old) => old.remove());
    const place = x(nearest[0]);
    this.svg.append(
      shape("line", { class: "cursor", x1: place, x2: place, y1: plot.top, y2: plot.bottom }),
      shape("circle", { class: "mark cursor", cx: place, cy: y(nearest[1]), r: 3 }),
    );
    if (this.#begun !== null) {
      const size = { x: Math.min(this.#begun, at), width: Math.abs(at - this.#begun), y: plot.top, height: plot.bottom - plot.top };
      this.svg.append(shape("rect", { class: "cursor choice", ...size }));
    }
    const width = nearest[2] ? ` ± ${number(nearest[2])}` : "";
    setText(this.reading, `${number(nearest[1])}${width} at ${this.xText(nearest[0])}`);
  }
}

function path(points, x, y) {
  return points.map(([at, value], index) => `${index ? "L" : "M"}${x(at).toFixed(1)},${y(value).toFixed(1)}`).join("");
}

function band(points, x, y) {
  const above = points.map(([at, value, width]) => [at, value + width]);
  const below = points.map(([at, value, width]) => [at, value - width]).reverse();
  return `${path([...above, ...below], x, y)}Z`;
}
