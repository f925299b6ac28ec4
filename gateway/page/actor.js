// An actor in this page: asks the gateway for actions, and tells it what came of them.

export const SPACES = {
  observations: { observation: { kind: "array", shape: [4], dtype: "float32" } },
  actions: { action: { kind: "discrete", counts: [2] } },
};

/** An error that another attempt cannot help. `misfit`: the run plays another environment. */
export class RefusedError extends Error {
  constructor(reason, misfit = false) {
    super(reason);
    this.misfit = misfit;
  }
}

export class Actor {
  #socket;
  #waiting = null; // {resolve, reject} of the answer that is awaited
  #end = null; // why no further answer comes: it may be known while nothing is awaited

  constructor(address) {
    this.#socket = new WebSocket(address);
    this.#socket.onmessage = ({ data }) => this.#take(JSON.parse(data));
    this.#socket.onclose = () => this.#fail(new Error("the connection to the gateway ended"));
  }

  /** Join the run, and return the gateway's welcome. */
  async join(name, token) {
    await this.#answer(() => (this.#socket.onopen = () => this.#waiting.resolve()));
    const hello = { type: "hello", version: 1, name, ...SPACES, ...(token ? { token } : {}) };
    return this.#ask(hello);
  }

  /** Return the action for an observation; `reward` is that of the action before, if there is one. */
  async act(observation, reward = null) {
    return (await this.#ask({ type: "act", observation, ...(reward === null ? {} : { reward }) })).action;
  }

  endEpisode(terminated, observation, reward) {
    this.#socket.send(JSON.stringify({ type: "end_episode", terminated, observation, reward }));
  }

  close() {
    this.#socket.close();
  }

  #ask(message) {
    return this.#answer(() => this.#socket.send(JSON.stringify(message)));
  }

  #answer(begin) {
    return new Promise((resolve, reject) => {
      this.#waiting = { resolve, reject };
      if (this.#end) reject(this.#end);
      else begin();
    });
  }

  #take(message) {
    const final = message.type === "run_ended" || message.code === "refused" || message.code === "misfit";
    if (final) {
      this.#fail(new RefusedError(message.reason, message.code === "misfit"));
    } else if (message.type === "error") {
      this.#waiting?.reject(new Error(message.reason));
    } else {
      this.#waiting?.resolve(message);
    }
  }

  #fail(error) {
    this.#end ??= error;
    this.#waiting?.reject(this.#end);
  }
}
