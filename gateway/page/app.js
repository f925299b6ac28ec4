// The page of a run: passes what the gateway sends to the parts of the page.

import { Camera } from "./camera.js";
import { Connection } from "./connection.js";
import { byId } from "./dom.js";
import { Events } from "./events.js";
import { Fleet } from "./fleet.js";
import { Folder } from "./folder.js";
import { League } from "./league.js";
import { Learning } from "./learning.js";
import { Orders } from "./orders.js";
import { Summary } from "./summary.js";

const connection = new Connection({
  opened(hello) {
    byId("ask-token").hidden = true;
    learning.forgetOthers();
    orders.offer(hello.orders, byId("token").value);
    summary.takesClients = hello.clients;
    summary.playsMatches = hello.matches;
    camera.offer(hello.camera);
  },
  message(message) {
    takers[message.type]?.(message);
  },
  frame: (buffer) => camera.show(buffer),
  lost(reason) {
    summary.lost(reason);
    orders.lost();
  },
  refused(reason) {
    byId("ask-token").hidden = false;
    summary.show({ state: "forbidden", reason, ends: [], status: null });
    byId("token").focus();
  },
});

const learning = new Learning();
const summary = new Summary(learning.metrics);
const league = new League();
const fleet = new Fleet();
const events = new Events();
const folder = new Folder();
const orders = new Orders(connection);
const camera = new Camera(connection);

const takers = {
  run(message) {
    fleet.count(message.status);
    summary.show(message);
  },
  league: (message) => league.show(message),
  actors: (message) => fleet.show(message),
  events: (message) => events.show(message),
  folder: (message) => folder.show(message),
  metrics(message) {
    learning.add(message);
    summary.tiles();
  },
  comparison: (message) => learning.compare(message),
  ordered: (message) => orders.done(message),
  refused: (message) => orders.refused(message),
};

byId("ask-token").onsubmit = (event) => {
  event.preventDefault();
  connection.open(byId("token").value);
};
connection.open();
