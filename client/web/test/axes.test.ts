// WebXR's conventions against the wire's: a point of the world is found where both say that it is.

import assert from "node:assert/strict";
import { test } from "node:test";
import { depthLens, depthUnits, isSameCamera, lensOf, upright, worldFromCamera } from "../src/capture/axes";
import { fitted, halvings } from "../src/capture/readback";
import { floorOf, levelAt, project, surfaceAt, uprightAxes } from "../src/objects/picking";

/** Column-major: a camera that is turned by 90 degrees about +y and looks along -x. */
const TURNED = new Float32Array([0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 2, 3, 4, 1]);
/** An unsymmetric frustum. */
const PROJECTION = new Float32Array([1.5, 0, 0, 0, 0, 2, 0, 0, 0.1, -0.2, -1, -1, 0, 0, -0.1, 0]);

/** Where WebXR itself sees a point: 0 to 1, y down. */
function inView(point: readonly [number, number, number]): [number, number] {
  const at = (row: number, column: number): number => TURNED[4 * column + row]!;
  const offset = point.map((value, i) => value - at(i, 3));
  const camera = [0, 1, 2].map((column) => offset.reduce((sum, value, row) => sum + value * at(row, column), 0));
  const clip = [0, 1, 3].map((row) => camera.reduce((sum, value, column) => sum + PROJECTION[4 * column + row]! * value, PROJECTION[12 + row]!));
  return [(clip[0]! / clip[2]! + 1) / 2, (1 - clip[1]! / clip[2]!) / 2];
}

const POINT = [-0.5, 3.4, 3.7] as const;

test("a point is seen where WebXR sees it", () => {
  const [x, y] = inView(POINT);
  const pixel = project(lensOf(PROJECTION, 640, 480), worldFromCamera(TURNED), POINT)!;
  assert.ok(Math.abs(pixel.x - (640 * x - 0.5)) < 1e-4, `${pixel.x}`);
  assert.ok(Math.abs(pixel.y - (480 * y - 0.5)) < 1e-4, `${pixel.y}`);
});

/** Normalised buffer from normalised view: as it is, and turned by quarters, mirrored and cut. Column-major. */
const affine = (a: number, b: number, c: number, d: number, x: number, y: number): Float32Array =>
  new Float32Array([a, c, 0, 0, b, d, 0, 0, 0, 0, 1, 0, x, y, 0, 1]);
const MATRICES = [
  affine(1, 0, 0, 1, 0, 0),
  affine(-0.8, 0, 0, 0.9, 0.95, 0.05),
  affine(0, 1, -1, 0, 0, 1),
  affine(0, -0.7, 0.9, 0, 0.85, 0.02),
];

MATRICES.forEach((matrix, i) => {
  test(`depth ${i} is upright, every value of it, and its lens says where each is in the view`, () => {
    const [width, height] = [8, 5];
    const units = Uint16Array.from({ length: width * height }, (_, at) => 100 + at);
    const found = upright(units, width, height, matrix);
    assert.deepEqual([...found.units].sort((a, b) => a - b), [...units]);
    const color = { width: 640, height: 480, fx: 500, fy: 510, cx: 300, cy: 250 };
    const lens = depthLens(color, found);
    for (const [x, y] of [[0.31, 0.42], [0.55, 0.77], [0.8, 0.3]] as const) {
      const column = Math.floor(width * (matrix[0]! * x + matrix[4]! * y + matrix[12]!));
      const row = Math.floor(height * (matrix[1]! * x + matrix[5]! * y + matrix[13]!));
      const [right, down] = [(640 * x - 0.5 - color.cx) / color.fx, (480 * y - 0.5 - color.cy) / color.fy];
      const u = Math.round(lens.cx + lens.fx * right);
      const v = Math.round(lens.cy + lens.fy * down);
      assert.equal(found.units[v * found.width + u], units[row * width + column]);
    }
  });
});

test("depth that is turned by no quarter is refused", () => {
  assert.throws(() => upright(new Uint16Array(4), 2, 2, affine(0.7, 0.7, -0.7, 0.7, 0, 0)), /askew/);
});

test("depth in metres becomes millimetres, and nothing where it cannot", () => {
  const depth = { data: new Float32Array([1.2345, 0, Number.NaN, 70, -1]).buffer, width: 5, height: 1, rawValueToMeters: 1 };
  const { units, scale_m } = depthUnits({ ...depth, normDepthBufferFromNormView: { matrix: MATRICES[0]! } }, "float32");
  assert.deepEqual([[...units], scale_m], [[1235, 0, 0, 0, 0], 0.001]);
});

test("a session goes on with the same camera only", () => {
  const camera = { ...lensOf(PROJECTION, 640, 480), depth_scale_m: 0.001, depth: null };
  assert.ok(isSameCamera(camera, { ...camera, fx: camera.fx + 0.5 }));
  assert.ok(!isSameCamera(camera, { ...camera, fx: camera.fx + 5 }));
  assert.ok(!isSameCamera(camera, { ...camera, width: 480, height: 640 }));
});

test("pictures shrink by halves to their size", () => {
  assert.deepEqual(fitted({ width: 1920, height: 1080 }, 640), { width: 640, height: 360 });
  assert.deepEqual(fitted({ width: 320, height: 240 }, 640), { width: 320, height: 240 });
  assert.deepEqual(halvings({ width: 1920, height: 1080 }, { width: 640, height: 360 }), [{ width: 960, height: 540 }, { width: 640, height: 360 }]);
  assert.deepEqual(halvings({ width: 64, height: 48 }, { width: 64, height: 48 }), [{ width: 64, height: 48 }]);
});

test("a finger finds the surface, or the level where none was measured", () => {
  const camera = { width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, depth_scale_m: 0.001, depth: null };
  const world_from_camera = [1, 0, 0, 0, 0, -1, 0, 1.5, 0, 0, -1, 0, 0, 0, 0, 1]; // 1.5 m up, looking along -z
  const depth = new Uint16Array(64 * 48).fill(2000);
  depth.fill(0, 64 * 30);
  const [x, y, z] = surfaceAt({ camera, world_from_camera, depth }, { x: 31.5, y: 13.5 })!;
  assert.ok(Math.hypot(x, y - 1.9, z + 2) < 1e-9);
  assert.equal(surfaceAt({ camera, world_from_camera, depth }, { x: 31.5, y: 45 }), null);
  const up = [0, 1, 0] as const;
  const [fx, fy, fz] = levelAt({ camera, world_from_camera, up }, { x: 31.5, y: 48.5 }, 0)!;
  assert.ok(Math.hypot(fx, fy, fz + 3) < 1e-9);
  assert.equal(levelAt({ camera, world_from_camera, up }, { x: 31.5, y: 10 }, 0), null); // above the horizon
});

test("what is level is so in any world", () => {
  const camera = { width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, depth_scale_m: 0.001, depth: null };
  const world_from_camera = [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 1.5, 0, 0, 0, 1]; // 1.5 m up along z, looking along y
  const up = [0, 0, 1] as const;
  const place = levelAt({ camera, world_from_camera, up }, { x: 31.5, y: 48.5 }, 0)!;
  assert.ok(Math.hypot(place[0], place[1] - 3, place[2]) < 1e-9, `${place.join(" ")}`);
  const depth = new Uint16Array(64 * 48).fill(2000);
  assert.ok(Math.abs(floorOf({ camera, world_from_camera, up, depth })! - (1.5 - (2 * 24.5) / 50)) < 0.06);
  assert.deepEqual(uprightAxes(up).map((axis) => axis.map(Math.round)), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]);
  assert.deepEqual(uprightAxes([1, 0, 0]).map((axis) => axis.map(Math.round)), [[0, 1, 0], [1, 0, 0], [0, 0, -1]]);
});

test("a lens of depth beside the camera's own sees the surface from there", () => {
  const lens = { width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5 };
  const color_from_depth = [1, 0, 0, 0.2, 0, 1, 0, 0, 0, 0, 1, 0.05, 0, 0, 0, 1]; // 20 cm to the right, 5 cm ahead
  const camera = { ...lens, depth_scale_m: 0.001, depth: { ...lens, color_from_depth } };
  const world_from_camera = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const wall = (point: readonly [number, number, number]): number => point[2] - 0.5 * point[0] - 2; // 0 on it
  const depth = Uint16Array.from({ length: 64 * 48 }, (_, i) => {
    const right = ((i % 64) - lens.cx) / lens.fx;
    return Math.round((1000 * (2 + 0.5 * 0.2 - 0.05)) / (1 - 0.5 * right));
  });
  for (const pixel of [{ x: 20, y: 10 }, { x: 31.5, y: 23.5 }, { x: 45, y: 40 }]) {
    const place = surfaceAt({ camera, world_from_camera, depth }, pixel)!;
    assert.ok(Math.abs(wall([place[0], place[1], place[2]])) < 0.03, `${place.join(" ")}`);
    assert.ok(Math.abs(lens.fx * (place[0] / place[2]) + lens.cx - pixel.x) < 1e-6);
  }
});
