// What client/results/page.py writes into the page.

import type { Vector3 } from "../sh";

export interface RunData {
  source: string;
  /** OpenCL device; "" where it is not known. */
  device: string;
  fps: number;
  /** Frames asked for; null: until it was stopped. */
  total: number | null;
  /** Why the run ended early; "": it did not. */
  ended: string;
  objects: string[];
  /** File beside the page. */
  video: string | null;
  camera: { width: number; height: number; fx: number; fy: number; cx: number; cy: number };
  /** World, unit. */
  up: Vector3;
  tables: Tables;
  scan: Scan | null;
  frames: FrameRow[];
}

export type PlaceKind = "beyond" | "view" | "place" | "object";

/** What rows refer to by position. */
export interface Tables {
  stages: string[];
  effects: string[];
  left_out: [effect: string, reason: string, bound: number | null][];
  points: [settings: string, reason: string][];
  places: [kind: PlaceKind, index: number][];
}

export interface Scan {
  count: number;
  cell_m: number;
  least: Vector3;
  most: Vector3;
  /** Base64 of [count, 3] little-endian uint16: 0 and 65535 are the sides of the box. */
  places: string;
  /** Base64 of [count, 3] uint8 sRGB. */
  colors: string;
}

export interface LightRow {
  place: number;
  /** World, metres. */
  at: Vector3 | null;
  /** 16 x RGB, flat. */
  sh: number[];
  /** World, unit, towards the dominant light. */
  towards: Vector3;
  intensity: number;
  spread: number | null;
  valid: boolean;
  seen?: number | null;
  lamps?: number;
}

export interface FrameRow {
  frame: number;
  time: number;
  lights: LightRow[];
  drawn: DrawnRow | null;
}

/** Of a frame with a picture. */
export interface DrawnRow {
  /** 1: the composite alone, 2: the camera's own picture besides. */
  picture: 1 | 2;
  /** Share of the pixels that virtual content changes, and between which columns, as shares of the width; null: none. */
  changed: [share: number, from: number, to: number] | null;
  /** 3x4 world_from_camera, row-major, metres. */
  pose: number[];
  tracking: "given" | "tracked" | "lost";
  /** By stage. */
  ms: number[];
  total: number;
  host: number;
  /** Positions in `effects`, `left_out` and `points`. */
  run: number[];
  out: number[];
  point: number | null;
  notes?: string[];
}

/** The data in the page. Throws Error where there is none. */
export function readData(): RunData {
  const text = document.getElementById("data")?.textContent ?? "";
  if (!text.startsWith("{")) throw new Error("this page has no data: probeless run --out DIR writes one that has");
  return JSON.parse(text) as RunData;
}

export function fromBase64(text: string): Uint8Array<ArrayBuffer> {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

/** Files of a frame, beside the page. */
export const compositeFile = ({ frame }: FrameRow): string => `frames/${String(frame).padStart(6, "0")}.png`;
export const cameraFile = ({ frame }: FrameRow): string => `camera/${String(frame).padStart(6, "0")}.jpg`;
