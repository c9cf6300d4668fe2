// What a person asks for: from the page's address or the form.

import type { Marker, Wishes } from "./protocol";
import type { Setup } from "./session";

export type SourceName = "watch" | "xr" | "camera" | "recorded";

export interface Choice {
  source: SourceName;
  room: string;
  key: string;
  marker: number | null;
  side_cm: number;
  view_deg: number;
  preset: NonNullable<Wishes["preset"]>;
  budget_ms: number;
  /** Who draws the objects: the server into the picture, or to go over the newest one; or this device in the light that the server finds. */
  answer: NonNullable<Wishes["answer"]>;
  /** How the camera's colour goes over the wire. */
  color: "jpeg" | "h264";
  /** Quality, size and rate follow the link. */
  adapts: boolean;
  /** Of a recorded sequence. */
  file: File | null;
  loops: boolean;
}

const SOURCES: readonly SourceName[] = ["watch", "xr", "camera", "recorded"];
/** Besides pictures: the page itself must see the camera's picture and know where it is. */
const ANSWERS: Readonly<Record<string, readonly Choice["answer"][]>> = { xr: ["layer", "light"], recorded: ["layer"] };
/** For which the server keeps the session of a connection that is lost, as client/client.py has it. */
export const KEEP_S = 30;

/** Fill the form with what the address says: `?room=kitchen&key=...&source=xr`. */
export function fill(form: HTMLFormElement, page: URL): void {
  for (const name of ["room", "key", "marker", "side", "view", "preset", "budget", "answer", "color", "adapt", "repeat"]) {
    const value = page.searchParams.get(name);
    const field = form.elements.namedItem(name);
    if (value !== null && (field instanceof HTMLInputElement || field instanceof HTMLSelectElement)) field.value = value;
  }
  const source = SOURCES.find((name) => name === page.searchParams.get("source"));
  if (source !== undefined) (form.elements.namedItem("source") as RadioNodeList).value = source;
}

export function read(form: HTMLFormElement): Choice {
  const data = new FormData(form);
  const text = (name: string): string => String(data.get(name) ?? "").trim();
  const file = data.get("recording");
  return {
    source: SOURCES.find((name) => name === text("source")) ?? "watch",
    room: text("room"),
    key: text("key"),
    marker: text("marker") === "" ? null : Number(text("marker")),
    side_cm: Number(text("side")),
    view_deg: Number(text("view")),
    preset: text("preset") as Choice["preset"],
    budget_ms: Number(text("budget")),
    answer: ANSWERS[text("source")]?.find((each) => each === text("answer")) ?? "picture",
    file: file instanceof File && file.name !== "" ? file : null,
    color: text("color") === "h264" ? "h264" : "jpeg",
    adapts: text("adapt") !== "no",
    loops: text("repeat") !== "once",
  };
}

/** What is missing before a session can begin, in one sentence; null: nothing. */
export function missing(choice: Choice): string | null {
  if (choice.key !== "" && choice.room === "") return "A key is of a room: name the room too.";
  if (choice.source === "recorded" && choice.file === null) return "Choose the recording: a file that probeless stream SOURCE --record FILE has made.";
  if (choice.source !== "camera") return null;
  if (choice.room === "") return "A plain camera sees no depth and does not know where it is: name a room that somebody else scans.";
  if (choice.marker === null) return "Say which marker both cameras see: only by it is known where a plain camera is in the room.";
  return null;
}

/** What a person is to do until the server knows where the camera is; null: nothing. */
export function aimOf({ source, room, marker }: Choice): string | null {
  return source === "camera" ? `Point the camera at marker ${marker}. A camera with depth in room “${room}” must have seen it, too.` : null;
}

/** How the light is sampled. */
export function quality({ preset, budget_ms }: Choice): Pick<Wishes, "preset" | "budget_ms"> {
  return preset === "auto" ? { preset, budget_ms } : { preset, budget_ms: null };
}

/** Show the fields of what is chosen. */
export function noteChoice(form: HTMLFormElement): void {
  const { source, preset } = read(form);
  offerLight(form, source !== "recorded");
  form.dataset["source"] = source;
  form.dataset["preset"] = preset;
}

/** Whether objects may be drawn here in the light that is fetched: only over what a WebXR session shows. */
function offerLight(form: HTMLFormElement, isOffered: boolean): void {
  const answer = form.elements.namedItem("answer") as HTMLSelectElement;
  const light = answer.querySelector<HTMLOptionElement>('[value="light"]')!;
  light.hidden = light.disabled = !isOffered;
  if (!isOffered && answer.value === "light") answer.value = "picture";
}

/** Let the form say it. */
export function putQuality(form: HTMLFormElement, { preset, budget_ms }: Choice): void {
  (form.elements.namedItem("preset") as HTMLSelectElement).value = preset;
  (form.elements.namedItem("budget") as HTMLInputElement).value = String(budget_ms);
}

/** The hello of a choice, but for the camera. */
export function setupOf(choice: Choice): Setup {
  const marker: Marker | null = choice.marker === null ? null : { id: choice.marker, side_m: choice.side_cm / 100 };
  const up: Pick<Wishes, "up"> = choice.source === "xr" ? { up: [0, 1, 0] } : {};
  return {
    client: "probeless page",
    wishes: { ...quality(choice), ...up, answer: choice.answer },
    room: choice.room || null,
    room_key: choice.key || null,
    marker: choice.room === "" ? null : marker,
    keep_s: KEEP_S,
  };
}
