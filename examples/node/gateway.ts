/**
 * Client of `daedalus gateway`: queries, subscriptions and presence over one WebSocket. docs/wire.md specifies the
 * packets. This file does not know the messages in their payloads.
 */

const GREETING = Buffer.from("DBR1");
const HEADER_BYTES = 12;
const MAX_PAYLOAD_BYTES = 2 ** 30;
const CHUNK_BYTES = 2 ** 18; // of the stream of packets in one WebSocket message
const [QUERY, FOLLOW, ANNOUNCE, WATCH, ANSWER, END, NEWS, PRESENT, ABSENT, ERROR] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10];

/** The connection could not be opened, or has ended; the message states the reason. */
export class GatewayError extends Error {}

interface PendingQuery {
  answers: Buffer[];
  resolve: (answers: Buffer[]) => void;
  reject: (error: Error) => void;
}

/** One connection to a gateway. */
export class Gateway {
  readonly #socket: WebSocket;
  readonly #queries = new Map<number, PendingQuery>(); // this and the next two by packet number
  readonly #follows = new Map<number, (value: Buffer) => void>();
  readonly #watches = new Map<number, (key: string, present: boolean) => void>();
  #number = 0; // of the last packet sent
  #received: Buffer[] = []; // not parsed yet
  #receivedBytes = 0;
  #neededBytes = GREETING.length; // received bytes before which parsing cannot succeed
  #greeted = false;
  #failure?: GatewayError;

  /** Connect to a gateway as an actor of this name. Throws GatewayError if the connection cannot be opened. */
  static async open(host: string, port: number, name: string): Promise<Gateway> {
    const socket = new WebSocket(`ws://${host}:${port}/raw`);
    await new Promise<void>((resolve, reject) => {
      socket.onopen = () => resolve();
      socket.onerror = socket.onclose = () =>
        reject(new GatewayError(`cannot connect to the gateway at ${host}:${port}: is it running?`));
    });
    socket.send(JSON.stringify({ type: "hello", version: 1, name }));
    return new Gateway(socket);
  }

  private constructor(socket: WebSocket) {
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") this.#fail(JSON.parse(data).reason);
      else this.#onData(Buffer.from(data));
    };
    socket.onerror = () => this.#fail("the connection to the gateway failed");
    socket.onclose = () => this.#fail("the gateway closed the connection");
    this.#write(GREETING);
  }

  #write(bytes: Buffer): void {
    for (let first = 0; first < bytes.length; first += CHUNK_BYTES) {
      this.#socket.send(bytes.subarray(first, first + CHUNK_BYTES));
    }
  }

  /** Return every answer to a query that arrives within `seconds`. The list is empty if no process serves the key. */
  query(key: string, payload: Uint8Array = new Uint8Array(), seconds = 5): Promise<Buffer[]> {
    if (this.#failure) return Promise.reject(this.#failure);
    return new Promise((resolve, reject) => {
      this.#queries.set(this.#send(QUERY, key, payload, seconds), { answers: [], resolve, reject });
    });
  }

  /** Subscribe to a key: `onNews` receives the published values. A slow reader may receive only the newest. */
  follow(key: string, onNews: (value: Buffer) => void): void {
    this.#follows.set(this.#send(FOLLOW, key), onNews);
  }

  /** Declare presence under a key until the connection ends. */
  announce(key: string): void {
    this.#send(ANNOUNCE, key);
  }

  /** Watch presence under a key. `onChange` is called for each key that is present already, and for each change. */
  watch(key: string, onChange: (key: string, present: boolean) => void): void {
    this.#watches.set(this.#send(WATCH, key), onChange);
  }

  /** Close the connection. Its queries, subscriptions and presence end with it. */
  close(): void {
    this.#fail("the actor closed the connection");
  }

  /** Send one packet and return its number. */
  #send(kind: number, key: string, payload: Uint8Array = new Uint8Array(), seconds = 0): number {
    this.#number = (this.#number + 1) >>> 0;
    const header = Buffer.alloc(HEADER_BYTES);
    header.writeUInt32LE(payload.length, 0);
    header.writeUInt8(kind, 4);
    header.writeUInt8(key.length, 5);
    header.writeUInt16LE(Math.round(seconds * 1000), 6);
    header.writeUInt32LE(this.#number, 8);
    this.#write(Buffer.concat([header, Buffer.from(key, "ascii"), payload]));
    return this.#number;
  }

  #onData(data: Buffer): void {
    this.#received.push(data);
    this.#receivedBytes += data.length;
    while (!this.#failure && this.#receivedBytes >= this.#neededBytes) {
      // Concatenate only when a whole packet has arrived, so that a large packet is copied once.
      const bytes = this.#received.length === 1 ? this.#received[0] : Buffer.concat(this.#received);
      const used = this.#parse(bytes);
      this.#received = [bytes.subarray(used)];
      this.#receivedBytes = bytes.length - used;
    }
  }

  /** Process the greeting or packet at the start of `bytes`. Return its length, or 0 if it is incomplete. */
  #parse(bytes: Buffer): number {
    if (!this.#greeted) {
      if (!bytes.subarray(0, GREETING.length).equals(GREETING)) {
        this.#fail("the server at this address is no gateway of this protocol: check --gateway");
      }
      this.#greeted = true;
      this.#neededBytes = HEADER_BYTES;
      return GREETING.length;
    }
    const payloadBytes = bytes.readUInt32LE(0);
    const keyEnd = HEADER_BYTES + bytes.readUInt8(5);
    if (payloadBytes > MAX_PAYLOAD_BYTES) {
      this.#fail(`the gateway sent a payload of ${payloadBytes} bytes, the limit is ${MAX_PAYLOAD_BYTES}`);
    }
    this.#neededBytes = keyEnd + payloadBytes;
    if (bytes.length < this.#neededBytes) return 0;
    const used = this.#neededBytes;
    this.#neededBytes = HEADER_BYTES;
    const key = bytes.toString("ascii", HEADER_BYTES, keyEnd);
    this.#onPacket(bytes.readUInt8(4), bytes.readUInt32LE(8), key, bytes.subarray(keyEnd, used));
    return used;
  }

  #onPacket(kind: number, number: number, key: string, payload: Buffer): void {
    if (kind === ANSWER) this.#queries.get(number)?.answers.push(payload);
    else if (kind === NEWS) this.#follows.get(number)?.(payload);
    else if (kind === PRESENT || kind === ABSENT) this.#watches.get(number)?.(key, kind === PRESENT);
    else if (kind === ERROR) this.#fail(payload.toString());
    else if (kind === END) {
      const pending = this.#queries.get(number);
      this.#queries.delete(number);
      pending?.resolve(pending.answers);
    } else this.#fail(`the gateway sent a packet of unknown kind ${kind}`);
  }

  /** End the connection and reject all pending queries. Only the first call has an effect. */
  #fail(reason: string): void {
    if (this.#failure) return;
    this.#failure = new GatewayError(reason);
    this.#socket.close();
    for (const pending of this.#queries.values()) pending.reject(this.#failure);
    this.#queries.clear();
    this.onClosed?.(this.#failure);
  }

  /** Called once, when the connection has ended. */
  onClosed?: (reason: GatewayError) => void;
}
