// The scan in three dimensions, with the camera's path, where it stands in this frame, and the light at places.

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  Group,
  Line,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshBasicMaterial,
  PerspectiveCamera,
  Points,
  PointsMaterial,
  Quaternion,
  Scene,
  SphereGeometry,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { exposureOf } from "../ball";
import { evaluate, toMatt, type Vector3 as Numbers } from "../sh";
import { fromBase64, type FrameRow, type LightRow, type RunData, type Scan } from "./data";

const AMBER = 0xffb454;
const BLUE = 0x56b4e9;
/** Of the scan's size: length of the frustum, radius of balls, length of arrows. */
const [FRUSTUM, BALL, ARROW] = [0.06, 0.022, 0.07];
/** Share of the points on each side, along each axis, that do not count for the scan's size. */
const OUTLIERS = 0.03;
/** Size of a point in cells: without gaps on a surface that is seen at a slant. */
const POINT = 2.3;
/** Vertical field of view of an overview. */
const FOV_DEG = 45;
/** Points that an overview is fitted to. */
const FITTED = 2000;
/** Share of the picture beyond what is fitted, and how often the fit is improved. */
const [MARGIN, ROUNDS] = [1.08, 30];
const KEY_TURN = Math.PI / 24;

export class Space {
  private readonly renderer: WebGLRenderer;
  private readonly gl: WebGL2RenderingContext;
  private readonly scene = new Scene();
  /** Holds what is in world axes; turned so that up is up. */
  private readonly world = new Group();
  private readonly camera: PerspectiveCamera;
  private readonly controls: OrbitControls;
  private readonly frustum: LineSegments;
  private readonly balls = new Map<number, Ball>();
  /** What an overview shows: the path and some of the points, up is +y. */
  private readonly content: readonly Vector3[];
  private readonly size: number;
  private pose: readonly number[] | null = null;
  private isThrough = false;
  /** Whether nobody has turned it since. */
  private isOverview = false;
  private drawing: Promise<void> | null = null;
  private isVisible = false;

  /** Throws Error where the browser has no WebGL. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly data: RunData,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true });
    this.gl = this.renderer.getContext();
    this.renderer.setClearColor(0x12161c, 1);
    const path = data.frames.flatMap(({ drawn }) => (drawn === null ? [] : [positionOf(drawn.pose)]));
    const places = data.scan === null ? null : placesOf(data.scan);
    this.world.quaternion.copy(new Quaternion().setFromUnitVectors(new Vector3(...data.up), new Vector3(0, 1, 0)));
    this.scene.add(this.world);
    const content = [...(places === null ? [] : mostOf(places)), ...path];
    this.content = content.map((each) => each.clone().applyQuaternion(this.world.quaternion));
    const { least, most } = boxOf(content);
    this.size = Math.max(0.2, least.distanceTo(most));
    this.camera = new PerspectiveCamera(FOV_DEG, 1, 0.002 * this.size, 20 * this.size);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => void this.redraw());
    this.controls.addEventListener("start", () => {
      this.leaveCamera();
      this.isOverview = false;
    });
    if (data.scan !== null && places !== null) this.world.add(pointsOf(data.scan, places));
    if (path.length > 1) this.world.add(pathOf(path));
    this.frustum = frustumOf(data.camera, FRUSTUM * this.size);
    this.world.add(this.frustum);
    new IntersectionObserver(([entry]) => {
      this.isVisible = entry?.isIntersecting ?? true;
      void this.redraw();
    }).observe(canvas);
    new ResizeObserver(() => this.fit()).observe(canvas);
    canvas.addEventListener("keydown", (event) => this.onKey(event));
    this.overview();
  }

  /** While frames are played, nothing is drawn that nobody sees. */
  isPlaying = false;
  /** Called with whether the view is the camera's, when that changes. */
  onThrough: (isThrough: boolean) => void = () => {};

  /** Show where the camera stands and the light of a frame; resolves when that is drawn, or nobody would see it. */
  show({ drawn, lights }: FrameRow): Promise<void> {
    this.pose = drawn?.pose ?? null;
    this.frustum.visible = this.pose !== null && drawn?.tracking !== "lost" && !this.isThrough;
    if (this.pose !== null) setPose(this.frustum, this.pose);
    for (const [place, ball] of this.balls) ball.group.visible = lights.some((light) => light.place === place);
    for (const light of lights) this.showLight(light);
    if (this.isThrough) this.lookThrough();
    return this.redraw();
  }

  /** All of the scan, from behind and above the first camera. */
  overview(): void {
    this.leaveCamera();
    const first = this.data.frames.find(({ drawn }) => drawn !== null)?.drawn?.pose;
    const turn = this.world.quaternion;
    const back = first === undefined ? new Vector3(0, 0, 1) : new Vector3(-first[2]!, -first[6]!, -first[10]!).applyQuaternion(turn);
    back.y = 0;
    if (back.length() < 0.05) back.set(0, 0, 1);
    back.normalize();
    const away = back.clone().add(new Vector3(back.z, 0, -back.x).multiplyScalar(0.35)).add(new Vector3(0, 0.6, 0)).normalize();
    this.camera.up.set(0, 1, 0);
    this.camera.fov = FOV_DEG;
    this.camera.updateProjectionMatrix();
    const { target, distance } = fitting(this.content, away, FOV_DEG, this.camera.aspect);
    this.controls.target.copy(target);
    this.camera.position.copy(target).add(away.multiplyScalar(distance));
    this.controls.update();
    this.isOverview = true;
    void this.redraw();
  }

  /** Look through the camera of the frame that is shown, and follow it. */
  through(): void {
    this.isThrough = true;
    this.isOverview = false;
    this.onThrough(true);
    this.lookThrough();
    void this.redraw();
  }

  private leaveCamera(): void {
    if (!this.isThrough) return;
    this.isThrough = false;
    this.camera.up.set(0, 1, 0);
    this.frustum.visible = this.pose !== null;
    this.onThrough(false);
  }

  private lookThrough(): void {
    if (this.pose === null) return;
    this.frustum.visible = false;
    const turn = this.world.quaternion;
    const column = (i: number): Vector3 => new Vector3(this.pose![i]!, this.pose![4 + i]!, this.pose![8 + i]!);
    const { height, fy } = this.data.camera;
    this.camera.fov = (2 * Math.atan(height / 2 / fy) * 180) / Math.PI;
    this.camera.updateProjectionMatrix();
    this.camera.position.copy(column(3).applyQuaternion(turn));
    this.camera.up.copy(column(1).multiplyScalar(-1).applyQuaternion(turn));
    const ahead = column(2).applyQuaternion(turn).multiplyScalar(0.4 * this.size);
    this.controls.target.copy(this.camera.position).add(ahead);
    this.camera.lookAt(this.controls.target);
  }

  private showLight(light: LightRow): void {
    const kind = this.data.tables.places[light.place]![0];
    if (light.at === null || kind === "beyond" || kind === "view") return;
    let ball = this.balls.get(light.place);
    if (ball === undefined) {
      ball = new Ball(BALL * this.size, ARROW * this.size);
      this.balls.set(light.place, ball);
      this.world.add(ball.group);
    }
    ball.show(light, light.at);
  }

  private onKey(event: KeyboardEvent): void {
    const turns: Record<string, [number, number, number]> = {
      ArrowLeft: [-KEY_TURN, 0, 1],
      ArrowRight: [KEY_TURN, 0, 1],
      ArrowUp: [0, -KEY_TURN, 1],
      ArrowDown: [0, KEY_TURN, 1],
      "+": [0, 0, 0.9],
      "=": [0, 0, 0.9],
      "-": [0, 0, 1 / 0.9],
    };
    const turn = turns[event.key];
    if (turn === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    this.leaveCamera();
    this.isOverview = false;
    this.turn(...turn);
  }

  private turn(around: number, over: number, zoom: number): void {
    const from = this.camera.position.clone().sub(this.controls.target);
    const distance = from.length() * zoom;
    const angle = Math.atan2(from.x, from.z) + around;
    const polar = Math.max(0.05, Math.min(Math.PI - 0.05, Math.acos(from.y / from.length()) + over));
    from.set(Math.sin(polar) * Math.sin(angle), Math.cos(polar), Math.sin(polar) * Math.cos(angle));
    this.camera.position.copy(this.controls.target).add(from.multiplyScalar(distance));
    this.controls.update();
    void this.redraw();
  }

  private fit(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.isOverview) this.overview();
    void this.redraw();
  }

  /** Draw before the next repaint, once however often it was asked for; resolves when it is drawn. */
  private redraw(): Promise<void> {
    if (this.isPlaying && !this.isVisible) return Promise.resolve();
    return (this.drawing ??= this.drawOnce());
  }

  private async drawOnce(): Promise<void> {
    await nextFrame();
    this.drawing = null; // what is asked for from now on is drawn again
    this.renderer.render(this.scene, this.camera);
    const sync = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    if (sync === null) return;
    this.gl.flush();
    while (this.gl.getSyncParameter(sync, this.gl.SYNC_STATUS) === this.gl.UNSIGNALED) await nextFrame();
    this.gl.deleteSync(sync);
  }
}

const nextFrame = (): Promise<unknown> => new Promise((done) => requestAnimationFrame(done));

/** A matt white ball in the light of a place, and an arrow from where most light comes. */
class Ball {
  readonly group = new Group();
  private readonly mesh: Mesh;
  private readonly arrow: Line;
  private shown: readonly number[] = [];

  constructor(
    private readonly radius: number,
    private readonly length: number,
  ) {
    const geometry = new SphereGeometry(radius, 24, 16);
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(3 * geometry.attributes.position.count), 3));
    this.mesh = new Mesh(geometry, new MeshBasicMaterial({ vertexColors: true }));
    this.arrow = new Line(new BufferGeometry(), new LineBasicMaterial({ color: AMBER }));
    this.group.add(this.mesh, this.arrow);
  }

  show(light: LightRow, at: Numbers): void {
    this.group.position.set(...at);
    if (this.shown === light.sh) return;
    this.shown = light.sh;
    const flat = Float64Array.from(light.sh);
    this.paint(toMatt(flat), exposureOf(flat));
    const towards = new Vector3(...light.towards);
    this.arrow.geometry.setFromPoints([this.radius, this.radius + this.length].map((reach) => towards.clone().multiplyScalar(reach)));
  }

  private paint(matt: Float64Array, exposure: number): void {
    const { position, color } = this.mesh.geometry.attributes;
    const rgb = new Float64Array(3);
    for (let i = 0; i < position.count; i++) {
      evaluate(matt, position.getX(i) / this.radius, position.getY(i) / this.radius, position.getZ(i) / this.radius, rgb);
      color!.setXYZ(i, ...(Array.from(rgb, (value) => 1 - Math.exp(-Math.max(0, value) * exposure)) as [number, number, number]));
    }
    color!.needsUpdate = true;
  }
}

function boxOf(content: readonly Vector3[]): { least: Vector3; most: Vector3 } {
  const [least, most] = [(content[0] ?? new Vector3()).clone(), (content[0] ?? new Vector3()).clone()];
  for (const each of content) {
    least.min(each);
    most.max(each);
  }
  return { least, most };
}

/** Some of the points, without those that lie far outside. */
function mostOf(places: Float32Array): Vector3[] {
  const [least, most] = [quantile(places, OUTLIERS), quantile(places, 1 - OUTLIERS)];
  const count = places.length / 3;
  const some = Array.from({ length: Math.min(count, FITTED) }, (_, i) => Math.floor((i * count) / Math.min(count, FITTED)));
  return some.map((i) => new Vector3(places[3 * i], places[3 * i + 1], places[3 * i + 2]).max(least).min(most));
}

/** Where to look, and from how far away in direction `away`, so that all content is in the picture and fills it. */
function fitting(content: readonly Vector3[], away: Vector3, fov_deg: number, aspect: number): { target: Vector3; distance: number } {
  const right = new Vector3(away.z, 0, -away.x).normalize();
  const over = new Vector3(away.y * right.z - away.z * right.y, away.z * right.x - away.x * right.z, away.x * right.y - away.y * right.x);
  const tall = Math.tan((fov_deg * Math.PI) / 360);
  const seen = content.map((each) => new Vector3(each.dot(right), each.dot(over), each.dot(away)));
  const { least, most } = boxOf(seen);
  const middle = least.clone().add(most).multiplyScalar(0.5);
  const reach = ({ x, y, z }: Vector3): number => Math.max(Math.abs(x - middle.x) / aspect, Math.abs(y - middle.y)) / tall + z - middle.z;
  let distance = Math.max(0.1, MARGIN * seen.reduce((most, each) => Math.max(most, reach(each)), 0));
  let best = { middle: middle.clone(), distance }; // all is in the picture, but perhaps not in its middle
  for (let round = 0; round < ROUNDS; round++) {
    const drawn = boxOf(seen.map((each) => projected(each, middle, distance)));
    const sides = [drawn.most.x, -drawn.least.x, drawn.most.y * aspect, -drawn.least.y * aspect];
    if (distance < best.distance && Math.max(...sides) <= tall * aspect) best = { middle: middle.clone(), distance };
    const filled = Math.max((drawn.most.x - drawn.least.x) / aspect, drawn.most.y - drawn.least.y) / (2 * tall);
    middle.x += ((drawn.least.x + drawn.most.x) / 4) * distance;
    middle.y += ((drawn.least.y + drawn.most.y) / 4) * distance;
    distance *= (1 + MARGIN * filled) / 2; // by half the way, as what is near moves most
  }
  const { x, y, z } = best.middle;
  const target = right.clone().multiplyScalar(x).add(over.clone().multiplyScalar(y)).add(away.clone().multiplyScalar(z));
  return { target, distance: best.distance };
}

/** On a plane at distance 1 from the eye, which is `distance` from `middle`; what is nearly behind the eye counts as near. */
function projected(place: Vector3, middle: Vector3, distance: number): Vector3 {
  const depth = Math.max(0.05 * distance, distance - (place.z - middle.z));
  return new Vector3((place.x - middle.x) / depth, (place.y - middle.y) / depth, 0);
}

function quantile(places: Float32Array, share: number): Vector3 {
  const [x, y, z] = [0, 1, 2].map((axis) => {
    const values = Float32Array.from({ length: places.length / 3 }, (_, i) => places[3 * i + axis]!).sort();
    return values[Math.floor(share * (values.length - 1))]!;
  });
  return new Vector3(x, y, z);
}

/** World, metres. */
function placesOf(scan: Scan): Float32Array {
  const steps = new Uint16Array(fromBase64(scan.places).buffer);
  return Float32Array.from(steps, (step, i) => scan.least[i % 3]! + ((scan.most[i % 3]! - scan.least[i % 3]!) * step) / 65535);
}

function pointsOf(scan: Scan, places: Float32Array): Points {
  const codes = fromBase64(scan.colors);
  const colors = new Float32Array(3 * scan.count);
  const color = new Color();
  for (let i = 0; i < scan.count; i++) {
    color.setRGB(codes[3 * i]! / 255, codes[3 * i + 1]! / 255, codes[3 * i + 2]! / 255, "srgb").toArray(colors, 3 * i);
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(places, 3));
  geometry.setAttribute("color", new BufferAttribute(colors, 3));
  return new Points(geometry, new PointsMaterial({ size: POINT * scan.cell_m, vertexColors: true }));
}

const pathOf = (path: readonly Vector3[]): Line => new Line(new BufferGeometry().setFromPoints([...path]), new LineBasicMaterial({ color: BLUE }));

const positionOf = (pose: readonly number[]): Vector3 => new Vector3(pose[3], pose[7], pose[11]);

function frustumOf({ width, height, fx, fy, cx, cy }: RunData["camera"], length: number): LineSegments {
  const corner = (u: number, v: number): Vector3 => new Vector3(((u - cx) / fx) * length, ((v - cy) / fy) * length, length);
  const corners = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
  const eye = new Vector3();
  const lines = corners.flatMap((each, i) => [eye, each, each, corners[(i + 1) % 4]!]);
  const frustum = new LineSegments(new BufferGeometry().setFromPoints(lines), new LineBasicMaterial({ color: AMBER }));
  frustum.matrixAutoUpdate = false;
  return frustum;
}

function setPose(object: LineSegments, pose: readonly number[]): void {
  object.matrix.set(...(pose as unknown as Twelve), 0, 0, 0, 1);
  object.matrixWorldNeedsUpdate = true;
}

type Twelve = [number, number, number, number, number, number, number, number, number, number, number, number];
