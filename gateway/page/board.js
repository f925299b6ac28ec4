// The board of tic-tac-toe or Connect Four: buttons where a move is possible, with names for screen readers.

import { element, setText } from "./dom.js";

const MARKS = { cells: ["", "X", "O"], columns: ["", "●", "○"] };

export class Board {
  #cells = []; // by row
  #drops = []; // buttons above the columns

  /** `play` receives the number of an action. */
  constructor(place, play) {
    this.place = place;
    this.play = play;
  }

  /** Show a board (person_match.py, board_of) and which moves are legal. The marks of `own` are the person's. */
  show({ rows, moves }, legal, own) {
    this.place.hidden = false;
    if (this.#cells.length !== rows.length || this.#cells[0].length !== rows[0].length) this.#draw(rows, moves);
    rows.forEach((row, y) =>
      row.forEach((mark, x) => {
        const cell = this.#cells[y][x];
        const owner = mark === 0 ? "empty" : mark === own ? "you" : "policy";
        cell.dataset.mark = owner;
        setText(cell.querySelector("span"), MARKS[moves][mark]);
        const label = `Row ${y + 1}, column ${x + 1}: ${owner === "empty" ? "empty" : `${MARKS[moves][mark]}, ${owner}`}`;
        cell.setAttribute("aria-label", label);
        if (moves === "cells") allow(cell, legal.includes(x * rows.length + y));
      }),
    );
    this.#drops.forEach((drop, column) => allow(drop, legal.includes(column)));
  }

  hide() {
    this.place.hidden = true;
  }

  #draw(rows, moves) {
    const clicked = (button, action) => (button.onclick = () => button.ariaDisabled !== "true" && this.play(action));
    this.#drops = [];
    this.#cells = rows.map((row, y) =>
      row.map((_, x) => {
        if (moves === "columns") return element("div", { class: "cell", role: "img" }, element("span"));
        const button = element("button", { class: "cell", type: "button" }, element("span"));
        clicked(button, x * rows.length + y);
        return button;
      }),
    );
    if (moves === "columns") {
      this.#drops = rows[0].map((_, x) => element("button", { class: "drop", type: "button", "aria-label": `Column ${x + 1}` }, "▼"));
      this.#drops.forEach(clicked);
    }
    this.place.dataset.moves = moves;
    this.place.style.setProperty("--columns", rows[0].length);
    this.place.replaceChildren(...this.#drops, ...this.#cells.flat());
  }
}

/** Let a button be pressed or not. It keeps the focus of the keyboard. */
function allow(button, allowed) {
  button.setAttribute("aria-disabled", String(!allowed));
}
