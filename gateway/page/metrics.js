// Rows of metrics by column: of the run that is watched, and of those it is compared with.

export class Metrics {
  #columns = new Map(); // name -> values, null where a row has none
  length = 0;

  /** Add the rows of a message; `reset` drops those of before. */
  add({ columns, rows, reset }) {
    if (reset) {
      this.#columns.clear();
      this.length = 0;
    }
    for (const name of columns) {
      if (!this.#columns.has(name)) this.#columns.set(name, new Array(this.length).fill(null));
    }
    const place = new Map(columns.map((name, index) => [name, index]));
    for (const [name, values] of this.#columns) {
      const index = place.get(name);
      for (const row of rows) values.push(index === undefined ? null : row[index]);
    }
    this.length += rows.length;
  }

  /** Return the values of a column. */
  column(name) {
    return this.#columns.get(name) ?? new Array(this.length).fill(null);
  }

  get names() {
    return [...this.#columns.keys()];
  }

  /** Return the newest value of a column, or null. */
  newest(name) {
    const values = this.column(name);
    for (let index = values.length - 1; index >= 0; index--) if (values[index] !== null) return values[index];
    return null;
  }

  /** Return points [x, y] of two columns, and of the half width of a band if a third is named. */
  points(x, y, width = null) {
    const [xs, ys, widths] = [this.column(x), this.column(y), width && this.column(width)];
    const points = [];
    for (let index = 0; index < this.length; index++) {
      if (xs[index] === null || ys[index] === null) continue;
      points.push([xs[index], ys[index], widths ? (widths[index] ?? 0) : 0]);
    }
    return points;
  }

  /** Return the evaluations [x, mean], each once, at the env_steps of the policy that was evaluated. */
  evaluations(x) {
    const [at, means, xs] = [this.column("evaluation_env_steps"), this.column("evaluation_return_mean"), this.column(x)];
    const found = new Map();
    for (let index = 0; index < this.length; index++) {
      if (at[index] === null || means[index] === null) continue;
      found.set(at[index], [x === "env_steps" ? at[index] : xs[index], means[index], 0]);
    }
    return [...found.values()].filter(([where]) => where !== null);
  }
}
