// The socket to the server: watches, and comes back by itself when it is lost.

import { decodeServer, encode } from "./messages";
import { type ServerMessage, SUBPROTOCOL } from "./protocol";

export type ConnectionState =
  | { kind: "connecting" }
  | { kind: "open" }
  | { kind: "lost"; reason: string; retryAt_ms: number }
  | { kind: "refused"; reason: string };

const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 15_000;
/** A connection that lasted this long was a good one: the pauses start from the shortest again. */
const GOOD_AFTER_MS = 10_000;
/** Wrong version, no token or a wrong one, a page of elsewhere: trying again would change nothing. */
const REFUSED: readonly number[] = [1002, 4401, 4403];

/** Pause before attempt number `attempt` (1, 2, ...): doubling, with up to a quarter less so that pages spread out. */
export function pause_ms(attempt: number, random: () => number = Math.random): number {
  const full = Math.min(LONGEST_PAUSE_MS, FIRST_PAUSE_MS * 2 ** (attempt - 1));
  return full * (1 - random() / 4);
}

/** `ws(s)` URL of the stream on the host the page came from, with the token that the page was opened with. */
export function streamUrl(page: URL): string {
  return `${page.protocol === "https:" ? "wss" : "ws"}://${page.host}/v1/stream${tokenQuery(page)}`;
}

/** `?token=...` as the page's own URL has it, or nothing. */
export function tokenQuery(page: URL): string {
  const token = page.searchParams.get("token");
  return token === null ? "" : `?token=${encodeURIComponent(token)}`;
}

export class Connection {
  private socket: WebSocket | null = null;
  private attempts = 0;
  private opened_ms = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;

  /** `session`: the one to watch; null for whichever is streaming. */
  constructor(
    private readonly url: string,
    private readonly session: string | null,
    private readonly onState: (state: ConnectionState) => void,
    private readonly onMessage: (message: ServerMessage) => void,
  ) {}

  /** Connect now, unless a connection is open or being opened. */
  open(): void {
    if (this.socket !== null) return;
    clearTimeout(this.timer);
    this.onState({ kind: "connecting" });
    const socket = new WebSocket(this.url, SUBPROTOCOL);
    this.socket = socket;
    this.opened_ms = performance.now();
    socket.binaryType = "arraybuffer";
    socket.onopen = () => socket.send(encode({ type: "watch", session: this.session }));
    socket.onmessage = (event: MessageEvent<unknown>) => this.receive(socket, event.data);
    socket.onclose = (event) => this.closed(event);
  }

  /** Try no more by itself. */
  stop(): void {
    clearTimeout(this.timer);
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
    if (message.type === "welcome") this.onState({ kind: "open" });
    this.onMessage(message);
  }

  private closed(event: CloseEvent): void {
    this.socket = null;
    const reason = event.reason || (event.code === 1006 ? "the server does not answer" : "the server closed the connection");
    if (REFUSED.includes(event.code)) {
      this.onState({ kind: "refused", reason });
      return;
    }
    if (performance.now() - this.opened_ms > GOOD_AFTER_MS) this.attempts = 0;
    const wait_ms = pause_ms(++this.attempts);
    this.timer = setTimeout(() => this.open(), wait_ms);
    this.onState({ kind: "lost", reason, retryAt_ms: performance.now() + wait_ms });
  }
}
