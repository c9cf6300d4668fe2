// The page's side of light mode: fetches what draws, and keeps it told.

import { reasonOf } from "./capture/source";
import type { Draw } from "./capture/xr_source";
import { lightOf } from "./lighting";
import type { LocalView } from "./local/view";
import type { Placed } from "./objects/scene";
import type { Light } from "./protocol";

export class LightMode {
  private view: LocalView | null = null;
  private light: Light | null = null;

  private constructor(
    private readonly module: typeof import("./local/view"),
    private readonly objects: () => readonly Placed[],
    private readonly say: (text: string) => void,
  ) {}

  /** Throws Error where what draws cannot be fetched. */
  static async load(objects: () => readonly Placed[], say: (text: string) => void): Promise<LightMode> {
    try {
      return new LightMode(await import("./local/view"), objects, say);
    } catch (error) {
      throw new Error(`What draws objects on this device cannot be fetched: ${reasonOf(error)}`);
    }
  }

  setLight(light: Light): void {
    this.light = light;
  }

  readonly draw: Draw = (view, layer, gl) => {
    this.view ??= new this.module.LocalView(gl, this.say);
    const { light } = this;
    this.view.setObjects(light === null ? [] : this.objects());
    if (light !== null) this.view.setLight((id) => lightOf(light, id).sh);
    this.view.draw(view, layer);
  };
}
