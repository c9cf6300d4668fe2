// The tools for objects: choose, place, move, turn, size, delete; by finger, by buttons and by keys alike.

import { reasonOf } from "../capture/source";
import { byId, setText } from "../dom";
import type { Asked } from "../session";
import { toWorld, type Vector3 } from "../sh";
import { drawGuide } from "./guide";
import { handlingHint, placingHint } from "./hints";
import { Models, modelOf } from "./models";
import { cross, dot, floorOf, isMeasured, levelAt, levelled, type Measured, measured, type Pixel, project, rayOf, scaled, type Seen, seenFrom, sum, surfaceAt } from "./picking";
import type { PlaceObject, Spot } from "../protocol";
import { type Placed, Scene } from "./scene";
import { GROWTH, handleTouch, TURN_DEG } from "./touch";

const NEAR_PX = 28;
const STEP_M = 0.02;

export class ObjectTools {
  readonly scene: Scene;
  private readonly models = new Models(byId<HTMLSelectElement>("model"), (text) => this.say(text));
  private readonly guide = byId<HTMLCanvasElement>("guide");
  private readonly frame = byId("picture-frame");
  private readonly list = byId<HTMLSelectElement>("objects");
  private readonly placeButton = byId<HTMLButtonElement>("place");
  private readonly said = byId("object-said");
  private readonly hint = byId("object-hint");
  private readonly undoButton = byId<HTMLButtonElement>("undo");
  /** Of the picture on the screen; null where nothing can be placed. */
  private seen: Seen | null = null;
  /** From where, if that is another picture than the one that was measured. */
  private from: readonly number[] | null = null;
  private floor_m: number | null = null;
  private isPlacing = false;
  private isFetching = false;
  private drags = 0;
  private lastDrag = 0;

  constructor(ask: (asked: Asked) => number) {
    this.scene = new Scene(ask, () => this.refresh());
    this.listen();
    this.refresh();
  }

  /** The frame of which the picture is on the screen; null: there is nothing to place anything on. */
  show(seen: Seen | null): void {
    this.seen = seen === null || this.from === null ? seen : seenFrom(seen, this.from);
    if (seen !== null && isMeasured(seen)) this.noteFloor(seen);
    byId("object-tools").hidden = seen === null;
    this.draw();
  }

  /** The picture on the screen is a newer one, taken from there (row-major). */
  look(worldFromCamera: readonly number[]): void {
    this.from = worldFromCamera;
    if (this.seen === null) return;
    this.seen = seenFrom(this.seen, worldFromCamera);
    if (this.scene.selected !== null) this.draw();
  }

  /** A session begins: what can be placed in it, and what its source brings along. */
  begin(brought: readonly PlaceObject[] = []): void {
    void this.models.refresh();
    for (const { object, format, data, position_m, spot, yaw_deg = 0, scale = 1, height_m } of brought) {
      const where = spot ?? position_m;
      if (!where) continue; // its vertices are places of the world, which cannot be handled here
      const model = modelOf(object.charAt(0).toUpperCase() + object.slice(1), format, new Uint8Array(data));
      const placed = this.scene.place({ ...model, scale: height_m && model.height_m > 0 ? height_m / model.height_m : scale }, where);
      if (yaw_deg !== 0) this.scene.change(placed, { yaw_deg });
    }
    this.scene.select(null);
  }

  /** A session ends: its floor and what was placed are not those of the next. */
  clear(): void {
    this.floor_m = this.from = null;
    this.isPlacing = false;
    this.scene.clear();
    this.show(null);
  }

  say(text: string): void {
    setText(this.said, text);
  }

  private listen(): void {
    handleTouch(this.frame, byId<HTMLCanvasElement>("picture"), {
      begin: (pixel) => this.touch(pixel),
      drag: (pixel) => void this.drag(pixel),
      turn: (by_deg) => this.turn(by_deg),
      step: (right, away) => this.step(right, away),
      scale: (by) => this.scale(by),
      remove: () => this.remove(),
      remember: () => this.scene.remember(),
      undo: () => this.undo(),
    });
    this.placeButton.addEventListener("click", (event) => this.pressPlace(event.detail === 0));
    this.list.addEventListener("change", () => this.scene.select(this.scene.placed[this.list.selectedIndex - 1] ?? null));
    const buttons: [string, () => void][] = [
      ["move-left", () => this.step(-1, 0)],
      ["move-right", () => this.step(1, 0)],
      ["move-away", () => this.step(0, 1)],
      ["move-near", () => this.step(0, -1)],
      ["turn-left", () => this.turn(TURN_DEG)],
      ["turn-right", () => this.turn(-TURN_DEG)],
      ["smaller", () => this.scale(1 / GROWTH)],
      ["larger", () => this.scale(GROWTH)],
      ["remove", () => this.remove()],
    ];
    for (const [id, act] of buttons) {
      byId(id).addEventListener("click", () => {
        this.scene.remember();
        act();
      });
    }
    this.undoButton.addEventListener("click", () => this.undo());
    const file = byId<HTMLInputElement>("model-file");
    file.addEventListener("change", () => void this.models.read(file.files?.[0]));
    for (const target of [this.frame, byId("object-tools")]) {
      target.addEventListener("dragover", (event) => event.preventDefault());
      target.addEventListener("drop", (event) => {
        event.preventDefault();
        void this.models.read(event.dataTransfer?.files[0]);
      });
    }
  }

  /** By a finger: the next tap says where. By a key: in the middle of the picture, from where keys move it. */
  private pressPlace(isKey: boolean): void {
    if (!isKey) {
      this.isPlacing = !this.isPlacing;
      this.say("");
      return this.refresh();
    }
    const size = byId<HTMLCanvasElement>("picture");
    void this.placeAt({ x: (size.width - 1) / 2, y: (size.height - 1) / 2 });
    this.frame.focus();
  }

  private touch(pixel: Pixel): boolean {
    if (this.seen === null) return false;
    if (this.isPlacing || this.scene.placed.length === 0) {
      this.scene.select(null); // what is dragged from now on is what is placed
      void this.placeAt(pixel);
      return true;
    }
    this.scene.select(this.nearest(pixel));
    this.scene.remember(); // of a drag that may follow
    return this.scene.selected !== null;
  }

  private async placeAt(pixel: Pixel): Promise<void> {
    const { seen } = this;
    if (seen === null) return;
    if (this.isFetching) return; // a second tap while a model is fetched places no second one
    this.isPlacing = false;
    this.isFetching = true;
    try {
      const [model, place] = await Promise.all([this.models.chosen(), this.placeUnder(seen, pixel)]);
      if (this.seen === null) return; // the session is over
      if (place === null) throw new Error("No surface was measured there: tap somewhere else, or move closer.");
      this.scene.remember();
      this.scene.place(model, place);
      this.say(`${model.name} placed.`);
    } catch (error) {
      this.isPlacing = true;
      this.refresh();
      this.say(reasonOf(error));
    } finally {
      this.isFetching = false;
    }
  }

  /** Where there is no depth here, the server looks for the surface in its scan. */
  private async placeUnder(seen: Seen, pixel: Pixel): Promise<Vector3 | Spot | null> {
    return seen.depth === null ? { on: "ray", ...rayOf(seen, pixel) } : this.surfaceUnder(seen, pixel);
  }

  private async surfaceUnder(seen: Seen, pixel: Pixel): Promise<Vector3 | null> {
    const known = await measured(seen);
    this.noteFloor(known);
    return surfaceAt(known, pixel) ?? (this.floor_m === null ? null : levelAt(known, pixel, this.floor_m));
  }

  private noteFloor(seen: Measured): void {
    const floor = floorOf(seen);
    if (floor !== null) this.floor_m = this.floor_m === null ? floor : Math.min(this.floor_m, floor);
  }

  /** The object under a finger. */
  private nearest(pixel: Pixel): Placed | null {
    const { seen } = this;
    if (seen === null) return null;
    const canvas = this.guide;
    const pixels = canvas.width / Math.max(1, canvas.getBoundingClientRect().width);
    const distances = this.scene.placed.filter(({ spot }) => spot === null).map((placed) => {
      const half_m = (placed.model.height_m * placed.scale) / 2;
      const middle = project(seen.camera, seen.world_from_camera, sum(placed.position, scaled(seen.up, half_m)));
      const side = project(seen.camera, seen.world_from_camera, placed.position);
      if (middle === null || side === null) return { placed, beyond: Number.POSITIVE_INFINITY };
      const reach = Math.max(NEAR_PX * pixels, Math.hypot(side.x - middle.x, side.y - middle.y));
      return { placed, beyond: Math.hypot(pixel.x - middle.x, pixel.y - middle.y) / reach };
    });
    const best = distances.sort((a, b) => a.beyond - b.beyond)[0];
    return best !== undefined && best.beyond <= 1.2 ? best.placed : null;
  }

  private async drag(pixel: Pixel): Promise<void> {
    const { seen, scene } = this;
    const { selected } = scene;
    if (seen === null || selected === null) return;
    const drag = ++this.drags;
    const place = await this.draggedTo(seen, selected, pixel).catch(() => null); // of depth that cannot be read: it stays where it is
    if (place === null || drag < this.lastDrag || scene.selected !== selected) return;
    this.lastDrag = drag;
    scene.change(selected, { position: place });
  }

  private async draggedTo(seen: Seen, { position }: Placed, pixel: Pixel): Promise<Vector3 | null> {
    return seen.depth === null ? levelAt(seen, pixel, dot(seen.up, position)) : this.surfaceUnder(seen, pixel);
  }

  /** On its level, to the picture's right and away from the camera. */
  private step(right: number, away: number): void {
    const { selected } = this.scene;
    if (selected === null || this.seen === null) return;
    const { up, world_from_camera } = this.seen;
    const level = levelled(toWorld(world_from_camera, [1, 0, 0]), up);
    const toRight = scaled(level, 1 / (Math.hypot(...level) || 1));
    const toAway = cross(up, toRight); // level, and at a right angle, however the camera is tilted
    this.scene.change(selected, { position: sum(selected.position, scaled(toRight, STEP_M * right), scaled(toAway, STEP_M * away)) });
    this.say(`${selected.model.name} moved ${words(right, away)}.`);
  }

  private turn(by_deg: number): void {
    const { selected } = this.scene;
    if (selected === null) return;
    this.scene.change(selected, { yaw_deg: (((selected.yaw_deg + by_deg) % 360) + 360) % 360 });
    this.say(`${selected.model.name} turned to ${Math.round(selected.yaw_deg)}°.`);
  }

  private scale(by: number): void {
    const { selected } = this.scene;
    if (selected === null) return;
    const [least, most] = [0.01 * selected.model.scale, 100 * selected.model.scale];
    this.scene.change(selected, { scale: Math.min(most, Math.max(least, selected.scale * by)) });
    this.say(`${selected.model.name} at ${Math.round((100 * selected.scale) / selected.model.scale)} % of its size.`);
  }

  private remove(): void {
    const { selected } = this.scene;
    if (selected === null) return;
    this.scene.remove(selected);
    this.say(`${selected.model.name} removed.`);
  }

  private undo(): void {
    this.say(this.scene.undo() ? "Undone." : "There is nothing to undo.");
  }

  private refresh(): void {
    const { placed, selected } = this.scene;
    const count = new Option(`${placed.length} ${placed.length === 1 ? "object" : "objects"}`, "");
    this.list.replaceChildren(count, ...placed.map((each) => new Option(each.id.replace(/-.*-/, " "), each.id, false, each === selected)));
    this.list.disabled = placed.length === 0;
    byId("selected-tools").hidden = selected === null;
    this.undoButton.disabled = !this.scene.canUndo;
    const isPlacing = this.isPlacing || placed.length === 0;
    setText(this.hint, isPlacing ? placingHint() : selected !== null ? handlingHint() : "");
    this.placeButton.setAttribute("aria-pressed", String(this.isPlacing));
    this.frame.classList.toggle("handling", isPlacing || selected !== null);
    this.draw();
  }

  private draw(): void {
    const { selected } = this.scene;
    if (this.seen === null || selected === null || selected.spot !== null) return drawGuide(this.guide, NO_LENS, NO_POSE, null);
    const { position, yaw_deg, scale, model } = selected;
    const standing = { position, up: this.seen.up, yaw_deg, radius_m: model.radius_m * scale, height_m: model.height_m * scale };
    drawGuide(this.guide, this.seen.camera, this.seen.world_from_camera, standing);
  }
}

const NO_LENS = { width: 1, height: 1, fx: 1, fy: 1, cx: 0, cy: 0 };
const NO_POSE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

function words(right: number, away: number): string {
  const far = `${Math.round(100 * STEP_M * Math.max(Math.abs(right), Math.abs(away)))} cm`;
  return right !== 0 ? `${far} ${right > 0 ? "right" : "left"}` : `${far} ${away > 0 ? "away" : "nearer"}`;
}
