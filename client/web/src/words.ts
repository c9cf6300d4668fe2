// Formats numbers and names of the protocol as text.

import type { Sending } from "./capture/encode";
import type { OperatingPoint } from "./protocol";
import type { Vector3 } from "./sh";

const degrees = (rad: number): number => Math.round((rad * 180) / Math.PI);

/** A direction towards the light in camera axes (x right, y down, z forward), in words. */
export function describeDirection([x, y, z]: Vector3): string {
  if (Math.hypot(x, y, z) < 1e-6) return "none";
  const right = degrees(Math.atan2(x, Math.abs(z)));
  const up = degrees(Math.asin(Math.max(-1, Math.min(1, -y))));
  const parts = [angle(right, "right", "left"), angle(up, "up", "down")].filter((part) => part !== "");
  const side = z > 0 ? "from ahead" : "from behind the camera";
  return [side, ...parts].join(", ");
}

function angle(value: number, positive: string, negative: string): string {
  return value === 0 ? "" : `${Math.abs(value)}° ${value > 0 ? positive : negative}`;
}

/** The error bound of an effect that was left out; `bound` is in display units, 1 is 1/255. */
export function describeBound(bound: number | null): string {
  if (bound === null) return "no bound is known";
  if (bound === 0) return "changes nothing";
  const most = `at most ${number(bound)}/255`;
  if (bound < 0.5) return `invisible: ${most}`;
  return bound <= 3 ? `hardly visible: ${most}` : `may be visible: ${most}`;
}

/** The sampling of a frame and the reason. */
export function describePoint(point: OperatingPoint | null): string {
  if (point === null) return "none: the camera is lost";
  const expected = point.expected_ms == null ? "" : `, ${milliseconds(point.expected_ms)} ms expected`;
  const error = point.light_error_deg == null ? "" : `, light off by ${number(point.light_error_deg)}° where measured`;
  return `${point.settings} (${point.reason})${expected}${error}`;
}

/** How frames are sent; `fps`: how many a second, where it is known. */
export function describeSending(sending: Sending, fps: number | null): string {
  const often = fps === null ? "" : `, ${fps < 2.95 ? fps.toFixed(1) : Math.round(fps)} frames/s`;
  if (sending.as === "recorded") return `as recorded${often}`;
  const { divisor, quality, videoShare } = sending.coding;
  if (sending.as === "jpeg") return `${divisor === 1 ? "full" : divisor === 2 ? "half" : "quarter"} size, quality ${quality}${often}`;
  return `video at ${videoShare === 1 ? "its full bit rate" : `${Math.round(100 * videoShare)} % of its bit rate`}${often}`;
}

/** Three significant digits, without an exponent where that is short enough to read. */
export function number(value: number): string {
  if (!Number.isFinite(value)) return "∞";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e5 || size < 1e-3)) return value.toExponential(1).replace("e+", "e");
  return size >= 100 ? Math.round(value).toString() : Number(value.toPrecision(3)).toString();
}

/** Milliseconds with a fixed number of decimals, so that a column of them stands still. */
export function milliseconds(value: number): string {
  return value.toFixed(value >= 99.95 ? 0 : 1);
}

/** `radiance_transfer` as it is read aloud. */
export function plain(name: string): string {
  const words = name.replaceAll("_", " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}

export const TRACKING = { given: "pose given", tracked: "pose tracked", lost: "tracking lost" } as const;
