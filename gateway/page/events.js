// The newest events of the run: joins, losses, quarantines, checkpoints.

import { byId, element } from "./dom.js";

const KINDS = {
  "all events": null,
  "joins and losses": ["joined", "left"],
  problems: ["refused", "failed", "rejected", "quarantined"],
  "the run": ["started", "target", "checkpoint", "ended"],
};
const BAD = new Set(["failed", "quarantined"]);
const WARN = new Set(["refused", "rejected", "left"]);

export class Events {
  #events = [];
  #kinds = byId("kinds");

  constructor() {
    this.#kinds.append(...Object.keys(KINDS).map((name) => element("option", { value: name }, name)));
    this.#kinds.onchange = () => this.#draw();
    this.#draw();
  }

  show({ events }) {
    this.#events = events;
    this.#draw();
  }

  #draw() {
    const kinds = KINDS[this.#kinds.value];
    const chosen = this.#events.filter(({ kind }) => kinds === null || kinds.includes(kind)).reverse();
    const none = element("li", { class: "none" }, "No events yet.");
    byId("log").replaceChildren(...(chosen.length ? chosen.map(entry) : [none]));
  }
}

function entry({ time, kind, actor, text, count }) {
  const style = BAD.has(kind) ? "bad" : WARN.has(kind) ? "warn" : "";
  const clock = new Date(time).toLocaleTimeString("en-GB");
  return element(
    "li",
    {},
    element("time", { datetime: time }, clock),
    element("span", { class: style }, kind),
    element("span", {}, actor || "-"),
    element("span", {}, count > 1 ? `${text} (${count} times)` : text),
  );
}
