// Notes about the input: each line once, with its count and last frame.

import { byId, make, setText } from "./dom";

const MOST = 30;
const list = byId("notes");
const NO_NEWS = "time of each stage, plan, notes";

interface Note {
  count: number;
  frame: number | null;
}

const notes = new Map<string, Note>();

/** Add a line; `frame` is the frame it refers to, or null. */
export function addNote(text: string, frame: number | null): void {
  const count = (notes.get(text)?.count ?? 0) + 1;
  notes.delete(text); // reinsert as the last entry
  notes.set(text, { count, frame });
  const oldest = notes.keys().next().value;
  if (notes.size > MOST && oldest !== undefined) notes.delete(oldest);
}

export function clearNotes(): void {
  notes.clear();
}

let shown = "";

export function showNotes(): void {
  const key = JSON.stringify([...notes]);
  if (key === shown) return;
  shown = key;
  list.replaceChildren(...[...notes].reverse().map(([text, note]) => describe(text, note)));
  setText(byId("details-news"), notes.size === 0 ? NO_NEWS : `${notes.size} ${notes.size === 1 ? "note" : "notes"}; ${NO_NEWS}`);
  if (notes.size === 0) list.append(make("li", "quiet", "Nothing was wrong with the input"));
}

function describe(text: string, { count, frame }: Note): HTMLLIElement {
  const item = make("li");
  item.append(make("span", "", text), make("span", "when", when(count, frame)));
  return item;
}

function when(count: number, frame: number | null): string {
  const last = frame === null ? "" : `frame ${frame}`;
  const times = count === 1 ? "" : `${count} times`;
  return [times, last].filter((part) => part !== "").join(", last ").replace(/^(\d+ times), last /, "$1, last in ");
}
