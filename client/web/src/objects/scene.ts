// The virtual objects of this client, and what the server has been asked of them. At most one request of an object is
// under way: where a finger moves it on meanwhile, only the last place is asked for.

import type { Asked } from "../session";
import type { Vector3 } from "../sh";

/** Begin of the error of a request that was applied, and that the server could not write to its disk. */
const NOT_SAVED = "not saved: ";

export interface Model {
  /** Name for the user. */
  name: string;
  format: "glb" | "obj" | "ply" | "stl";
  data: Uint8Array;
  /** Bounding box, metres. */
  radius_m: number;
  height_m: number;
}

export interface Placed {
  readonly id: string;
  readonly model: Model;
  position: Vector3;
  yaw_deg: number;
  scale: number;
}

interface Slot {
  placed: Placed;
  underWay: number | null;
  isThere: boolean;
  isStale: boolean;
  isUnwanted: boolean;
}

export class Scene {
  private readonly slots = new Map<string, Slot>();
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

  place(model: Model, position: Vector3): Placed {
    const id = `${model.name.toLowerCase().slice(0, 40)}-${this.prefix}-${++this.count}`; // a room's names are its clients' all
    const placed: Placed = { id, model, position, yaw_deg: 0, scale: 1 };
    const slot = { placed, underWay: null, isThere: false, isStale: true, isUnwanted: false };
    this.slots.set(id, slot);
    this.select(placed);
    this.advance(slot);
    return placed;
  }

  select(placed: Placed | null): void {
    this.selected = placed;
    this.onChange();
  }

  /** Change position, yaw or scale of an object. */
  change(placed: Placed, to: Partial<Pick<Placed, "position" | "yaw_deg" | "scale">>): void {
    const slot = this.slots.get(placed.id);
    if (slot === undefined) return;
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
    const [x, y, z] = placed.position;
    const where = { object: placed.id, position_m: [x, y, z] as [number, number, number], yaw_deg: placed.yaw_deg, scale: placed.scale };
    const { format, data } = placed.model;
    slot.underWay = this.ask(slot.isThere ? { type: "move_object", ...where } : { type: "place_object", format, data, ...where });
    slot.isThere = true;
  }
}
