// Fingers, mouse and keys on the picture, as things done to objects.

import type { Pixel } from "./picking";

export interface Handling {
  /** A finger comes down; whether there is something to be dragged. */
  begin(pixel: Pixel): boolean;
  drag(pixel: Pixel): void;
  /** Counter-clockwise seen from above. */
  turn(by_deg: number): void;
  /** Along the picture: right and away, in steps. */
  step(right: number, away: number): void;
  scale(by: number): void;
  remove(): void;
  /** What stands now is what undo() brings back. */
  remember(): void;
  undo(): void;
}

/** Where a point of the page is in a picture that keeps its shape within its element; null beside it. */
export function pixelAt(box: DOMRect, size: { width: number; height: number }, clientX: number, clientY: number): Pixel | null {
  const scale = Math.min(box.width / size.width, box.height / size.height);
  if (!(scale > 0)) return null;
  const x = (clientX - box.left - (box.width - scale * size.width) / 2) / scale - 0.5;
  const y = (clientY - box.top - (box.height - scale * size.height) / 2) / scale - 0.5;
  return x < -0.5 || y < -0.5 || x > size.width - 0.5 || y > size.height - 0.5 ? null : { x, y };
}

export const TURN_DEG = 15;
export const GROWTH = 1.1;
const [FINE, COARSE] = [1, 5] as const;

export function handleTouch(frame: HTMLElement, canvas: HTMLCanvasElement, handling: Handling): void {
  const fingers = new Map<number, { x: number; y: number }>();
  let dragged: number | null = null;
  const pixelOf = (event: PointerEvent): Pixel | null => pixelAt(canvas.getBoundingClientRect(), canvas, event.clientX, event.clientY);

  frame.addEventListener("pointerdown", (event) => {
    const before = fingers.size;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const pixel = pixelOf(event);
    if (before > 0 || pixel === null || event.button !== 0) return;
    if (!handling.begin(pixel)) return;
    dragged = event.pointerId;
    frame.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  frame.addEventListener("pointermove", (event) => {
    const known = fingers.get(event.pointerId);
    if (known === undefined) return;
    if (fingers.size === 2 && dragged !== null) {
      handling.turn(-turnOf(fingers, event));
      handling.scale(growthOf(fingers, event));
    }
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const pixel = pixelOf(event);
    if (event.pointerId === dragged && fingers.size === 1 && pixel !== null) handling.drag(pixel);
  });
  const lift = (event: PointerEvent): void => {
    fingers.delete(event.pointerId);
    if (event.pointerId === dragged) dragged = null;
  };
  frame.addEventListener("pointerup", lift);
  frame.addEventListener("pointercancel", lift);
  frame.addEventListener("keydown", (event) => {
    const isUndo = (event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z";
    if (isUndo) handling.undo();
    else if (event.ctrlKey || event.altKey || event.metaKey || !press(event, handling)) return;
    event.preventDefault();
  });
}

/** By how much the line between two fingers turns when one of them moves; clockwise on the screen is positive. */
function turnOf(fingers: ReadonlyMap<number, { x: number; y: number }>, event: PointerEvent): number {
  const other = [...fingers].find(([id]) => id !== event.pointerId)![1];
  const was = fingers.get(event.pointerId)!;
  const before = Math.atan2(was.y - other.y, was.x - other.x);
  const after = Math.atan2(event.clientY - other.y, event.clientX - other.x);
  const turned = ((after - before) * 180) / Math.PI;
  return turned > 180 ? turned - 360 : turned < -180 ? turned + 360 : turned;
}

/** By which factor the distance of two fingers grows when one of them moves. */
function growthOf(fingers: ReadonlyMap<number, { x: number; y: number }>, event: PointerEvent): number {
  const other = [...fingers].find(([id]) => id !== event.pointerId)![1];
  const was = fingers.get(event.pointerId)!;
  const [before, after] = [was, { x: event.clientX, y: event.clientY }].map(({ x, y }) => Math.max(LEAST_APART_PX, Math.hypot(x - other.x, y - other.y)));
  return after! / before!;
}

/** Nearer than this two fingers say nothing of a size. */
const LEAST_APART_PX = 20;

const KEYS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "[", "]", "+", "-", "Delete", "Backspace"];

function press(event: KeyboardEvent, handling: Handling): boolean {
  if (!KEYS.includes(event.key)) return false;
  handling.remember();
  const far = event.shiftKey ? COARSE : FINE;
  switch (event.key) {
    case "ArrowLeft":
      handling.step(-far, 0);
      return true;
    case "ArrowRight":
      handling.step(far, 0);
      return true;
    case "ArrowUp":
      handling.step(0, far);
      return true;
    case "ArrowDown":
      handling.step(0, -far);
      return true;
    case "[":
    case "]":
      handling.turn(event.key === "[" ? TURN_DEG : -TURN_DEG);
      return true;
    case "+":
    case "-":
      handling.scale(event.key === "+" ? GROWTH : 1 / GROWTH);
      return true;
    case "Delete":
    case "Backspace":
      handling.remove();
      return true;
    default:
      return false;
  }
}
