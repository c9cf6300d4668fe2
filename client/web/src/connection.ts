// The socket to the server, which reconnects automatically. It does not know the messages.

import { decodeServer, encode } from "./messages";
import { type ClientMessage, type ServerMessage, SUBPROTOCOL } from "./protocol";

export type ConnectionState =
  | { kind: "connecting" }
  | { kind: "open" }
  /** `isFull`: the server is running but has no place now. */
  | { kind: "lost"; reason: string; wait_ms: number; isFull: boolean }
  | { kind: "refused"; reason: string };

/** Shortest and longest pause between attempts to connect. */
export interface Pauses {
  first_ms: number;
  longest_ms: number;
}

/** For watchers, and for sessions that the server keeps for a limited time. */
export const WATCHING: Pauses = { first_ms: 500, longest_ms: 15_000 };
export const CAPTURING: Pauses = { first_ms: 100, longest_ms: 2_000 };

/** A connection that lasted this long was a good one: the pauses start from the shortest again. */
const GOOD_AFTER_MS = 10_000;
const [LOST, VERSION, TRY_LATER] = [1006, 1002, 1013] as const;
/** Wrong version, no token or a wrong one, a page of elsewhere: trying again would change nothing. */
const REFUSED: readonly number[] = [VERSION, 4401, 4403];
/** What is wished cannot be had; a session that was to be watched may come yet. */
export const POLICY = 1008;

/** Pause before attempt number `attempt` (1, 2, ...): doubling, with up to a quarter less so that pages spread out. */
export function pause_ms(attempt: number, random: () => number = Math.random, pauses: Pauses = WATCHING): number {
  const full = Math.min(pauses.longest_ms, pauses.first_ms * 2 ** (attempt - 1));
  return full * (1 - random() / 4);
}

/** What is used of a URL. */
export interface Address {
  readonly protocol: string;
  readonly host: string;
  readonly searchParams: { get(name: string): string | null };
}

/** `ws(s)` URL of the stream on the host the page came from, with the token that the page was opened with. */
export function streamUrl(page: Address): string {
  return `${page.protocol === "https:" ? "wss" : "ws"}://${page.host}/v1/stream${tokenQuery(page)}`;
}

/** `?token=...` as the page's own URL has it, or nothing. */
export function tokenQuery(page: Address): string {
  const token = page.searchParams.get("token");
  return token === null ? "" : `?token=${encodeURIComponent(token)}`;
}

export interface Hooks {
  /** The first message of each connection. */
  greeting(): ClientMessage;
  onState(state: ConnectionState): void;
  onMessage(message: ServerMessage): void;
  /** Before it is tried again; `code` as of the socket. */
  onClosed?(code: number): void;
}

export class Connection {
  private socket: WebSocket | null = null;
  private attempts = 0;
  private opened_ms = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private hasStopped = false;

  constructor(
    private readonly url: string,
    private readonly hooks: Hooks,
    private readonly pauses: Pauses = WATCHING,
    private readonly refused: readonly number[] = REFUSED,
  ) {}

  /** Connect now, unless a connection is open or being opened. */
  open(): void {
    if (this.socket !== null || this.hasStopped) return;
    clearTimeout(this.timer);
    this.hooks.onState({ kind: "connecting" });
    const socket = new WebSocket(this.url, SUBPROTOCOL);
    this.socket = socket;
    this.opened_ms = performance.now();
    socket.binaryType = "arraybuffer";
    socket.onopen = () => socket.send(encode(this.hooks.greeting()));
    socket.onmessage = (event: MessageEvent<unknown>) => this.receive(socket, event.data);
    socket.onclose = (event) => this.closed(event);
  }

  /** Send, if there is a connection; whether there was. */
  send(message: ClientMessage): boolean {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(encode(message));
    return true;
  }

  /** Leave, and try no more. */
  stop(reason = ""): void {
    this.hasStopped = true;
    clearTimeout(this.timer);
    const { socket } = this;
    if (socket === null) return;
    this.send({ type: "bye", reason });
    socket.onmessage = socket.onclose = null;
    socket.close(1000, "");
    this.socket = null;
  }

  private receive(socket: WebSocket, data: unknown): void {
    let message: ServerMessage;
    try {
      if (!(data instanceof ArrayBuffer)) throw new Error("not a binary message");
      message = decodeServer(data);
    } catch (error) {
      socket.close(4000, "unreadable message");
      console.error("unreadable message", error);
      return;
    }
    if (message.type === "welcome") this.hooks.onState({ kind: "open" });
    this.hooks.onMessage(message);
  }

  private closed(event: CloseEvent): void {
    this.socket = null;
    const reason = reasonFor(event);
    this.hooks.onClosed?.(event.code);
    if (this.refused.includes(event.code)) {
      this.hooks.onState({ kind: "refused", reason });
      return;
    }
    if (performance.now() - this.opened_ms > GOOD_AFTER_MS) this.attempts = 0;
    const wait_ms = pause_ms(++this.attempts, Math.random, this.pauses);
    this.timer = setTimeout(() => this.open(), wait_ms);
    this.hooks.onState({ kind: "lost", reason, wait_ms, isFull: event.code === TRY_LATER });
  }
}

/** What the server said, or what is known without it, and what to do. */
function reasonFor({ code, reason }: CloseEvent): string {
  if (code === LOST) return "the server does not answer; see that it runs (probeless serve) and that the network does";
  if (code === VERSION && reason !== "") return `${reason}; reload this page`;
  return reason || "the server closed the connection and did not say why";
}

/** Of a client that captures. */
export const REFUSED_CAPTURE: readonly number[] = [...REFUSED, POLICY];
