// The tools for objects: choose, place, move, turn, size, delete; by finger, by buttons and by keys alike.

import { byId, make, setText } from "../dom";
import { MAX_MESH_BYTES } from "../protocol";
import type { Asked } from "../remote";
import { toWorld, type Vector3 } from "../sh";
import { sizeOfGlb, toGlb } from "./glb";
import { drawGuide } from "./guide";
import { floorOf, levelAt, type Pixel, project, type Seen, surfaceAt } from "./picking";
import { type Model, type Placed, Scene } from "./scene";
import { ball, cube, vase } from "./shapes";
import { GROWTH, handleTouch, TURN_DEG } from "./touch";

const NEAR_PX = 28;
const STEP_M = 0.02;
/** Of a file whose size is not known here. */
const UNKNOWN_M = 0.2;
const FORMATS = ["glb", "obj", "ply", "stl"] as const;

export class ObjectTools {
  readonly scene: Scene;
  private readonly models = new Map<string, Model>();
  private readonly guide = byId<HTMLCanvasElement>("guide");
  private readonly frame = byId("picture-frame");
  private readonly choice = byId<HTMLSelectElement>("model");
  private readonly list = byId<HTMLSelectElement>("objects");
  private readonly placeButton = byId<HTMLButtonElement>("place");
  private readonly said = byId("object-said");
  /** Of the picture on the screen; null where nothing can be placed. */
  private seen: Seen | null = null;
  private floor_m: number | null = null;
  private isPlacing = false;

  constructor(ask: (asked: Asked) => number | null) {
    this.scene = new Scene(ask, () => this.refresh());
    for (const [name, shape, radius_m, height_m] of [
      ["Vase", vase(), 0.077, 0.24],
      ["Ball", ball(), 0.08, 0.16],
      ["Cube", cube(), 0.106, 0.15],
    ] as const) {
      this.offer({ name, format: "glb", data: toGlb(shape), radius_m, height_m });
    }
    this.listen();
    this.refresh();
  }

  /** The frame of which the picture is on the screen; null: there is nothing to place anything on. */
  show(seen: Seen | null): void {
    this.seen = seen;
    const floor = seen === null ? null : floorOf(seen);
    if (floor !== null) this.floor_m = this.floor_m === null ? floor : Math.min(this.floor_m, floor);
    byId("object-tools").hidden = seen === null;
    this.draw();
  }

  /** A session ends: its floor and what was placed are not those of the next. */
  clear(): void {
    this.floor_m = null;
    this.isPlacing = false;
    this.scene.clear();
    this.show(null);
  }

  say(text: string): void {
    setText(this.said, text);
  }

  private offer(model: Model): void {
    this.models.set(model.name, model);
    const known = [...this.choice.options].find((option) => option.value === model.name);
    const option = known ?? make("option", "", model.name);
    option.value = model.name;
    this.choice.append(option);
    this.choice.value = model.name;
    if (this.models.size <= 3) this.choice.selectedIndex = 0;
  }

  private listen(): void {
    handleTouch(this.frame, byId<HTMLCanvasElement>("picture"), {
      begin: (pixel) => this.begin(pixel),
      drag: (pixel) => this.drag(pixel),
      turn: (by_deg) => this.turn(by_deg),
      step: (right, away) => this.step(right, away),
      scale: (by) => this.scale(by),
      remove: () => this.remove(),
    });
    this.placeButton.addEventListener("click", (event) => this.pressPlace(event.detail === 0));
    this.list.addEventListener("change", () => this.scene.select(this.scene.placed[this.list.selectedIndex] ?? null));
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
    for (const [id, act] of buttons) byId(id).addEventListener("click", act);
    const file = byId<HTMLInputElement>("model-file");
    file.addEventListener("change", () => void this.read(file.files?.[0]));
    this.frame.addEventListener("dragover", (event) => event.preventDefault());
    this.frame.addEventListener("drop", (event) => {
      event.preventDefault();
      void this.read(event.dataTransfer?.files[0]);
    });
  }

  private async read(file: File | undefined): Promise<void> {
    if (file === undefined) return;
    const dot = file.name.lastIndexOf(".");
    const format = FORMATS.find((each) => each === file.name.slice(dot + 1).toLowerCase());
    if (format === undefined) return this.say(`${file.name} is no model that can be placed: choose a .glb, .obj, .ply or .stl file.`);
    if (file.size > MAX_MESH_BYTES) return this.say(`${file.name} has ${Math.ceil(file.size / 2 ** 20)} MiB, more than the ${MAX_MESH_BYTES / 2 ** 20} MiB that the server takes.`);
    const data = new Uint8Array(await file.arrayBuffer());
    const [width, height, depth] = (format === "glb" ? sizeOfGlb(data) : null) ?? [UNKNOWN_M, UNKNOWN_M, UNKNOWN_M];
    this.offer({ name: file.name.slice(0, dot) || "Model", format, data, radius_m: Math.hypot(width, depth) / 2, height_m: height });
    this.say(`${file.name} can be placed now.`);
  }

  /** By a finger: the next tap says where. By a key: in the middle of the picture, from where keys move it. */
  private pressPlace(isKey: boolean): void {
    if (!isKey) {
      this.isPlacing = !this.isPlacing;
      this.refresh();
      return this.say(this.isPlacing ? "Tap where it shall stand." : "");
    }
    const size = byId<HTMLCanvasElement>("picture");
    this.placeAt({ x: (size.width - 1) / 2, y: (size.height - 1) / 2 });
    this.frame.focus();
  }

  private begin(pixel: Pixel): boolean {
    if (this.seen === null) return false;
    if (this.isPlacing) return this.placeAt(pixel);
    this.scene.select(this.nearest(pixel));
    return this.scene.selected !== null;
  }

  private placeAt(pixel: Pixel): boolean {
    const model = this.models.get(this.choice.value);
    const place = this.placeUnder(pixel);
    if (model === undefined || place === null) {
      this.say("No surface was measured there: tap somewhere else, or move closer.");
      return false;
    }
    this.isPlacing = false;
    this.scene.place(model, place);
    this.say(`${model.name} placed. Drag it, or move it with the arrow keys; [ and ] turn it, Delete removes it.`);
    return true;
  }

  private placeUnder(pixel: Pixel): Vector3 | null {
    if (this.seen === null) return null;
    return surfaceAt(this.seen, pixel) ?? (this.floor_m === null ? null : levelAt(this.seen, pixel, this.floor_m));
  }

  /** The object under a finger. */
  private nearest(pixel: Pixel): Placed | null {
    const { seen } = this;
    if (seen === null) return null;
    const canvas = this.guide;
    const pixels = canvas.width / Math.max(1, canvas.getBoundingClientRect().width);
    const distances = this.scene.placed.map((placed) => {
      const [x, y, z] = placed.position;
      const middle = project(seen.camera, seen.world_from_camera, [x, y + (placed.model.height_m * placed.scale) / 2, z]);
      const side = project(seen.camera, seen.world_from_camera, [x, y, z]);
      if (middle === null || side === null) return { placed, beyond: Number.POSITIVE_INFINITY };
      const reach = Math.max(NEAR_PX * pixels, Math.hypot(side.x - middle.x, side.y - middle.y));
      return { placed, beyond: Math.hypot(pixel.x - middle.x, pixel.y - middle.y) / reach };
    });
    const best = distances.sort((a, b) => a.beyond - b.beyond)[0];
    return best !== undefined && best.beyond <= 1.2 ? best.placed : null;
  }

  private drag(pixel: Pixel): void {
    const place = this.placeUnder(pixel);
    if (place !== null && this.scene.selected !== null) this.scene.change(this.scene.selected, { position: place });
  }

  /** On its level, to the picture's right and away from the camera. */
  private step(right: number, away: number): void {
    const { selected } = this.scene;
    if (selected === null || this.seen === null) return;
    const level = (axis: Vector3): [number, number] => {
      const [x, , z] = toWorld(this.seen!.world_from_camera, axis);
      const length = Math.hypot(x, z) || 1;
      return [x / length, z / length];
    };
    const [rx, rz] = level([1, 0, 0]);
    const [ax, az] = [rz, -rx]; // level, and at a right angle, however the camera is tilted
    const [x, y, z] = selected.position;
    this.scene.change(selected, { position: [x + STEP_M * (right * rx + away * ax), y, z + STEP_M * (right * rz + away * az)] });
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
    this.scene.change(selected, { scale: Math.min(100, Math.max(0.01, selected.scale * by)) });
    this.say(`${selected.model.name} at ${Math.round(100 * selected.scale)} % of its size.`);
  }

  private remove(): void {
    const { selected } = this.scene;
    if (selected === null) return;
    this.scene.remove(selected);
    this.say(`${selected.model.name} removed.`);
  }

  private refresh(): void {
    const { placed, selected } = this.scene;
    this.list.replaceChildren(...placed.map((each) => new Option(each.id.replace(/-.*-/, " "), each.id, false, each === selected)));
    if (selected === null) this.list.selectedIndex = -1;
    this.list.disabled = placed.length === 0;
    byId("selected-tools").hidden = selected === null;
    this.placeButton.setAttribute("aria-pressed", String(this.isPlacing));
    this.frame.classList.toggle("handling", this.isPlacing || selected !== null);
    this.draw();
  }

  private draw(): void {
    const { selected } = this.scene;
    if (this.seen === null || selected === null) return drawGuide(this.guide, NO_LENS, NO_POSE, null);
    const { position, yaw_deg, scale, model } = selected;
    const standing = { position, yaw_deg, radius_m: model.radius_m * scale, height_m: model.height_m * scale };
    drawGuide(this.guide, this.seen.camera, this.seen.world_from_camera, standing);
  }
}

const NO_LENS = { width: 1, height: 1, fx: 1, fy: 1, cx: 0, cy: 0 };
const NO_POSE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

function words(right: number, away: number): string {
  const far = `${Math.round(100 * STEP_M * Math.max(Math.abs(right), Math.abs(away)))} cm`;
  return right !== 0 ? `${far} ${right > 0 ? "right" : "left"}` : `${far} ${away > 0 ? "away" : "nearer"}`;
}
