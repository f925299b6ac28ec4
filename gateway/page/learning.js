// The curves of the run, beside those of other runs.

import { Chart } from "./chart.js";
import { byId, element, setText, shape } from "./dom.js";
import { duration, number } from "./format.js";
import { Metrics } from "./metrics.js";

const CHARTS = [
  { title: "Return", column: "episode_return_mean", width: "episode_return_std", wide: true },
  { title: "Entropy (nats)", column: "entropy" },
  { title: "Value loss", column: "value_loss" },
  { title: "KL of behaviour and target policy", column: "behaviour_kl" },
  { title: "Policy lag (updates)", column: "policy_lag_mean" },
  { title: "env_steps/s", column: "env_steps_per_second" },
];

export class Learning {
  #own = new Metrics();
  #others = []; // [name, metrics]
  #axis = byId("axis");
  #further = byId("further");
  #charts = [];
  #due = false;

  constructor() {
    for (const definition of CHARTS) this.#add(definition);
    this.#axis.onchange = () => this.#draw();
    this.#further.onchange = () => this.#showFurther();
  }

  get metrics() {
    return this.#own;
  }

  add(message) {
    this.#own.add(message);
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

  #add(definition) {
    const xText = (value) => (this.#axis.value === "env_steps" ? number(value) : duration(value));
    const chart = new Chart(definition.title, { wide: definition.wide, xText });
    byId("charts").append(chart.figure);
    this.#charts.push({ ...definition, chart });
  }

  #showFurther() {
    const index = this.#charts.findIndex(({ further }) => further);
    if (index >= 0) this.#charts.splice(index, 1)[0].chart.figure.remove();
    const column = this.#further.value;
    if (column) this.#add({ title: column, column, further: true });
    this.#draw();
  }

  /** Offer the metrics that have no chart. */
  #offer() {
    const shown = new Set(CHARTS.flatMap(({ column, width }) => [column, width]));
    const names = this.#own.names.filter((name) => !shown.has(name)).sort();
    const offered = [...this.#further.options].slice(1).map(({ value }) => value);
    if (names.join() === offered.join()) return;
    const chosen = this.#further.value;
    this.#further.replaceChildren(
      element("option", { value: "" }, "none"),
      ...names.map((name) => element("option", { value: name }, name)),
    );
    this.#further.value = names.includes(chosen) ? chosen : "";
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
    for (const { chart, column, width = null } of this.#charts) {
      chart.draw({
        line: this.#own.points(x, column, width),
        marks: column === "episode_return_mean" ? this.#own.evaluations(x) : [],
        others: this.#others.map(([, metrics], index) => [index + 1, metrics.points(x, column)]),
      });
    }
    setText(byId("learning-title"), this.#own.length ? "Learning" : "Learning: no figures yet");
  }
}
