/** Rollouts that were collected and not yet answered for good. Sending twice is safe: the learner takes each once. */

import { setTimeout as sleep } from "node:timers/promises";

const BUSY_MILLISECONDS = 5; // first wait after a busy answer; doubles
const LOST_MILLISECONDS = 100; // first wait after no answer at all; doubles
const MAX_WAIT_MILLISECONDS = 500;

export interface Acknowledgement {
  verdict: "accepted" | "busy" | "rejected" | "fenced" | "quarantined" | "finished";
  reason: string;
  policy_version: number; // the newest
}

export class Uploader {
  readonly learnerEpoch: number | bigint;
  readonly pending = new Map<number, Uint8Array>(); // by sequence number
  readonly #window: number;
  #sequence = 0;

  constructor(learnerEpoch: number | bigint, window: number) {
    this.learnerEpoch = learnerEpoch;
    this.#window = window;
  }

  /** Whether one more may be played, and then sent. */
  get hasRoom(): boolean {
    return this.pending.size < this.#window;
  }

  /** The sequence number of the next rollout. */
  next(): number {
    return this.#sequence++;
  }

  /** Sends one until it is answered for good; `send` may come back without an answer. */
  async deliver(
    sequence: number,
    send: (rollout: Uint8Array) => Promise<Acknowledgement | undefined>,
  ): Promise<Acknowledgement> {
    for (let attempt = 0; ; attempt++) {
      const answer = await send(this.pending.get(sequence)!);
      if (answer && answer.verdict !== "busy") {
        this.pending.delete(sequence);
        return answer;
      }
      const first = answer ? BUSY_MILLISECONDS : LOST_MILLISECONDS;
      await sleep(Math.min(first * 2 ** Math.min(attempt, 10), MAX_WAIT_MILLISECONDS));
    }
  }
}
