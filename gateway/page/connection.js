// The WebSocket to the gateway: opens it again when it is lost.

const FIRST_PAUSE = 500;
const LONGEST_PAUSE = 5000; // milliseconds between attempts

export class Connection {
  #socket = null;
  #pause = FIRST_PAUSE;
  #token = "";
  #refused = false;
  #reason = ""; // why the gateway ends the connection

  /** `on` has the functions message(object), frame(ArrayBuffer), opened(), lost(reason) and refused(reason). */
  constructor(on) {
    this.on = on;
  }

  /** Connect, with a token if the gateway needs one. */
  open(token = "") {
    this.#token = token;
    this.#refused = false;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = (this.#socket = new WebSocket(`${scheme}://${location.host}/watch`));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.send({ type: "hello", token: this.#token });
    socket.onmessage = ({ data }) => this.#take(data);
    socket.onclose = () => this.#closed();
  }

  /** Send a message, and return whether there is a connection. */
  send(message) {
    const open = this.#socket?.readyState === WebSocket.OPEN;
    if (open) this.#socket.send(JSON.stringify(message));
    return open;
  }

  #take(data) {
    if (data instanceof ArrayBuffer) return this.on.frame(data);
    const message = JSON.parse(data);
    if (message.type === "hello") {
      this.#pause = FIRST_PAUSE;
      this.on.opened(message);
    } else if (message.type === "error" && message.code === "refused") {
      this.#refused = true;
      this.on.refused(message.reason);
    } else if (message.type === "error") {
      this.#reason = message.reason;
    } else {
      this.on.message(message);
    }
  }

  #closed() {
    if (this.#refused) return;
    this.on.lost(this.#reason);
    this.#reason = "";
    setTimeout(() => this.open(this.#token), this.#pause);
    this.#pause = Math.min(2 * this.#pause, LONGEST_PAUSE);
  }
}
