// The virtual objects of this client, and what the server has been asked of them. At most one request of an object is
// under way: where a finger moves it on meanwhile, only the last place is asked for.

import type { PlacedObject, Spot } from "../protocol";
import type { Asked } from "../session";
import type { Vector3 } from "../sh";

/** Begin of the error of a request that was applied, and that the server could not write to its disk. */
const NOT_SAVED = "not saved: ";
const NOWHERE: Vector3 = [0, 0, 0];
const MOST_REMEMBERED = 100;

export interface Model {
  /** Name for the user. */
  name: string;
  format: "glb" | "obj" | "ply" | "stl";
  data: Uint8Array;
  /** Bounding box at scale 1, metres. */
  radius_m: number;
  height_m: number;
  /** At which it is placed first. */
  scale: number;
}

export interface Placed {
  readonly id: string;
  readonly model: Model;
  position: Vector3;
  yaw_deg: number;
  scale: number;
  /** Where the server still looks for `position`; null: it is known. */
  spot: Spot | null;
}

/** How an object stood, to be undone. */
type Stood = Pick<Placed, "position" | "yaw_deg" | "scale">;
type State = Map<Placed, Stood>;

interface Slot {
  placed: Placed;
  underWay: number | null;
  isThere: boolean;
  isStale: boolean;
  isUnwanted: boolean;
}

export class Scene {
  private readonly slots = new Map<string, Slot>();
  private readonly past: State[] = [];
  private count = 0;
  selected: Placed | null = null;

  /** `ask`: sends a request, and gives its number. `onChange`: what is placed or selected is another. */
  constructor(
    private readonly ask: (asked: Asked) => number,
    private readonly onChange: () => void,
    private readonly prefix = Math.random().toString(36).slice(2, 6),
  ) {}

  get placed(): readonly Placed[] {
    return [...this.slots.values()].filter((slot) => !slot.isUnwanted).map((slot) => slot.placed);
  }

  /** `where`: a position, or a spot in which the server looks for it. */
  place(model: Model, where: Vector3 | Spot): Placed {
    const id = `${model.name.toLowerCase().slice(0, 40)}-${this.prefix}-${++this.count}`; // a room's names are its clients' all
    const [position, spot] = "on" in where ? [NOWHERE, where] : [where, null];
    const placed: Placed = { id, model, position, yaw_deg: 0, scale: model.scale, spot };
    this.put(placed);
    this.select(placed);
    return placed;
  }

  private put(placed: Placed): void {
    const slot = { placed, underWay: null, isThere: false, isStale: true, isUnwanted: false };
    this.slots.set(placed.id, slot);
    this.advance(slot);
  }

  /** The server has found the spot of an object. */
  found({ object, position_m, scale, yaw_deg }: PlacedObject): void {
    const placed = this.slots.get(object)?.placed;
    if (placed === undefined || placed.spot === null) return;
    Object.assign(placed, { position: position_m, scale, yaw_deg, spot: null });
    for (const state of this.past) if (state.has(placed)) state.set(placed, { position: position_m, scale, yaw_deg });
    this.onChange();
  }

  /** Call before what a person does: `undo` brings back what stands now. */
  remember(): void {
    this.past.push(new Map(this.placed.map((placed) => [placed, { position: placed.position, yaw_deg: placed.yaw_deg, scale: placed.scale }])));
    if (this.past.length > MOST_REMEMBERED) this.past.shift();
  }

  get canUndo(): boolean {
    return this.past.some((state) => this.differs(state));
  }

  /** Whether anything was undone. */
  undo(): boolean {
    let state = this.past.pop();
    while (state !== undefined && !this.differs(state)) state = this.past.pop(); // nothing came of it
    if (state === undefined) return false;
    for (const placed of this.placed) if (!state.has(placed)) this.remove(placed);
    for (const [placed, stood] of state) this.restore(placed, stood);
    this.onChange();
    return true;
  }

  private differs(state: State): boolean {
    const now = this.placed;
    return now.length !== state.size || now.some((placed) => !isAt(placed, state.get(placed)));
  }

  private restore(placed: Placed, stood: Stood): void {
    const slot = this.slots.get(placed.id);
    if (slot !== undefined && !slot.isUnwanted) {
      if (!isAt(placed, stood)) this.change(placed, stood);
      return;
    }
    Object.assign(placed, stood);
    if (slot === undefined) return this.put(placed);
    Object.assign(slot, { isUnwanted: false, isStale: true });
    this.advance(slot);
  }

  select(placed: Placed | null): void {
    this.selected = placed;
    this.onChange();
  }

  /** Change position, yaw or scale of an object. */
  change(placed: Placed, to: Partial<Pick<Placed, "position" | "yaw_deg" | "scale">>): void {
    const slot = this.slots.get(placed.id);
    if (slot === undefined || placed.spot !== null) return;
    Object.assign(placed, to);
    slot.isStale = true;
    this.advance(slot);
    this.onChange();
  }

  remove(placed: Placed): void {
    const slot = this.slots.get(placed.id);
    if (slot === undefined) return;
    slot.isUnwanted = true;
    if (this.selected === placed) this.selected = null;
    this.advance(slot);
    this.onChange();
  }

  /** Handle the answer to a request; returns the error about an object of this scene, else null. */
  acknowledge(request: number, error: string | null): string | null {
    const slot = [...this.slots.values()].find((each) => each.underWay === request);
    if (slot === undefined) return null;
    slot.underWay = null;
    const named = error === null ? null : `${slot.placed.model.name}: ${error}`;
    if (error === null || error.startsWith(NOT_SAVED)) {
      this.advance(slot);
      return named;
    }
    this.slots.delete(slot.placed.id); // it was never placed
    if (this.selected === slot.placed) this.selected = null;
    this.onChange();
    return named;
  }

  /** The server was restarted: place all objects again and ignore earlier requests. */
  placeAgain(): void {
    for (const slot of [...this.slots.values()]) {
      Object.assign(slot, { underWay: null, isThere: false, isStale: true });
      this.advance(slot);
    }
  }

  clear(): void {
    this.slots.clear();
    this.past.length = 0;
    this.select(null);
  }

  private advance(slot: Slot): void {
    if (slot.underWay !== null) return;
    const { placed } = slot;
    if (slot.isUnwanted) {
      if (slot.isThere) slot.underWay = this.ask({ type: "remove_object", object: placed.id });
      slot.isThere = false;
      if (slot.underWay === null) this.slots.delete(placed.id);
      return;
    }
    if (!slot.isStale) return;
    slot.isStale = false;
    const { format, data } = placed.model;
    const { id: object, position: position_m, yaw_deg, scale, spot } = placed;
    const wasThere = slot.isThere;
    slot.isThere = true;
    if (spot !== null) {
      slot.underWay = this.ask({ type: "place_object", format, data, object, spot, yaw_deg, scale });
      return;
    }
    const [x, y, z] = position_m;
    const where = { object, position_m: [x, y, z] as [number, number, number], yaw_deg, scale };
    slot.underWay = this.ask(wasThere ? { type: "move_object", ...where } : { type: "place_object", format, data, ...where });
  }
}

function isAt(placed: Placed, stood: Stood | undefined): boolean {
  if (stood === undefined) return false;
  return placed.yaw_deg === stood.yaw_deg && placed.scale === stood.scale && placed.position.every((value, axis) => value === stood.position[axis]);
}
