// The page: watches a session, or captures one of its own, and shows what it produces.

import { reasonOf } from "./capture/source";
import { Capturing } from "./capturing";
import { type ConnectionState, streamUrl, tokenQuery } from "./connection";
import { byId, setText } from "./dom";
import { aimOf, type Choice, fill, missing, noteChoice, read } from "./form";
import { clearLatency, noteShown, showAges } from "./latency";
import { LayerMode } from "./layer_mode";
import { LightMode } from "./light_mode";
import { refreshLiveQuality, showLiveQuality } from "./live_quality";
import { closeParts } from "./local/layer_parts";
import { ObjectTools } from "./objects/tools";
import { Panels } from "./panels";
import { captionPicture, fitPicture, forgetPicture, markPicture, showPicture } from "./picture";
import type { Light, ServerMessage, Welcome } from "./protocol";
import { QualityChanges } from "./quality_changes";
import { Remote } from "./remote";
import { clearSending, noteSending, showSending } from "./sending";
import { stayAwake } from "./wake_lock";
import { WatchedView } from "./watched_view";
import { offerWaysIn, showCommand } from "./ways_in";
import type { News } from "./worker_messages";

const QUIET_AFTER_MS = 3000;
const REFRESH_MS = 250;

const page = new URL(location.href);
const stage = byId("stage");
const form = byId<HTMLFormElement>("capture-form");
const retry = byId<HTMLButtonElement>("retry");
const reload = byId<HTMLButtonElement>("reload");
const stopButton = byId<HTMLButtonElement>("stop");
const fullButton = byId<HTMLButtonElement>("full");

const panels = new Panels();
const remote = new Remote(receive, (reason) => fail(`This page cannot work in this browser: ${reason}`));
let lightMode: LightMode | null = null;
let layerMode: LayerMode | null = null;
const tools = new ObjectTools((asked) => remote.request(asked));
const qualityChanges = new QualityChanges(form, (asked) => remote.request(asked), (text) => {
  setText(byId("capture-said"), text);
  noteChoice(form);
});
const watchedView = new WatchedView();
let capturing: Capturing | null = null;
let connection: ConnectionState = { kind: "connecting" };
let retryAt_ms = 0;
let welcomes = 0;
let told = "";
/** What brings a picture of what is captured. */
let aim: string | null = null;
/** What a session must be like to be watched, in words. */
let watched = "";
/** Name of the session that is watched. */
let watchedSession = "";

function receive(message: News): void {
  switch (message.kind) {
    case "state":
      connection = message.state;
      if (connection.kind === "lost") retryAt_ms = performance.now() + connection.wait_ms;
      refresh();
      return;
    case "message":
      receiveServer(message.message);
      return;
    case "picture":
      showPicture(message.composite, message.bitmap);
      if (message.times !== null) noteShown(message.times, message.composite.timings);
      tools.show(capturing === null ? watchedView.seenIn(message.composite) : capturing.seenIn(message.composite.frame, message.composite.world_from_camera));
      return;
    case "layer":
      receiveLayer(message);
      return;
    case "say":
      panels.note(message.text);
      return;
    case "wanted":
      return; // the remote's own
    case "sending":
      noteSending(message.sending);
      return;
    default:
      message satisfies never;
  }
}

function receiveServer(message: ServerMessage): void {
  panels.receive(message);
  if (message.type === "acknowledged") {
    qualityChanges.acknowledge(message.request, message.error);
    const problem = tools.scene.acknowledge(message.request, message.error);
    if (problem !== null) tools.say(problem);
  }
  if (message.type === "welcome" && capturing !== null && ++welcomes > 1 && !message.resumed) beginAgain();
  if (message.type === "welcome" && capturing === null) beginWatching(message);
  if (message.type === "composite" || message.type === "layer") {
    told = "";
    for (const placed of message.placed ?? []) tools.scene.found(placed);
  }
  if (message.type === "light" && message.up) (capturing ?? watchedView).noteUp(message.up);
  if (message.type === "light" && lightMode !== null) receiveLight(message);
}

/** Another session is watched: what was placed in the last one is not in it. */
function beginWatching({ session, camera = null }: Welcome): void {
  watchedView.begin(camera);
  if (session === watchedSession) return;
  watchedSession = session;
  tools.clear();
  if (camera !== null) tools.begin();
}

/** The server was started anew, or another camera is used. */
function beginAgain(): void {
  tools.scene.placeAgain();
  panels.note("the session has begun anew: what had been scanned is gone unless the server keeps the room; objects are placed again");
}

/** In light mode a light is the answer to its frame. */
function receiveLight(light: Light): void {
  told = "";
  lightMode?.setLight(light);
  const seen = capturing?.seenIn(light.frame, null) ?? null;
  panels.noteAnswer(seen?.world_from_camera ?? null);
  if (seen !== null) fitPicture(seen.camera);
  tools.show(seen);
}

function receiveLayer({ layer, parts, times }: Extract<News, { kind: "layer" }>): void {
  const shot = capturing?.shotOf(layer.frame) ?? null;
  if (layerMode === null || shot === null) return closeParts(parts);
  fitPicture(shot.camera);
  captionPicture(layer);
  layerMode.setLayer(layer, { parts, lens: shot.camera, world_from_camera: shot.world_from_camera }, times);
  tools.show(capturing?.seenIn(layer.frame, layer.world_from_camera) ?? null);
}

/** The connection's state in a word for the eye and a sentence for everybody. */
function describe(now_ms: number): { kind: string; text: string } {
  switch (connection.kind) {
    case "connecting":
      return { kind: "busy", text: "Connecting…" };
    case "lost":
      return connection.isFull ? { kind: "busy", text: `Not let in yet: ${connection.reason}` } : { kind: "bad", text: `Disconnected: ${connection.reason}` };
    case "refused":
      return { kind: "bad", text: `Refused: ${connection.reason}` };
    case "open":
      if (panels.lastAnswer_ms === Number.NEGATIVE_INFINITY) return { kind: "busy", text: capturing ? "Connected, waiting for the first picture" : `Connected, waiting for a session${watched}` };
      if (now_ms - panels.lastAnswer_ms > QUIET_AFTER_MS) return { kind: "busy", text: "Connected, no new pictures" };
      return { kind: "good", text: capturing ? "Live, captured here" : "Live" };
  }
}

function refresh(): void {
  const now_ms = performance.now();
  panels.refresh(now_ms);
  showAges(layerMode?.ages ?? null);
  showSending(now_ms);
  const { kind, text } = describe(now_ms);
  setText(byId("state"), text);
  document.documentElement.dataset["state"] = kind;
  markPicture(kind === "good");
  stayAwake(kind === "good");
  refreshLiveQuality(form, capturing !== null);
  const waiting = connection.kind === "open" ? (aim ?? text) : text;
  setText(byId("stage-said"), told !== "" || capturing === null || kind === "good" ? told : waiting);
  retry.hidden = connection.kind !== "lost";
  reload.hidden = connection.kind !== "refused";
  const left_s = connection.kind === "lost" ? Math.max(0, Math.ceil((retryAt_ms - now_ms) / 1000)) : null;
  setText(byId("state-countdown"), left_s === null ? "" : `next try in ${left_s} s`);
}

/** What is said over the picture: what the source told last, else how the connection of a capture is. */
function say(text: string): void {
  told = text;
  refresh();
}

/** What a source tells is said for a moment and kept among the notes. */
function advise(text: string): void {
  panels.note(text);
  say(text);
}

function fail(text: string): void {
  setText(byId("capture-said"), text);
  say(text);
}

function watch(): void {
  const { room, key } = read(form);
  watched = room === "" ? "" : ` of room “${room}”${key === "" ? "; one with a key needs it in the form below" : " with that key"}`;
  begin();
  remote.watch(streamUrl(page), { type: "watch", session: page.searchParams.get("session"), room: room || null, room_key: key || null });
}

/** What was shown belongs to a session that is over. */
function begin(): void {
  welcomes = 0;
  watchedSession = "";
  panels.clear();
  clearLatency();
  clearSending();
  tools.clear();
}

async function capture(choice: Choice): Promise<void> {
  await endCapture();
  begin();
  try {
    const light = choice.answer === "light" ? await LightMode.load(() => tools.scene.placed, say) : null;
    const layers = choice.answer === "layer" ? new LayerMode() : null;
    const hooks = { say: (text: string, isEnd: boolean) => (isEnd ? void leave(text) : advise(text)), look: (pose: readonly number[]) => tools.look(pose) };
    const next = new Capturing(remote, hooks, layers ?? light);
    await next.start(choice, stage, streamUrl(page));
    qualityChanges.begin(choice);
    capturing = next;
    lightMode = light;
    layerMode = layers;
  } catch (error) {
    watch();
    return fail(reasonOf(error));
  }
  aim = aimOf(choice);
  stage.dataset["source"] = choice.source;
  tools.begin(capturing.objects);
  stage.classList.toggle("local", choice.source === "xr" && choice.answer !== "picture");
  stopButton.hidden = false;
  showFull(choice.source !== "recorded");
  stage.scrollIntoView({ block: "start" });
  refresh();
}

/** Back to watching. */
async function leave(reason: string): Promise<void> {
  await endCapture();
  forgetPicture();
  watch();
  fail(reason);
}

async function endCapture(): Promise<void> {
  const ended = capturing;
  layerMode?.stop();
  capturing = lightMode = layerMode = null;
  stage.classList.remove("local");
  delete stage.dataset["source"];
  stopButton.hidden = true;
  showFull(false);
  await ended?.stop();
  remote.stop("");
}

function showFull(isFull: boolean): void {
  stage.classList.toggle("full", isFull);
  fullButton.setAttribute("aria-pressed", String(isFull));
}

/** The whole screen where the browser gives it, else the whole page. */
async function toggleFull(): Promise<void> {
  const isFull = !stage.classList.contains("full");
  showFull(isFull);
  if (capturing !== null) return; // augmented reality has the screen already
  if (isFull) await stage.requestFullscreen?.().catch(() => undefined);
  else if (document.fullscreenElement !== null) await document.exitFullscreen();
}

function submit(): void {
  const choice = read(form);
  const lack = missing(choice);
  fail(lack ?? "");
  if (lack !== null) return;
  if (choice.source === "watch") {
    stage.scrollIntoView({ block: "start" });
    void endCapture().then(watch);
  } else void capture(choice);
}

function start(): void {
  showCommand(["probeless", "stream", "synthetic:table", "--server", page.origin + tokenQuery(page).replace("?", "/?")]);
  fill(form, page);
  noteChoice(form);
  showLiveQuality(form);
  offerWaysIn((choice) => void capture(choice));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    submit();
  });
  form.addEventListener("change", (event) => {
    noteChoice(form);
    const name = (event.target as HTMLInputElement).name;
    if (capturing !== null && (name === "preset" || name === "budget")) qualityChanges.change();
  });
  stopButton.addEventListener("click", () => void leave(""));
  fullButton.addEventListener("click", () => void toggleFull());
  document.addEventListener("fullscreenchange", () => {
    if (document.fullscreenElement === null && capturing === null) showFull(false);
  });
  retry.addEventListener("click", () => remote.retry());
  reload.addEventListener("click", () => location.reload());
  addEventListener("online", () => remote.retry());
  addEventListener("pagehide", () => remote.stop("the page was closed"));
  addEventListener("pageshow", (event) => {
    if (event.persisted) location.reload();
  });
  setInterval(refresh, REFRESH_MS);
  watch();
}

start();
