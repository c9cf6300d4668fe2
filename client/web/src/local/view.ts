// Light mode: the server sends the room's light alone, and the device draws the objects itself, with three.js.

import { Box3, Camera, Group, LightProbe, type Looks, type Mesh, MeshLambertMaterial, type Object3D, Scene, SRGBColorSpace, WebGLRenderer, WebGLRenderTarget } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { reasonOf } from "../capture/source";
import type { XrLayer, XrView } from "../capture/xr";
import type { Model, Placed } from "../objects/scene";
import type { Rgb } from "../sh";

/** Coefficients of a LightProbe: ours, in the same order and basis, up to l = 2. */
const COEFFICIENTS = 9;

/** An object in a scene of its own, as a light probe lights all of its scene. */
interface Shown {
  scene: Scene;
  probe: LightProbe;
  group: Group;
}

export class LocalView {
  private readonly renderer: WebGLRenderer;
  private readonly camera = new Camera();
  private readonly shown = new Map<string, Shown>();
  private target: WebGLRenderTarget | null = null;

  /** `gl`: the context of the session's layer. `say`: told what cannot be drawn. */
  constructor(
    gl: WebGL2RenderingContext,
    private readonly say: (text: string) => void,
  ) {
    this.renderer = new WebGLRenderer({ canvas: gl.canvas, context: gl });
    this.renderer.setClearColor(0, 0);
    this.renderer.autoClear = false; // the scenes share one depth buffer
    this.camera.matrixAutoUpdate = this.camera.matrixWorldAutoUpdate = false;
    this.renderer.resetState();
  }

  /** `shOf`: radiance coefficients at an object's place, in the axes of the session's space. */
  setLight(shOf: (id: string) => readonly Rgb[]): void {
    for (const [id, { probe }] of this.shown) {
      const sh = shOf(id);
      for (let i = 0; i < COEFFICIENTS; i++) probe.sh.coefficients[i]!.set(...(sh[i] ?? [0, 0, 0]));
    }
  }

  /** These objects and no others, where they stand. */
  setObjects(placed: readonly Placed[]): void {
    for (const id of [...this.shown.keys()]) {
      if (!placed.some((each) => each.id === id)) this.shown.delete(id);
    }
    for (const each of placed) {
      const { group } = this.shown.get(each.id) ?? this.show(each);
      group.position.set(...each.position);
      group.rotation.y = (each.yaw_deg * Math.PI) / 180;
      group.scale.setScalar(each.scale);
    }
  }

  /** Draw over what the device shows of the room. */
  draw(view: XrView, layer: XrLayer): void {
    const { renderer, camera } = this;
    const target = this.targetOf(layer);
    camera.projectionMatrix.fromArray(view.projectionMatrix);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    camera.matrixWorld.fromArray(view.transform.matrix);
    camera.matrixWorldInverse.copy(camera.matrixWorld).invert();
    renderer.setRenderTargetFramebuffer(target, layer.framebuffer);
    renderer.setRenderTarget(target);
    renderer.clear();
    for (const { scene } of this.shown.values()) renderer.render(scene, camera);
    renderer.setRenderTarget(null);
    renderer.resetState(); // others use this context too
  }

  private targetOf({ framebufferWidth: width, framebufferHeight: height }: XrLayer): WebGLRenderTarget {
    if (this.target?.width === width && this.target.height === height) return this.target;
    this.target = new WebGLRenderTarget(width, height);
    this.target.isXRRenderTarget = true; // what is drawn is seen as it is: sRGB
    this.target.texture.colorSpace = SRGBColorSpace;
    return this.target;
  }

  private show({ id, model }: Placed): Shown {
    const shown = { scene: new Scene(), probe: new LightProbe(), group: new Group() };
    const { scene, probe, group } = shown;
    this.shown.set(id, shown);
    scene.add(probe, group);
    this.load(model).then(
      (loaded) => group.add(loaded),
      (error: unknown) => this.say(`${model.name} cannot be drawn here: ${reasonOf(error)}`),
    );
    return shown;
  }

  /** The model with the middle of its box's bottom at the origin; each call gives another one. */
  private async load(model: Model): Promise<Group> {
    if (model.format !== "glb") throw new Error("in light mode models are .glb files");
    const { scene } = await new GLTFLoader().parseAsync(model.data.slice().buffer, "");
    const { min, max } = new Box3().setFromObject(scene);
    scene.traverse(makeMatt);
    scene.position.set(-(min.x + max.x) / 2, -min.y, -(min.z + max.z) / 2);
    return scene;
  }
}

/** A probe lights what is matt; what shines would lose the light that it mirrors, and there is no mirror image here. */
function makeMatt(object: Object3D): void {
  if (!("isMesh" in object)) return;
  const mesh = object as Mesh;
  const materials = [mesh.material].flat() as Looks[];
  const matt = materials.map(
    ({ color, map, normalMap, emissive, emissiveMap, vertexColors, transparent, opacity, alphaTest, side, flatShading }) =>
      new MeshLambertMaterial({ color, map, normalMap, emissive, emissiveMap, vertexColors, transparent, opacity, alphaTest, side, flatShading }),
  );
  mesh.material = Array.isArray(mesh.material) ? matt : matt[0]!;
}
