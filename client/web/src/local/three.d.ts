// What is used of three.js, which has no types of its own.

declare module "three" {
  export const SRGBColorSpace: string;
  export class Vector3 {
    x: number;
    y: number;
    z: number;
    set(x: number, y: number, z: number): this;
  }
  export class Matrix4 {
    fromArray(values: ArrayLike<number>): this;
    copy(other: Matrix4): this;
    invert(): this;
  }
  export class Object3D {
    readonly position: Vector3;
    readonly rotation: { y: number };
    readonly scale: { setScalar(value: number): void };
    readonly matrixWorld: Matrix4;
    matrixAutoUpdate: boolean;
    matrixWorldAutoUpdate: boolean;
    add(...children: Object3D[]): this;
    remove(...children: Object3D[]): this;
    traverse(visit: (object: Object3D) => void): void;
  }
  /** As far as one looks like another. */
  export interface Looks {
    color: unknown;
    map: unknown;
    normalMap: unknown;
    emissive: unknown;
    emissiveMap: unknown;
    vertexColors: boolean;
    transparent: boolean;
    opacity: number;
    alphaTest: number;
    side: number;
    flatShading: boolean;
  }
  export class MeshLambertMaterial {
    constructor(looks: Looks);
  }
  export class Mesh extends Object3D {
    readonly isMesh: true;
    material: Looks | Looks[] | MeshLambertMaterial | MeshLambertMaterial[];
  }
  export class Group extends Object3D {}
  export class Scene extends Object3D {}
  export class Camera extends Object3D {
    readonly projectionMatrix: Matrix4;
    readonly projectionMatrixInverse: Matrix4;
    readonly matrixWorldInverse: Matrix4;
  }
  export class LightProbe extends Object3D {
    readonly sh: { coefficients: Vector3[] };
  }
  export class Box3 {
    readonly min: Vector3;
    readonly max: Vector3;
    setFromObject(object: Object3D): this;
  }
  export class WebGLRenderTarget {
    constructor(width: number, height: number);
    readonly width: number;
    readonly height: number;
    isXRRenderTarget: boolean;
    readonly texture: { colorSpace: string };
    dispose(): void;
  }
  export class WebGLRenderer {
    constructor(options: { canvas: HTMLCanvasElement | OffscreenCanvas; context: WebGL2RenderingContext });
    outputColorSpace: string;
    autoClear: boolean;
    clear(): void;
    setClearColor(color: number, alpha: number): void;
    setRenderTarget(target: WebGLRenderTarget | null): void;
    setRenderTargetFramebuffer(target: WebGLRenderTarget, framebuffer: WebGLFramebuffer | null): void;
    render(scene: Object3D, camera: Camera): void;
    resetState(): void;
  }
}

declare module "three/addons/loaders/GLTFLoader.js" {
  import type { Group } from "three";
  export class GLTFLoader {
    parseAsync(data: ArrayBuffer, path: string): Promise<{ scene: Group }>;
  }
}
