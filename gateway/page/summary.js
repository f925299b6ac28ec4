// The run in a few figures, and how it is.

import { byId, element, setText } from "./dom.js";
import { counted, duration, number, percent, policyLag, whole } from "./format.js";

const STATES = {
  connecting: "connecting to the network",
  forbidden: "the status may not be read",
  waiting: "waiting for a learner",
  running: "running",
  lost: "the learner does not answer",
  stopped: "stopped",
  ended: "ended",
  closed: "the gateway does not answer",
};
const EXPLANATIONS = {
  connecting: "The gateway has not reached its network yet. This page shows the run as soon as it does.",
  waiting: "No learner has answered yet. This page shows the run as soon as there is one.",
  lost: "The learner does not answer. The figures are the last ones.",
  closed: "The gateway does not answer. The figures are the last ones; this page connects again by itself.",
};

const OVER = new Set(["ended", "stopped"]);

export class Summary {
  #seen = { state: "connecting", reason: "", ends: [], status: null };
  #isLost = false; // whether the gateway is gone
  #tiles = new Map();

  takesClients = false; // whether /play may take part
  playsMatches = false; // whether persons may play against the policy

  constructor(metrics) {
    this.metrics = metrics;
  }

  /** Show a message about the run. */
  show(message) {
    this.#seen = message;
    this.#isLost = false;
    const { state, status } = message;
    byId("state").dataset.state = state;
    setText(byId("state"), STATES[state]);
    this.#notice(message);
    if (status === null) return;
    setText(byId("run"), status.run);
    setText(byId("what"), `${status.environment}, ${status.algorithm}`);
    const plays = /^CartPole-v[01]$/.test(status.environment) && !OVER.has(state);
    byId("play").hidden = !plays || !this.takesClients;
    byId("match").hidden = status.agent_steps === null || !this.playsMatches; // null: no game with several agents
    this.#progress(status);
    setText(byId("bottleneck"), state === "running" ? status.bottleneck : "");
    this.tiles();
    document.title = `${status.run}: ${number(this.metrics.newest("rating") ?? status.episode_return_mean)} - Daedalus`;
  }

  /** Show that the gateway is gone, with the last figures. */
  lost(reason) {
    if (!OVER.has(this.#seen.state)) return this.show({ ...this.#seen, state: "closed", reason });
    this.#isLost = true;
    this.#notice(this.#seen);
  }

  #notice({ state, reason, ends, status }) {
    const notices = [];
    const why = reason && `: ${reason}`;
    if (state === "ended") notices.push(["notice good", `The run has ended${why}. ${this.#result(status)}`]);
    else if (state === "stopped") notices.push(["notice", `The run was stopped${why}. ${this.#result(status)}`]);
    else if (EXPLANATIONS[state]) notices.push(["notice", EXPLANATIONS[state] + (reason ? ` (${reason})` : "")]);
    else if (reason) notices.push(["notice", reason]);
    if (state === "running") for (const problem of status?.problems ?? []) notices.push(["notice", `Problem: ${problem}`]);
    if (OVER.has(state)) notices.push(...ends.map((line) => ["notice", line]));
    if (this.#isLost) notices.push(["notice", "The gateway has ended, too: this page keeps what it shows, until you close it."]);
    const shown = [...byId("notices").children].map((child) => child.textContent).join("\n");
    if (shown === notices.map(([, text]) => text).join("\n")) return; // a screen reader hears each notice once
    byId("notices").replaceChildren(...notices.map(([style, text]) => element("p", { class: style }, text)));
  }

  #result(status) {
    if (status === null) return "";
    const rating = this.metrics.newest("rating");
    const strength = rating === null ? `return ${number(status.episode_return_mean)}` : `rating ${whole(rating)}`;
    return `Result: ${strength} after ${whole(status.env_steps)} env_steps and ${whole(status.updates)} updates.`;
  }

  #progress(status) {
    const share = status.env_steps_budget ? Math.min(status.env_steps / status.env_steps_budget, 1) : 0;
    byId("budget").value = share;
    const left = (status.env_steps_budget - status.env_steps) / status.env_steps_per_second;
    const rest = this.#seen.state === "running" && Number.isFinite(left) && left > 0 ? `, about ${duration(left)} left` : "";
    const text = `${whole(status.env_steps)} of ${whole(status.env_steps_budget)} env_steps (${percent(share)})${rest}`;
    setText(byId("progress-text"), text);
  }

  /** Show the figures; those of the metrics may have come after the status. */
  tiles() {
    const { status } = this.#seen;
    if (status === null) return;
    const metrics = this.metrics;
    const deviation = metrics.newest("episode_return_std");
    const evaluated = metrics.newest("evaluation_env_steps");
    const saved = status.checkpoint_age_seconds;
    const rating = metrics.newest("rating");
    if (rating !== null) this.#tile("Rating", whole(rating), `± ${whole(metrics.newest("rating_deviation"))}, of the newest policy`);
    this.#tile("Return", number(status.episode_return_mean), deviation === null ? "no episode yet" : `± ${number(deviation)} between episodes`);
    this.#tile(
      "Evaluation",
      number(metrics.newest("evaluation_return_mean")),
      evaluated === null ? "none yet" : `± ${number(metrics.newest("evaluation_return_std"))} at ${number(evaluated)} env_steps`,
    );
    for (const [name, text] of Object.entries(status.lessons)) {
      this.#tile(`Lesson ${name}`, number(metrics.newest(`lesson/${name}`)), `now ${text}`);
    }
    this.#tile("env_steps/s", number(status.env_steps_per_second), `${number(status.updates_per_second)} updates/s`);
    const [lag, inUpdates] = policyLag(status.policy_lag_mean, status.updates_per_batch);
    this.#tile("Policy lag", lag, `${inUpdates ? `${inUpdates}, ` : ""}mean of the newest batches`);
    const absent = [[status.actors_quarantined, "quarantined"], [status.actors_gone, "gone"]];
    const others = absent.filter(([count]) => count).map(([count, what]) => `${whole(count)} ${what}`);
    if (status.memory_bytes) this.#tile("Learner", `${number(status.memory_bytes / 1e6)} MB`, `${percent(status.processor_share)} of a processor`);
    this.#tile("Actors", whole(status.actors_alive), others.join(", ") || "none gone");
    this.#tile("Running for", duration(status.uptime_seconds), saved === null ? "no checkpoint yet" : `checkpoint ${duration(saved)} ago`);
    const rejected = Object.values(status.rollouts_rejected).reduce((sum, count) => sum + count, 0);
    this.#tile("Rollouts", number(status.rollouts_accepted), rejected ? `${counted(rejected, "rejection")}` : "none rejected");
  }

  #tile(title, value, more) {
    if (!this.#tiles.has(title)) {
      const parts = [element("dd", { class: "value" }), element("dd", { class: "more" })];
      const place = title === "Rating" ? "prepend" : "append"; // it may come after the others, and says most
      byId("tiles")[place](element("div", { class: "tile" }, element("dt", {}, title), ...parts));
      this.#tiles.set(title, parts);
    }
    const [large, small] = this.#tiles.get(title);
    setText(large, value);
    setText(small, more);
  }
}
