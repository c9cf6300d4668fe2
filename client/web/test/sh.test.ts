// The harmonics the page draws with, at directions where their values are known, and integrated over the sphere.

import assert from "node:assert/strict";
import { test } from "node:test";
import { exposureOf, paintBall, BALL_PX, toneMap } from "../src/ball";
import { COEFFICIENTS, evaluate, evaluateBasis, flatten, toCamera, toMatt, toWorld } from "../src/sh";

const close = (actual: number, expected: number, tolerance = 1e-12): void =>
  assert.ok(Math.abs(actual - expected) <= tolerance, `${actual} is not ${expected}`);

function basis(x: number, y: number, z: number): Float64Array {
  const out = new Float64Array(COEFFICIENTS);
  evaluateBasis(x, y, z, out);
  return out;
}

test("values along the axes", () => {
  const n = (factor: number, divisor: number): number => Math.sqrt(factor / (divisor * Math.PI));
  const alongX = basis(1, 0, 0);
  close(alongX[0]!, n(1, 4));
  close(alongX[3]!, n(3, 4)); // Y_11 = +0.488603 x: no Condon-Shortley phase
  close(alongX[6]!, -n(5, 16));
  close(alongX[8]!, n(15, 16));
  close(alongX[13]!, -n(21, 32));
  close(alongX[15]!, n(35, 32));
  const alongY = basis(0, 1, 0);
  close(alongY[1]!, n(3, 4));
  close(alongY[8]!, -n(15, 16));
  close(alongY[9]!, -n(35, 32));
  const alongZ = basis(0, 0, 1);
  close(alongZ[2]!, n(3, 4));
  close(alongZ[6]!, n(5, 4));
  close(alongZ[12]!, n(7, 4));
  for (const i of [1, 3, 4, 5, 7, 8, 9, 10, 11, 13, 14, 15]) close(alongZ[i]!, 0);
});

test("values between the axes", () => {
  const s = Math.SQRT1_2;
  close(basis(s, s, 0)[4]!, Math.sqrt(15 / (4 * Math.PI)) / 2);
  close(basis(0, s, s)[5]!, Math.sqrt(15 / (4 * Math.PI)) / 2);
  close(basis(s, 0, s)[7]!, Math.sqrt(15 / (4 * Math.PI)) / 2);
  const t = 1 / Math.sqrt(3);
  close(basis(t, t, t)[10]!, Math.sqrt(105 / (4 * Math.PI)) * t ** 3);
  close(basis(s, 0, s)[14]!, (Math.sqrt(105 / (16 * Math.PI)) * s) / 2);
});

/** Exact to degree 7: three Gauss-Legendre rings would do for degree 5, so four, and 16 meridians. */
const GAUSS = [
  [0.3399810435848563, 0.6521451548625461],
  [0.8611363115940526, 0.3478548451374538],
] as const;

function integrate(f: (x: number, y: number, z: number) => number): number {
  let sum = 0;
  for (const [node, weight] of GAUSS)
    for (const z of [node, -node])
      for (let k = 0; k < 16; k++) {
        const phi = (2 * Math.PI * (k + 0.5)) / 16;
        const ring = Math.sqrt(1 - z * z);
        sum += weight * ((2 * Math.PI) / 16) * f(ring * Math.cos(phi), ring * Math.sin(phi), z);
      }
  return sum;
}

test("the basis is orthonormal", () => {
  for (let i = 0; i < COEFFICIENTS; i++)
    for (let j = 0; j <= i; j++)
      close(integrate((x, y, z) => basis(x, y, z)[i]! * basis(x, y, z)[j]!), i === j ? 1 : 0, 1e-9);
});

test("a uniform sky of radiance 1 is 1 everywhere, and shades white to 1", () => {
  const sky = flatten([[Math.sqrt(4 * Math.PI), Math.sqrt(4 * Math.PI), Math.sqrt(4 * Math.PI)]]);
  const rgb = new Float64Array(3);
  for (const flat of [sky, toMatt(sky)]) {
    evaluate(flat, 0.6, 0, -0.8, rgb);
    for (const value of rgb) close(value, 1, 1e-9);
  }
});

test("a matt surface sends back the cosine-weighted light, band by band", () => {
  const single = flatten([[0, 0, 0], [0, 0, 0], [1, 0, 0]]); // radiance Y_10 in red
  const rgb = new Float64Array(3);
  evaluate(toMatt(single), 0, 0, 1, rgb);
  const y10 = Math.sqrt(3 / (4 * Math.PI));
  const byIntegral = 2 * y10 * (1 / 3); // 1/pi times the integral of y10 z * z over the upper half sphere
  close(rgb[0]!, byIntegral, 1e-12);
  close(rgb[1]!, 0);
});

test("directions go to the world and back", () => {
  const m = [0, 0, 1, 5, 1, 0, 0, 6, 0, 1, 0, 7, 0, 0, 0, 1]; // rotation: camera z is world x
  assert.deepEqual(toWorld(m, [0, 0, 1]), [1, 0, 0]);
  assert.deepEqual(toCamera(m, toWorld(m, [0.2, -0.3, 0.9])), [0.2, -0.3, 0.9]);
});

test("the ball is bright where the light is, seen from the camera", () => {
  const fromAbove = flatten([[1, 1, 1], [-1, -1, -1]]); // OpenCV world: up is -y
  const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const pixels = paintBall(fromAbove, identity, exposureOf(fromAbove));
  const red = (x: number, y: number): number => pixels[4 * (y * BALL_PX + x)]!;
  const half = BALL_PX / 2;
  assert.ok(red(half, 40) > red(half, half) && red(half, half) > red(half, BALL_PX - 40));
  assert.equal(pixels[3], 0);
  assert.equal(pixels[4 * (half * BALL_PX + half) + 3], 255);
});

test("tone mapping keeps black black and never overflows", () => {
  assert.equal(toneMap(-1, 1), 0);
  assert.equal(toneMap(1e9, 1), 255);
  assert.ok(toneMap(0.5, 1) < toneMap(1, 1));
});
