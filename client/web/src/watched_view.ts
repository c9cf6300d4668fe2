// What somebody who watches sees, as far as placing needs it: the lens, where the camera is, and what is up.

import type { Seen } from "./objects/picking";
import type { CameraModel, Composite } from "./protocol";
import type { Vector3 } from "./sh";

export class WatchedView {
  private camera: CameraModel | null = null;
  private up: Vector3 | null = null;

  /** Another session is watched; null: none, or a server that does not tell the lens. */
  begin(camera: CameraModel | null): void {
    this.camera = camera;
    this.up = null;
  }

  noteUp(up: Vector3): void {
    this.up = up;
  }

  /** Null: nothing can be placed in this picture. */
  seenIn({ world_from_camera }: Pick<Composite, "world_from_camera">): Seen | null {
    const { camera, up } = this;
    return camera === null || up === null ? null : { camera, world_from_camera, up, depth: null };
  }
}
