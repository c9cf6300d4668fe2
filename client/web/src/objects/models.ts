// What can be placed: shapes of the page's own, objects from the server's library, and files of the person's.

import { reasonOf } from "../capture/source";
import { tokenQuery } from "../connection";
import { make } from "../dom";
import { MAX_MESH_BYTES } from "../protocol";
import { toGlb } from "./glb";
import type { Model } from "./scene";
import { ball, cube, vase } from "./shapes";
import { fittingScale, sizeOf } from "./size";

/** Of a file whose size is not known here. */
const UNKNOWN_M = 0.2;
const FORMATS = ["glb", "obj", "ply", "stl"] as const;
type Format = (typeof FORMATS)[number];
const LIBRARY = "/v1/objects";

/** One line of `GET /v1/objects`. */
interface Listed {
  name: string;
  format: Format;
  size_bytes: number;
}

export class Models {
  /** By the option's value. */
  private readonly sources = new Map<string, () => Promise<Model>>();
  private readonly served = make("optgroup");
  private readonly token = tokenQuery(new URL(location.href));

  constructor(
    private readonly choice: HTMLSelectElement,
    private readonly say: (text: string) => void,
  ) {
    this.served.label = "from the server";
    for (const [name, shape, radius_m, height_m] of [
      ["Vase", vase(), 0.077, 0.24],
      ["Ball", ball(), 0.08, 0.16],
      ["Cube", cube(), 0.106, 0.15],
    ] as const) {
      this.offer(choice, name, () => Promise.resolve({ name, format: "glb", data: toGlb(shape), radius_m, height_m, scale: 1 }));
    }
    choice.addEventListener("change", () => void this.announce());
  }

  /** What is chosen; one of the server's is fetched the first time. Throws Error, one sentence. */
  chosen(): Promise<Model> {
    return this.sources.get(this.choice.value)!();
  }

  /** Ask the server what it has now. A server without a library has none. */
  async refresh(): Promise<void> {
    const listed = await fetch(LIBRARY + this.token).then(
      async (response) => (response.ok ? ((await response.json()) as { objects: Listed[] }).objects : []),
      () => [],
    );
    const { value } = this.choice;
    this.served.replaceChildren();
    for (const { name, format } of listed) this.offer(this.served, withoutFormat(name), onceWell(() => this.fetched(name, format)), `server:${name}`);
    if (listed.length > 0) this.choice.append(this.served);
    else this.served.remove();
    if (this.sources.has(value) && [...this.choice.options].some((option) => option.value === value)) this.choice.value = value;
    else this.choice.selectedIndex = 0;
  }

  /** Take a file that the person gives. */
  async read(file: File | undefined): Promise<void> {
    if (file === undefined) return;
    const dot = file.name.lastIndexOf(".");
    const format = FORMATS.find((each) => each === file.name.slice(dot + 1).toLowerCase());
    if (format === undefined) return this.say(`${file.name} is no model that can be placed: choose a .glb, .obj, .ply or .stl file.`);
    if (file.size > MAX_MESH_BYTES) return this.say(`${file.name} has ${Math.ceil(file.size / 2 ** 20)} MiB, more than the ${MAX_MESH_BYTES / 2 ** 20} MiB that the server takes.`);
    const model = modelOf(file.name.slice(0, dot) || "Model", format, new Uint8Array(await file.arrayBuffer()));
    this.offer(this.choice, model.name, () => Promise.resolve(model), `file:${model.name}`);
    this.choice.value = `file:${model.name}`;
    this.say(`${file.name} can be placed now${sizeInWords(model)}.`);
  }

  private offer(among: Element, name: string, source: () => Promise<Model>, value = name): void {
    this.sources.set(value, source);
    const option = [...this.choice.options].find((each) => each.value === value) ?? make("option", "", name);
    option.value = value;
    if (!option.isConnected) among.append(option);
  }

  /** Have one of the server's here before a finger asks for it. */
  private async announce(): Promise<void> {
    const { value } = this.choice;
    if (!value.startsWith("server:")) return;
    this.say("Fetching it from the server…");
    try {
      const { name } = await this.chosen();
      if (this.choice.value === value) this.say(`${name} can be placed now.`);
    } catch (error) {
      this.say(reasonOf(error));
    }
  }

  private async fetched(name: string, format: Format): Promise<Model> {
    const response = await fetch(`${LIBRARY}/${encodeURIComponent(name)}${this.token}`).catch(() => null);
    if (response === null) throw new Error("The server does not answer: try again when it is there.");
    if (!response.ok) throw new Error(`${name} cannot be fetched: ${(await response.text()).trim()}`);
    return modelOf(withoutFormat(name), format, new Uint8Array(await response.arrayBuffer()));
  }
}

export function modelOf(name: string, format: Format, data: Uint8Array<ArrayBuffer>): Model {
  const size = sizeOf(format, data);
  const [width, height, depth] = size ?? [UNKNOWN_M, UNKNOWN_M, UNKNOWN_M];
  return { name, format, data, radius_m: Math.hypot(width, depth) / 2, height_m: height, scale: size === null ? 1 : fittingScale(size, format) };
}

/** What a person should know of a model that is not shown in the size that its file says. */
function sizeInWords({ height_m, scale }: Model): string {
  return scale === 1 ? "" : `, ${Math.max(1, Math.round(100 * height_m * scale))} cm high (${scale.toPrecision(2)} times what the file says)`;
}

const withoutFormat = (name: string): string => name.slice(0, name.lastIndexOf("."));

/** Asked for once, unless that fails. */
function onceWell<T>(get: () => Promise<T>): () => Promise<T> {
  let known: Promise<T> | null = null;
  return () => {
    known ??= get().catch((error: unknown) => {
      known = null;
      throw error;
    });
    return known;
  };
}
