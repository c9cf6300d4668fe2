// The page: watches a session and shows what it produces.

import { Connection, type ConnectionState, streamUrl, tokenQuery } from "./connection";
import { byId, make, setText } from "./dom";
import { showLight } from "./light";
import { addNote, clearNotes, showNotes } from "./notes";
import { markPicture, showPicture } from "./picture";
import { showPlan } from "./plan";
import type { Composite, Light, ServerMessage } from "./protocol";
import { FrameRate } from "./rate";
import { addTimings, clearTimings, showTimings } from "./timings";

const QUIET_AFTER_MS = 3000;
const REFRESH_MS = 250;
/** The light changes slowly and is dear to draw on a phone. */
const LIGHT_MS = 100;

const state = byId("state");
const countdown = byId("state-countdown");
const retry = byId<HTMLButtonElement>("retry");
const reload = byId<HTMLButtonElement>("reload");
const rateText = byId("frame-rate");

const rate = new FrameRate();
let connection: ConnectionState = { kind: "connecting" };
let light: Light | null = null;
let composite: Composite | null = null;
let lastPicture_ms = Number.NEGATIVE_INFINITY;
let drawing = false;
let lightDue = false;
let lightShown_ms = Number.NEGATIVE_INFINITY;

function receive(message: ServerMessage): void {
  switch (message.type) {
    case "welcome":
      greet(message.session, message.server, message.device);
      return;
    case "light":
      light = message;
      lightDue = true;
      return;
    case "composite":
      receivePicture(message);
      return;
    case "dropped":
      addNote(`left out: ${message.reason}`, message.frame);
      break;
    case "error":
    case "bye":
      addNote(`the server says: ${message.reason}`, null);
      break;
    case "acknowledged":
    case "mesh_part":
      return;
    default:
      message satisfies never;
  }
  showNotes();
}

function greet(session: string, server: string, device: string): void {
  setText(byId("session"), session);
  setText(byId("server"), server);
  setText(byId("device"), device);
  rate.clear();
  clearTimings();
  clearNotes();
}

function receivePicture(message: Composite): void {
  composite = message;
  lastPicture_ms = performance.now();
  rate.add(lastPicture_ms);
  addTimings(message.timings);
  for (const note of message.notes) addNote(note, message.frame);
  showPicture(message).catch((error: unknown) => {
    addNote(`this picture cannot be shown: ${String(error)}`, message.frame);
    showNotes();
  });
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(draw);
}

function draw(): void {
  drawing = false;
  if (composite === null) return;
  showTimings(composite.timings);
  showPlan(composite.plan);
  showNotes();
  refresh();
}

function drawLight(now_ms: number): void {
  if (!lightDue || light === null || composite === null || now_ms - lightShown_ms < LIGHT_MS) return;
  lightDue = false;
  lightShown_ms = now_ms;
  showLight(light, composite.world_from_camera);
}

/** The connection's state in a word for the eye and a sentence for everybody. */
function describe(now_ms: number): { kind: string; text: string } {
  switch (connection.kind) {
    case "connecting":
      return { kind: "busy", text: "Connecting…" };
    case "lost":
      return { kind: "bad", text: `Disconnected: ${connection.reason}` };
    case "refused":
      return { kind: "bad", text: `Refused: ${connection.reason}` };
    case "open":
      if (composite === null) return { kind: "busy", text: "Connected, waiting for a session" };
      if (now_ms - lastPicture_ms > QUIET_AFTER_MS) return { kind: "busy", text: "Connected, no new pictures" };
      return { kind: "good", text: "Live" };
  }
}

function refresh(): void {
  const now_ms = performance.now();
  drawLight(now_ms);
  const { kind, text } = describe(now_ms);
  setText(state, text);
  document.documentElement.dataset["state"] = kind;
  markPicture(kind === "good");
  const fps = rate.value(now_ms);
  setText(rateText, fps === null ? "–" : fps.toFixed(1));
  retry.hidden = connection.kind !== "lost";
  reload.hidden = connection.kind !== "refused";
  const left_s = connection.kind === "lost" ? Math.max(0, Math.ceil((connection.retryAt_ms - now_ms) / 1000)) : null;
  setText(countdown, left_s === null ? "" : `next try in ${left_s} s`);
}

/** The command with which there is something to see; it breaks between words only. */
function showHint(words: readonly string[]): void {
  byId("hint").append(...words.flatMap((word) => [make("span", "", word), " "]));
}

function start(): void {
  const page = new URL(location.href);
  showHint(["probeless", "stream", "synthetic:table", "--server", page.origin + tokenQuery(page).replace("?", "/?")]);
  const live = new Connection(
    streamUrl(page),
    page.searchParams.get("session"),
    (next) => {
      connection = next;
      refresh();
    },
    receive,
  );
  retry.addEventListener("click", () => live.open());
  reload.addEventListener("click", () => location.reload());
  addEventListener("online", () => live.open());
  setInterval(refresh, REFRESH_MS);
  live.open();
}

start();
