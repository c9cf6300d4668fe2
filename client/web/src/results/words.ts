// Names and certainty of lights, and times, in words.

import type { LightRow, PlaceKind } from "./data";

export { horizontal, whence } from "../whence";

/** Name of a place at which light is told. */
export function placeName([kind, index]: readonly [PlaceKind, number], objects: readonly string[]): string {
  if (kind === "beyond") return "From beyond the scan";
  if (kind === "view") return "Middle of the view";
  if (kind === "place") return `Place ${index + 1}`;
  return objects[index] ?? `Object ${index + 1}`;
}

/** How well the direction is known. */
export function certainty({ spread, valid, seen }: LightRow): string {
  if (seen === 0) return "A guess: no scanned surface is seen from there";
  if (spread === null) return valid ? "Sure to 15° or better" : "Not known: the pictures do not fix the direction";
  return valid ? `Sure to about ${Math.round(spread)}°` : `Not sure: may be off by ${Math.round(spread)}°`;
}

/** 75 s as 1:15, with tenths of a second. */
export function clock(seconds: number): string {
  const whole = Math.max(0, seconds);
  const minutes = Math.floor(whole / 60);
  return `${minutes}:${(whole - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}
