// An episode that the gateway plays: the picture, and what the policy thinks of it.

import { byId, element, setText } from "./dom.js";
import { number, percent, whole } from "./format.js";

const FACTS = ["Policy version", "Step", "Reward", "Return so far", "Value estimate"];

export class Camera {
  #on = false;
  #canvas = element("canvas", { role: "img", "aria-label": "The environment as it is rendered" });
  #facts = new Map(FACTS.map((name) => [name, element("dd", {}, "-")]));
  #actions = element("div");
  #drawing = false;

  constructor(connection) {
    this.connection = connection;
    this.button = byId("camera-switch");
    this.button.onclick = () => this.#switch(!this.#on);
    document.addEventListener("visibilitychange", () => this.#on && this.#ask());
    const facts = [...this.#facts].flatMap(([name, value]) => [element("dt", {}, name), value]);
    const side = element("div", { class: "side" }, element("dl", {}, ...facts), this.#actions);
    byId("camera-view").append(this.#canvas, side);
  }

  /** Show whether the gateway has a camera; after a new connection it must be asked again. */
  offer(offered) {
    this.button.disabled = !offered;
    if (!offered) setText(byId("camera-note"), "The camera is off.");
    if (this.#on) this.#switch(offered);
  }

  #switch(on) {
    this.#on = on;
    this.button.setAttribute("aria-pressed", String(on));
    setText(this.button, on ? "Hide the episode" : "Show an episode");
    byId("camera-view").hidden = !on;
    if (on) setText(byId("camera-note"), "The first picture comes in a few seconds.");
    this.#ask();
  }

  /** Ask for pictures, or for no more. A hidden page needs none. */
  #ask() {
    this.connection.send({ type: "camera", on: this.#on && !document.hidden });
  }

  /** Show a frame: four bytes with the length of a map in JSON, that map, and a JPEG, if there is one. */
  async show(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    if (facts.error) return setText(byId("camera-note"), facts.error);
    setText(byId("camera-note"), "The gateway plays with the newest policy, without exploring.");
    if (this.#drawing) return; // the browser is slower than the camera
    this.#drawing = true;
    try {
      const image = await createImageBitmap(new Blob([new Uint8Array(buffer, 4 + length)], { type: "image/jpeg" }));
      Object.assign(this.#canvas, { width: image.width, height: image.height });
      this.#canvas.getContext("2d").drawImage(image, 0, 0);
      image.close();
    } finally {
      this.#drawing = false;
    }
    this.#describe(facts);
  }

  #describe({ version, step, reward, total, value, actions }) {
    const texts = [whole(version), whole(step), number(reward), number(total), value === null ? "not known" : number(value)];
    FACTS.forEach((name, index) => setText(this.#facts.get(name), texts[index]));
    this.#actions.replaceChildren(...actions.flatMap(described));
  }
}

/** Return the elements about one component of the action. */
function described({ name, choices, numbers }) {
  const title = element("h3", {}, name);
  if (numbers) {
    const texts = numbers.map(([taken, spread]) => element("li", {}, `${number(taken)} ± ${number(spread)}`));
    return [title, element("ul", { class: "bars" }, ...texts)];
  }
  const bars = choices.map(([label, share, taken]) => {
    const fill = element("div", { class: "fill" });
    fill.style.width = `${100 * share}%`;
    const parts = [element("span", {}, label), element("div", { class: "track" }, fill), element("span", { class: "percent" }, percent(share))];
    return element("li", { class: taken ? "taken" : null }, ...parts);
  });
  return [title, element("ul", { class: "bars" }, ...bars)];
}
