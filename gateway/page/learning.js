// The curves of the run, beside those of other runs.

import { Chart, smoothed } from "./chart.js";
import { byId, element, setText, shape } from "./dom.js";
import { duration, number } from "./format.js";
import { Metrics } from "./metrics.js";

const RETURN = { title: "Return", column: "episode_return_mean", width: "episode_return_std", wide: true };
const RATING = { title: "Rating", column: "rating", width: "rating_deviation", wide: true };
const WIN_RATE = "win_rate/"; // columns of the win rates against fixed opponents
const MOST_WIN_RATES = 6; // with a chart of their own; others can be added
const CHARTS = [
  { title: "Entropy (nats)", column: "entropy" },
  { title: "Value loss", column: "value_loss" },
  { title: "KL of behaviour and target policy", column: "behaviour_kl" },
  { title: "Policy lag (updates)", column: "policy_lag_mean" },
  { title: "env_steps/s", column: "env_steps_per_second" },
];

const PARTS = { "whole run": 1, "last half": 1 / 2, "last fifth": 1 / 5, "last twentieth": 1 / 20 };
const CHOSEN = "as chosen";
const SMOOTHING = { none: 1, "5 rows": 5, "20 rows": 20, "100 rows": 100 };

const options = (names) => names.map((name) => element("option", { value: name }, name));

export class Learning {
  #own = new Metrics();
  #others = []; // [name, metrics]
  #axis = byId("axis");
  #part = byId("part");
  #smoothing = byId("smoothing");
  #further = byId("further");
  #charts = [];
  #chosen = null; // [first, last] of the x axis, if a part was chosen in a chart
  #due = false;

  constructor() {
    this.#part.append(...options(Object.keys(PARTS)));
    this.#smoothing.append(...options(Object.keys(SMOOTHING)));
    this.#further.append(element("option", { value: "" }, "choose"));
    this.#add(RETURN, byId("return"));
    this.#add(RATING, byId("rating"));
    for (const definition of CHARTS) this.#add(definition);
    this.#axis.onchange = () => this.#choose(null);
    this.#part.onchange = () => this.#choose(null, this.#part.value);
    this.#smoothing.onchange = () => this.#draw();
    this.#further.onchange = () => this.#showFurther();
  }

  get metrics() {
    return this.#own;
  }

  add(message) {
    this.#own.add(message);
    this.#addWinRates();
    this.#offer();
    this.#drawSoon();
  }

  /** Forget the other runs: the gateway sends them again after each connection. */
  forgetOthers() {
    this.#others = [];
    this.#showLegend();
  }

  compare({ name, ...table }) {
    const metrics = new Metrics();
    metrics.add({ ...table, reset: true });
    this.#others.push([name, metrics]);
    this.#showLegend();
    this.#drawSoon();
  }

  #addWinRates() {
    const shown = this.#charts.map(({ column }) => column);
    const all = this.#own.names.filter((name) => name.startsWith(WIN_RATE)).slice(0, MOST_WIN_RATES);
    for (const column of all.filter((name) => !shown.includes(name))) {
      this.#add({ title: `Win rate against ${column.slice(WIN_RATE.length)}`, column }, byId("win-rates"));
    }
  }

  #add(definition, where = byId("charts")) {
    const xText = (value) => (this.#axis.value === "env_steps" ? number(value) : duration(value));
    const onChoice = (ends) => this.#choose(ends, ends ? CHOSEN : undefined);
    const chart = new Chart(definition.title, { wide: definition.wide, xText, onChoice, onRemove: definition.onRemove });
    where.append(chart.figure);
    this.#charts.push({ ...definition, chart });
  }

  /** Show a part of the run: two ends that were chosen in a chart, or a part by its name. */
  #choose(ends, name = Object.keys(PARTS)[0]) {
    this.#chosen = ends;
    [...this.#part.options].find(({ value }) => value === CHOSEN)?.remove();
    if (ends) this.#part.append(...options([CHOSEN]));
    this.#part.value = name;
    this.#draw();
  }

  /** Return the ends of the shown part on the x axis. */
  #ends() {
    const share = PARTS[this.#part.value] ?? 1;
    if (this.#chosen) return this.#chosen;
    if (share === 1) return [-Infinity, Infinity];
    const places = this.#own.column(this.#axis.value).filter((value) => value !== null);
    const [first, last] = [places[0] ?? 0, places.at(-1) ?? 0];
    return [last - share * (last - first), Infinity];
  }

  #showFurther() {
    const column = this.#further.value;
    this.#further.value = "";
    const onRemove = () => {
      const index = this.#charts.findIndex((chart) => chart.further && chart.column === column);
      this.#charts.splice(index, 1)[0].chart.figure.remove();
      this.#offer();
      this.#further.focus();
    };
    this.#add({ title: column, column, further: true, onRemove });
    this.#offer();
    this.#draw();
  }

  /** Offer the metrics that have no chart. */
  #offer() {
    const shown = new Set(this.#charts.flatMap(({ column, width }) => [column, width]));
    const names = this.#own.names.filter((name) => !shown.has(name)).sort();
    const offered = [...this.#further.options].slice(1).map(({ value }) => value);
    if (names.join() === offered.join()) return;
    this.#further.replaceChildren(this.#further.options[0], ...options(names));
  }

  #showLegend() {
    const entry = (name, style) => {
      const line = shape("line", { x1: 0, x2: 26, y1: 5, y2: 5, class: style });
      return element("li", {}, shape("svg", { viewBox: "0 0 26 10", "aria-hidden": "true" }, line), name);
    };
    byId("legend").hidden = !this.#others.length;
    byId("legend").replaceChildren(
      entry("this run", "own"),
      ...this.#others.map(([name], index) => entry(name, `series-${index + 1}`)),
    );
  }

  #drawSoon() {
    if (this.#due) return;
    this.#due = true;
    requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#due = false;
    const x = this.#axis.value;
    const [first, last] = this.#ends();
    const rows = SMOOTHING[this.#smoothing.value];
    const within = (points) => points.filter(([at]) => at >= first && at <= last);
    for (const { chart, column, width = null } of this.#charts) {
      const points = this.#own.points(x, column, width);
      chart.draw({
        line: within(smoothed(points, rows)),
        raw: rows > 1 ? within(points) : [],
        marks: column === RETURN.column ? within(this.#own.evaluations(x)) : [],
        others: this.#others.map(([, metrics], index) => [index + 1, within(smoothed(metrics.points(x, column), rows))]),
      });
    }
    setText(byId("learning-title"), this.#own.length ? "Return" : "Return: no figures yet");
  }
}
