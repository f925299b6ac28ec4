// The actors of the run: totals, hosts, and a table that is filtered and sorted.

import { byId, setText } from "./dom.js";
import { counted, number, percent, policyLag, whole } from "./format.js";
import { Table } from "./table.js";

const MANY = 50; // actors, from which on the hosts are shown too
// Fields of the status with a column of their own, or without one. All others have a column where they are not empty.
const KNOWN = new Set(`actor host software address alive quarantined lives seconds_since_seen environments env_steps
  env_steps_per_second rollouts_accepted rollouts_rejected rollouts_missed busy_answers policy_lag compact_snapshots
  bytes_up_per_hour bytes_down_per_hour rows silence_limit_seconds`.split(/\s+/));

const TITLES = { epsilon: "Exploration", rollout_seconds: "Rollout (s)", waiting_seconds: "Waits (s)", round_trip_seconds: "Trip (s)", processor_share: "Processors", memory_bytes: "Memory (bytes)" };

const stateOf = (actor) => (actor.quarantined ? "quarantined" : actor.alive ? "alive" : "gone");
const sum = (values) => values.reduce((total, value) => total + value, 0);
const rejections = (actor) => sum(Object.values(actor.rollouts_rejected));
const busyShare = (actor) => actor.busy_answers / Math.max(actor.busy_answers + actor.rollouts_accepted + rejections(actor), 1);
const byCause = (actor) => Object.entries(actor.rollouts_rejected).sort().map(([cause, count]) => `${whole(count)} ${cause}`).join(", ");
const remarks = (actor) => [byCause(actor), actor.quarantined && `quarantined: ${actor.quarantined}`].filter(Boolean).join("; ");

// The share of time in which a person, or a safety filter, had to help a client.
const helpedShare = (actor) => actor.overridden_actions / Math.max(actor.rows, actor.overridden_actions, 1);
const HELPED = { name: "overridden_actions", title: "Helped", number: true, text: (row) => percent(helpedShare(row)), value: helpedShare };

const lagOf = (row) => policyLag(row.policy_lag, row.updates_per_batch)[0];

const COLUMNS = [
  { name: "actor", title: "Actor", text: (row) => row.actor },
  { name: "state", title: "State", text: (row) => row.state, style: (row) => (row.state === "quarantined" ? "bad" : "") },
  { name: "host", title: "Host", text: (row) => row.host || "-" },
  { name: "rate", title: "env_steps/s", number: true, text: (row) => number(row.env_steps_per_second), value: (row) => row.env_steps_per_second },
  { name: "steps", title: "env_steps", number: true, text: (row) => whole(row.env_steps), value: (row) => row.env_steps },
  { name: "lag", title: "Lag", number: true, text: lagOf, value: (row) => row.policy_lag },
  { name: "busy", title: "Busy", number: true, text: (row) => percent(busyShare(row)), value: busyShare },
  { name: "seen", title: "Seen", number: true, text: (row) => `${number(row.seconds_since_seen, 2)} s`, value: (row) => row.seconds_since_seen },
  { name: "snapshots", title: "Snapshots", text: (row) => (row.compact_snapshots ? "compact" : "whole") },
  { name: "rejected", title: "Rejected", wraps: true, text: (row) => remarks(row) || "-", value: rejections, style: (row) => (row.quarantined ? "bad" : "") },
];
const HOST_COLUMNS = [
  { name: "host", title: "Host", text: (row) => row.host },
  { name: "actors", title: "Actors", number: true, text: (row) => whole(row.actors), value: (row) => row.actors },
  { name: "absent", title: "Gone or quarantined", number: true, text: (row) => whole(row.absent), value: (row) => row.absent },
  { name: "rate", title: "env_steps/s", number: true, text: (row) => number(row.rate), value: (row) => row.rate },
  { name: "lag", title: "Highest lag", number: true, text: lagOf, value: (row) => row.policy_lag },
  { name: "rejected", title: "Rejected", number: true, text: (row) => whole(row.rejected), value: (row) => row.rejected },
];

const complete = (columns) => columns.map((column) => ({ value: (row) => column.text(row), ...column }));

export class Fleet {
  #actors = [];
  #extra = [];
  #count = 0;
  #updatesPerBatch = 1;
  #filter = byId("filter");
  #table = new Table("Actors", ["actor", 1]);
  #hosts = new Table("Hosts", ["actors", -1]);

  constructor() {
    this.#filter.oninput = () => this.#draw();
  }

  /** Show a message with all actors. */
  show({ columns, rows }) {
    this.#actors = rows.map((row) => {
      const actor = Object.fromEntries(columns.map((name, index) => [name, row[index]]));
      return { ...actor, state: stateOf(actor) };
    });
    const further = columns.filter((name) => !KNOWN.has(name) && this.#actors.some((actor) => isSet(actor[name])));
    this.#extra = further.map((name) => (name === "overridden_actions" ? HELPED : extraColumn(name, typeof this.#actors[0][name] === "number")));
    this.#draw();
  }

  /** Note how many actors the run has: the table may have fewer. */
  count(status) {
    this.#count = status === null ? 0 : status.actors_alive + status.actors_quarantined + status.actors_gone;
    this.#updatesPerBatch = status?.updates_per_batch ?? 1;
  }

  #draw() {
    const words = this.#filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    const matches = ({ actor, host, state, address, software }) => {
      const text = `${actor} ${host} ${state} ${address} ${software}`.toLowerCase();
      return words.every((word) => text.includes(word));
    };
    const chosen = this.#actors.filter(matches).map((actor) => ({ ...actor, updates_per_batch: this.#updatesPerBatch }));
    setText(byId("totals"), this.#totals(chosen, words.length > 0));
    byId("hosts").replaceChildren(...(this.#actors.length > MANY ? [this.#hosts.root] : []));
    if (this.#actors.length > MANY) this.#hosts.show(complete(HOST_COLUMNS), hostsOf(chosen));
    if (!byId("actors").children.length && this.#actors.length) byId("actors").append(this.#table.root);
    this.#table.show(complete([...COLUMNS, ...this.#extra]), chosen);
  }

  #totals(chosen, filtered) {
    if (!this.#actors.length) return "No actor has joined yet. Start one with: daedalus actor --connect ADDRESS";
    const alive = chosen.filter(({ state }) => state === "alive").length;
    const rate = sum(chosen.map((actor) => actor.env_steps_per_second));
    const share = filtered ? ` of ${counted(this.#actors.length, "actor")}` : "";
    const missing = this.#count - this.#actors.length;
    const rest = missing > 0 && this.#count > 2000 ? `; ${counted(missing, "more actor")} are not listed here` : "";
    return `${counted(chosen.length, "actor")}${share}: ${whole(alive)} alive, ${number(rate)} env_steps/s${rest}`;
  }
}

function hostsOf(actors) {
  const hosts = new Map();
  for (const actor of actors) {
    const name = actor.host || "unknown";
    const host = hosts.get(name) ?? { host: name, actors: 0, absent: 0, rate: 0, policy_lag: 0, updates_per_batch: actor.updates_per_batch, rejected: 0 };
    host.actors += 1;
    host.absent += actor.state === "alive" ? 0 : 1;
    host.rate += actor.env_steps_per_second;
    host.policy_lag = Math.max(host.policy_lag, actor.policy_lag);
    host.rejected += rejections(actor);
    hosts.set(name, host);
  }
  return [...hosts.values()];
}

function isSet(value) {
  return value !== null && value !== undefined && value !== "" && value !== 0 && value !== false;
}

function extraColumn(name, isNumber) {
  const title = TITLES[name] ?? name[0].toUpperCase() + name.slice(1).replaceAll("_", " ");
  const text = (row) => (typeof row[name] === "number" ? number(row[name]) : isSet(row[name]) ? String(row[name]) : "-");
  const value = (row) => (typeof row[name] === "number" ? row[name] : 0);
  return { name: `extra ${name}`, title, text, ...(isNumber ? { number: true, value } : { wraps: true }) };
}
