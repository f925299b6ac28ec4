// The page on which a person plays a game against the policy of the run.

import { Board } from "./board.js";
import { Connection } from "./connection.js";
import { byId, element, setText } from "./dom.js";
import { number, whole } from "./format.js";

const connection = new Connection({
  opened(hello) {
    byId("ask-token").hidden = true;
    byId("start").disabled = !hello.matches;
    say(hello.matches ? "Choose your seat and begin a match." : "This gateway plays no matches (--no-camera).");
  },
  message(message) {
    if (message.type === "refused") refused(message.reason);
  },
  frame: (buffer) => show(buffer),
  lost(reason) {
    byId("start").disabled = true;
    forget();
    say(`The gateway does not answer: the match is lost.${reason ? ` (${reason})` : ""}`);
  },
  refused(reason) {
    byId("ask-token").hidden = false;
    say(reason);
    byId("token").focus();
  },
});

const board = new Board(byId("board"), (action) => play({ action: [action] }));
let facts = null; // of the match; null without one
let waiting = false; // for the answer to an order

const say = (text) => setText(byId("status"), text);

function begin() {
  const sent = connection.send({ type: "match", agent: byId("agent").value, sampled: byId("sampled").checked });
  waiting = sent;
  if (sent && facts === null) say("The match begins in a few seconds...");
}

function play(action) {
  if (waiting || facts === null || facts.result) return;
  waiting = connection.send({ type: "move", turn: facts.turn, action });
}

function refused(reason) {
  waiting = false;
  say(`Not done: ${reason}`);
}

function forget() {
  facts = null;
  waiting = false;
  board.hide();
  for (const id of ["text", "picture", "action", "scores"]) byId(id).hidden = true;
}

/** Show a frame: four bytes with the length of a map in JSON, that map, and a JPEG, if there is one. */
async function show(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const shown = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  waiting = false;
  if (shown.error) {
    forget();
    return say(shown.error);
  }
  facts = shown;
  setText(byId("start"), facts.result ? "Play again" : "Begin another match");
  choices(facts);
  if (facts.board) {
    const legal = facts.result ? [] : facts.actions[0].choices[0];
    board.show(facts.board, legal, facts.agents.indexOf(facts.agent) + 1);
  } else {
    board.hide();
  }
  byId("text").hidden = !facts.text;
  setText(byId("text"), facts.text);
  form(facts);
  scores(facts);
  say(described(facts));
  await picture(new Uint8Array(buffer, 4 + length));
}

async function picture(bytes) {
  byId("picture").hidden = !bytes.length;
  if (!bytes.length) return;
  const image = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
  Object.assign(byId("picture"), { width: image.width, height: image.height });
  byId("picture").getContext("2d").drawImage(image, 0, 0);
  image.close();
}

/** Offer the seats of the game. */
function choices({ agents, agent }) {
  const select = byId("agent");
  if (select.options.length === agents.length && select.options[0].value === agents[0]) return;
  select.replaceChildren(...agents.map((name) => element("option", { value: name }, name)));
  select.value = agent;
}

/** Return what has happened, and what is to do. */
function described({ remark, result, moves, agent, board: shown }) {
  const texts = moves.map(([name, action]) => `${name} played ${moveText(action, shown)}.`);
  if (remark) texts.unshift(`Not played: ${remark}.`);
  texts.push(result || `Your turn, ${agent}.`);
  return texts.join(" ");
}

function moveText(action, shown) {
  const values = Object.entries(action);
  if (!shown) return values.map(([name, numbers]) => `${values.length > 1 ? `${name} ` : ""}${numbers.map(number).join(", ")}`).join("; ");
  const [move] = values[0][1];
  if (shown.moves === "columns") return `column ${move + 1}`;
  const height = shown.rows.length;
  return `row ${(move % height) + 1}, column ${Math.floor(move / height) + 1}`;
}

/** Show a form with the legal actions, for games that have no board here. */
function form({ actions, board: shown, result }) {
  const target = byId("action");
  target.hidden = Boolean(shown) || Boolean(result);
  if (target.hidden) return;
  const inputs = actions.flatMap(({ name, choices, low, high }) => (choices ? choices.map((legal, index) => select(name, legal, index, choices.length)) : low.map((_, index) => input(name, low[index], high[index], index, low.length))));
  target.replaceChildren(...inputs, element("button", { type: "submit", class: "primary" }, "Play"));
  target.onsubmit = (event) => {
    event.preventDefault();
    const chosen = {};
    for (const field of target.querySelectorAll("[data-name]")) (chosen[field.dataset.name] ??= []).push(Number(field.value));
    play(chosen);
  };
}

const labelled = (name, index, count, field) => element("label", {}, count > 1 ? `${name} ${index + 1}` : name, field);

function select(name, legal, index, count) {
  const options = legal.map((choice) => element("option", { value: choice }, choice));
  return labelled(name, index, count, element("select", { "data-name": name }, ...options));
}

function input(name, low, high, index, count) {
  return labelled(name, index, count, element("input", { "data-name": name, type: "number", step: "any", min: low, max: high, value: Math.max(low ?? 0, Math.min(high ?? 0, 0)), required: "" }));
}

function scores({ returns, agent, version }) {
  byId("scores").hidden = false;
  const tile = (title, value, more) => element("div", { class: "tile" }, element("dt", {}, title), element("dd", { class: "value" }, value), element("dd", { class: "more" }, more));
  const tiles = Object.entries(returns).map(([name, value]) => tile(`Return of ${name}`, number(value), name === agent ? "you" : "the policy"));
  byId("tiles").replaceChildren(...tiles, tile("Policy version", whole(version), "in this match"));
}

byId("begin").onsubmit = (event) => {
  event.preventDefault();
  begin();
};
byId("ask-token").onsubmit = (event) => {
  event.preventDefault();
  connection.open(byId("token").value);
};
connection.open();
