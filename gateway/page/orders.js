// The operator's buttons: a checkpoint, and the end of the run.

import { byId, setText } from "./dom.js";

// Where the learner does not say what came of an order.
const DONE = { stop: "The learner saves a checkpoint and ends.", checkpoint: "The learner saves a checkpoint." };

export class Orders {
  #pending = false; // whether the learner's answer to an order is awaited

  constructor(connection) {
    this.connection = connection;
    byId("orders").onsubmit = (event) => {
      event.preventDefault();
      this.#ask(event.submitter.value);
    };
    byId("confirm").onclose = () => {
      if (byId("confirm").returnValue === "yes") this.#give("stop");
    };
  }

  /** Show the buttons if the gateway takes orders. `token` is the one that the page reads with. */
  offer(offered, token) {
    byId("operator-token").value ||= token;
    byId("orders").hidden = !offered;
    byId("read-only").hidden = offered;
  }

  done({ order, result }) {
    this.#show(result ? `Done: ${result}.` : DONE[order]);
  }

  refused({ reason }) {
    this.#show(`Not done: ${reason}`);
  }

  /** The connection has ended. */
  lost() {
    if (this.#pending) this.#show("The connection was lost before an answer came: see below whether it was done.");
  }

  #ask(order) {
    if (order === "checkpoint") return this.#give(order);
    byId("confirm").returnValue = "";
    byId("confirm").showModal();
  }

  #give(order) {
    const sent = this.connection.send({ type: "order", order, token: byId("operator-token").value });
    this.#show(sent ? "Asking the learner..." : "Not done: the gateway does not answer. Try again.");
    this.#pending = sent;
  }

  #show(text) {
    this.#pending = false;
    setText(byId("order-result"), text);
  }
}
