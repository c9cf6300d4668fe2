// What is used of three.js, which has no types of its own.

declare module "three" {
  export const SRGBColorSpace: string;
  export class Vector3 {
    constructor(x?: number, y?: number, z?: number);
    x: number;
    y: number;
    z: number;
    set(x: number, y: number, z: number): this;
    copy(other: Vector3): this;
    clone(): Vector3;
    add(other: Vector3): this;
    sub(other: Vector3): this;
    min(other: Vector3): this;
    max(other: Vector3): this;
    multiplyScalar(factor: number): this;
    applyQuaternion(turn: Quaternion): this;
    normalize(): this;
    length(): number;
    distanceTo(other: Vector3): number;
    dot(other: Vector3): number;
  }
  export class Quaternion {
    copy(other: Quaternion): this;
    setFromUnitVectors(from: Vector3, to: Vector3): this;
  }
  export class Color {
    setRGB(red: number, green: number, blue: number, space: string): this;
    toArray(to: Float32Array, offset: number): void;
  }
  export class Matrix4 {
    /** Row-major. */
    set(...values: number[]): this;
    fromArray(values: ArrayLike<number>): this;
    copy(other: Matrix4): this;
    invert(): this;
  }
  export class Object3D {
    readonly position: Vector3;
    readonly quaternion: Quaternion;
    readonly matrix: Matrix4;
    readonly up: Vector3;
    visible: boolean;
    matrixWorldNeedsUpdate: boolean;
    readonly rotation: { y: number };
    readonly scale: { setScalar(value: number): void };
    readonly matrixWorld: Matrix4;
    matrixAutoUpdate: boolean;
    matrixWorldAutoUpdate: boolean;
    add(...children: Object3D[]): this;
    remove(...children: Object3D[]): this;
    traverse(visit: (object: Object3D) => void): void;
    lookAt(place: Vector3): void;
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
  export class BufferAttribute {
    constructor(values: Float32Array, itemSize: number);
    readonly count: number;
    needsUpdate: boolean;
    getX(index: number): number;
    getY(index: number): number;
    getZ(index: number): number;
    setXYZ(index: number, x: number, y: number, z: number): this;
  }
  export class BufferGeometry {
    readonly attributes: { position: BufferAttribute; color?: BufferAttribute };
    setAttribute(name: "position" | "color", values: BufferAttribute): this;
    setFromPoints(points: Vector3[]): this;
  }
  export class SphereGeometry extends BufferGeometry {
    constructor(radius: number, columns: number, rows: number);
  }
  export class MeshBasicMaterial {
    constructor(looks: { vertexColors: boolean });
  }
  export class LineBasicMaterial {
    constructor(looks: { color: number });
  }
  export class PointsMaterial {
    constructor(looks: { size: number; vertexColors: boolean });
  }
  export class Mesh extends Object3D {
    constructor(geometry: BufferGeometry, material: MeshBasicMaterial);
    readonly isMesh: true;
    readonly geometry: BufferGeometry;
    material: Looks | Looks[] | MeshLambertMaterial | MeshLambertMaterial[];
  }
  export class Line extends Object3D {
    constructor(geometry: BufferGeometry, material: LineBasicMaterial);
    readonly geometry: BufferGeometry;
  }
  export class LineSegments extends Line {}
  export class Points extends Object3D {
    constructor(geometry: BufferGeometry, material: PointsMaterial);
  }
  export class Group extends Object3D {}
  export class Scene extends Object3D {}
  export class Camera extends Object3D {
    readonly projectionMatrix: Matrix4;
    readonly projectionMatrixInverse: Matrix4;
    readonly matrixWorldInverse: Matrix4;
  }
  export class PerspectiveCamera extends Camera {
    constructor(fov: number, aspect: number, near: number, far: number);
    fov: number;
    aspect: number;
    updateProjectionMatrix(): void;
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
    constructor(options: { canvas: HTMLCanvasElement | OffscreenCanvas; context?: WebGL2RenderingContext; antialias?: boolean });
    getContext(): WebGL2RenderingContext;
    setPixelRatio(ratio: number): void;
    setSize(width: number, height: number, updateStyle: boolean): void;
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

declare module "three/addons/controls/OrbitControls.js" {
  import type { Camera, Vector3 } from "three";
  export class OrbitControls {
    constructor(camera: Camera, element: HTMLElement);
    readonly target: Vector3;
    update(): void;
    addEventListener(name: "change" | "start", listener: () => void): void;
  }
}
