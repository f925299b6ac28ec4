/** Rollouts without a final acknowledgement. They may be sent twice: the learner applies each at most once. */

import { setTimeout as sleep } from "node:timers/promises";

const BUSY_MILLISECONDS = 5; // delay after the first `busy` answer; doubles
const NO_ANSWER_MILLISECONDS = 100; // delay after the first attempt without an answer; doubles
const MAX_DELAY_MILLISECONDS = 500;

export interface Acknowledgement {
  verdict: "accepted" | "busy" | "rejected" | "fenced" | "quarantined" | "finished" | "drained";
  reason: string;
  policy_version: number; // the newest published version
}

/** Rollouts in flight and the next sequence number, for one learner epoch. */
export class Uploader {
  readonly learnerEpoch: number | bigint;
  readonly pending = new Map<number, Uint8Array>(); // encoded rollouts by sequence number
  readonly #window: number; // most rollouts in flight
  #sequence = 0; // of the next rollout

  constructor(learnerEpoch: number | bigint, window: number) {
    this.learnerEpoch = learnerEpoch;
    this.#window = window;
  }

  /** Whether one more rollout may be collected and sent. */
  get hasRoom(): boolean {
    return this.pending.size < this.#window;
  }

  /** Return the sequence number of the next rollout, and advance it. */
  nextSequence(): number {
    return this.#sequence++;
  }

  /** Send a pending rollout until its final acknowledgement, and return it. `send` returns undefined if none came. */
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
      const first = answer ? BUSY_MILLISECONDS : NO_ANSWER_MILLISECONDS;
      await sleep(Math.min(first * 2 ** Math.min(attempt, 10), MAX_DELAY_MILLISECONDS));
    }
  }
}
