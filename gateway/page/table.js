// A table that is sorted by its headers, and changes in place: focus and scrolling stay.

import { element, setText } from "./dom.js";

const SHOWN = 100; // rows at first

export class Table {
  #rows = [];
  #columns = [];
  #sorted;
  #limit = SHOWN;

  /**
   * `caption` names the table. `sorted` is [column, direction] at first; direction is 1 or -1.
   * A column is {name, title, text(row), value(row), number, style(row)}; `value` sorts. In place of
   * `text` it may have draw(cell, row).
   */
  constructor(caption, sorted) {
    this.#sorted = sorted;
    this.head = element("tr");
    this.body = element("tbody");
    const table = element("table", {}, element("caption", {}, caption), element("thead", {}, this.head), this.body);
    this.more = element("button", { type: "button", class: "more", hidden: "" });
    this.more.onclick = () => {
      this.#limit += 10 * SHOWN;
      this.#draw();
    };
    const scroll = element("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption }, table);
    this.root = element("div", {}, scroll, this.more);
  }

  show(columns, rows) {
    if (columns.map(({ name }) => name).join() !== this.#columns.map(({ name }) => name).join()) this.#setColumns(columns);
    this.#columns = columns;
    this.#rows = rows;
    this.#draw();
  }

  #setColumns(columns) {
    this.head.replaceChildren(
      ...columns.map(({ name, title, number }) => {
        const button = element("button", { type: "button" }, title);
        button.onclick = () => this.#sort(name, number);
        return element("th", { scope: "col", class: number ? "number" : "", "data-name": name }, button);
      }),
    );
    this.body.replaceChildren();
  }

  #sort(name, number) {
    const first = number ? -1 : 1; // numbers begin with the largest
    this.#sorted = this.#sorted[0] === name ? [name, -this.#sorted[1]] : [name, first];
    this.#draw();
  }

  #draw() {
    const [name, direction] = this.#sorted;
    for (const header of this.head.children) {
      if (header.dataset.name === name) header.setAttribute("aria-sort", direction > 0 ? "ascending" : "descending");
      else header.removeAttribute("aria-sort");
    }
    const column = this.#columns.find((one) => one.name === name) ?? this.#columns[0];
    const sorted = [...this.#rows].sort((one, other) => direction * compared(column.value(one), column.value(other)));
    const shown = sorted.slice(0, this.#limit);
    while (this.body.rows.length > shown.length) this.body.deleteRow(-1);
    shown.forEach((row, index) => this.#fill(this.body.rows[index] ?? this.#newRow(), row));
    this.more.hidden = shown.length === sorted.length;
    setText(this.more, `Show more: ${sorted.length - shown.length} rows are hidden`);
  }

  #newRow() {
    const cells = this.#columns.map(({ number, wraps }) => element("td", { class: number ? "number" : wraps ? "text" : "" }));
    this.body.append(element("tr", {}, ...cells));
    return this.body.rows[this.body.rows.length - 1];
  }

  #fill(target, row) {
    target.dataset.state = row.state ?? "";
    this.#columns.forEach(({ text, draw, number, wraps, style }, index) => {
      const cell = target.cells[index];
      if (draw) draw(cell, row);
      else setText(cell, text(row));
      cell.className = `${number ? "number" : wraps ? "text" : ""} ${style?.(row) ?? ""}`.trim();
    });
  }
}

function compared(one, other) {
  return typeof one === "string" ? one.localeCompare(other, "en", { numeric: true }) : one - other;
}
