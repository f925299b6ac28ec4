// The operator's buttons: a checkpoint, and the end of the run.

import { byId, setText } from "./dom.js";

const DONE = { stop: "The learner saves a checkpoint and ends.", checkpoint: "The learner saves a checkpoint." };

export class Orders {
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

  /** Show the buttons if the gateway takes orders. */
  offer(offered) {
    byId("orders").hidden = !offered;
    byId("read-only").hidden = offered;
  }

  done({ order }) {
    setText(byId("order-result"), DONE[order]);
  }

  refused({ reason }) {
    setText(byId("order-result"), `Not done: ${reason}`);
  }

  #ask(order) {
    if (order === "checkpoint") return this.#give(order);
    byId("confirm").returnValue = "";
    byId("confirm").showModal();
  }

  #give(order) {
    setText(byId("order-result"), "Asking the learner...");
    this.connection.send({ type: "order", order, token: byId("operator-token").value });
  }
}
