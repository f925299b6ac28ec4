/**
 * The client's end of `daedalus bridge`: queries, followed keys and presence over one TCP connection, as docs/wire.md
 * has them. This file knows no message.
 */

import { connect, type Socket } from "node:net";

const GREETING = Buffer.from("DBR1");
const HEADER_BYTES = 12;
const MAX_PAYLOAD_BYTES = 2 ** 30;
const [QUERY, FOLLOW, ANNOUNCE, WATCH, ANSWER, END, NEWS, PRESENT, ABSENT, ERROR] = Array.from({ length: 10 }, (_, i) => i + 1);

/** The connection is no more, or could not be made; the message says why. */
export class BridgeError extends Error {}

interface Question {
  answers: Buffer[];
  resolve: (answers: Buffer[]) => void;
  reject: (error: Error) => void;
}

export class Bridge {
  readonly #socket: Socket;
  readonly #questions = new Map<number, Question>();
  readonly #follows = new Map<number, (value: Buffer) => void>();
  readonly #watches = new Map<number, (key: string, present: boolean) => void>();
  #number = 0;
  #received: Buffer[] = [];
  #receivedBytes = 0;
  #awaitedBytes = GREETING.length; // no use to look before so many are there
  #greeted = false;
  #failure?: BridgeError;

  /** Connects to a bridge; throws BridgeError if none is there. */
  static async open(host: string, port: number): Promise<Bridge> {
    const socket = connect({ host, port, noDelay: true });
    await new Promise<void>((resolve, reject) => {
      socket.once("connect", resolve);
      socket.once("error", (error) => reject(new BridgeError(`no bridge at ${host}:${port}: ${error.message}`)));
    });
    return new Bridge(socket);
  }

  private constructor(socket: Socket) {
    this.#socket = socket;
    socket.removeAllListeners("error");
    socket.on("data", (data) => this.#onData(data));
    socket.on("error", (error) => this.#fail(error.message));
    socket.on("close", () => this.#fail("the bridge closed the connection"));
    socket.write(GREETING);
  }

  /** Every answer to a query within `seconds`; none if nobody serves the key. */
  ask(key: string, payload: Uint8Array = new Uint8Array(), seconds = 5): Promise<Buffer[]> {
    if (this.#failure) return Promise.reject(this.#failure);
    return new Promise((resolve, reject) => {
      this.#questions.set(this.#send(QUERY, key, payload, seconds), { answers: [], resolve, reject });
    });
  }

  /** Calls `onNews` with what is published under a key; the newest only, where it comes faster than it is taken. */
  follow(key: string, onNews: (value: Buffer) => void): void {
    this.#follows.set(this.#send(FOLLOW, key), onNews);
  }

  /** Is present under a key for as long as the connection lasts. */
  announce(key: string): void {
    this.#send(ANNOUNCE, key);
  }

  /** Calls `onChange` for all who are present under a key, and whenever somebody comes or goes. */
  watch(key: string, onChange: (key: string, present: boolean) => void): void {
    this.#watches.set(this.#send(WATCH, key), onChange);
  }

  /** Ends the connection, and all that was declared over it. */
  close(): void {
    this.#fail("closed");
  }

  #send(kind: number, key: string, payload: Uint8Array = new Uint8Array(), seconds = 0): number {
    this.#number = (this.#number + 1) >>> 0;
    const header = Buffer.alloc(HEADER_BYTES);
    header.writeUInt32LE(payload.length, 0);
    header.writeUInt8(kind, 4);
    header.writeUInt8(key.length, 5);
    header.writeUInt16LE(Math.round(seconds * 1000), 6);
    header.writeUInt32LE(this.#number, 8);
    this.#socket.write(Buffer.concat([header, Buffer.from(key, "ascii"), payload]));
    return this.#number;
  }

  #onData(data: Buffer): void {
    this.#received.push(data);
    this.#receivedBytes += data.length;
    while (!this.#failure && this.#receivedBytes >= this.#awaitedBytes) {
      // Joined only when a whole packet is there, so a large one is copied once.
      const bytes = this.#received.length === 1 ? this.#received[0] : Buffer.concat(this.#received);
      const used = this.#take(bytes);
      this.#received = [bytes.subarray(used)];
      this.#receivedBytes = bytes.length - used;
    }
  }

  /** Takes what stands at the start of `bytes` if it is whole; how many bytes that were. */
  #take(bytes: Buffer): number {
    if (!this.#greeted) {
      if (!bytes.subarray(0, GREETING.length).equals(GREETING)) this.#fail("no bridge of ours answers there");
      this.#greeted = true;
      this.#awaitedBytes = HEADER_BYTES;
      return GREETING.length;
    }
    const payloadBytes = bytes.readUInt32LE(0);
    const keyEnd = HEADER_BYTES + bytes.readUInt8(5);
    if (payloadBytes > MAX_PAYLOAD_BYTES) this.#fail(`a payload of ${payloadBytes} bytes`);
    this.#awaitedBytes = keyEnd + payloadBytes;
    if (bytes.length < this.#awaitedBytes) return 0;
    const used = this.#awaitedBytes;
    this.#awaitedBytes = HEADER_BYTES;
    const key = bytes.toString("ascii", HEADER_BYTES, keyEnd);
    this.#onParcel(bytes.readUInt8(4), bytes.readUInt32LE(8), key, bytes.subarray(keyEnd, used));
    return used;
  }

  #onParcel(kind: number, number: number, key: string, payload: Buffer): void {
    if (kind === ANSWER) this.#questions.get(number)?.answers.push(payload);
    else if (kind === NEWS) this.#follows.get(number)?.(payload);
    else if (kind === PRESENT || kind === ABSENT) this.#watches.get(number)?.(key, kind === PRESENT);
    else if (kind === ERROR) this.#fail(payload.toString());
    else if (kind === END) {
      const question = this.#questions.get(number);
      this.#questions.delete(number);
      question?.resolve(question.answers);
    } else this.#fail(`a packet of kind ${kind}`);
  }

  #fail(reason: string): void {
    if (this.#failure) return;
    this.#failure = new BridgeError(reason);
    this.#socket.destroy();
    for (const question of this.#questions.values()) question.reject(this.#failure);
    this.#questions.clear();
    this.onClosed?.(this.#failure);
  }

  /** Called once, when the connection has ended. */
  onClosed?: (reason: BridgeError) => void;
}
