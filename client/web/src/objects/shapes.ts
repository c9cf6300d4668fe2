// What can be placed without a file: turned on a lathe, or a box.

import type { Shape } from "./glb";

type Rgb = readonly [number, number, number];

const SEGMENTS = 48;

/** Height and radius, in metres, from the middle of the foot up the outside and down the inside; two rings where the colour changes. */
const VASE: readonly (readonly [number, number])[] = [
  [0, 0], [0, 0.046], [0.008, 0.05], [0.0195, 0.0423], [0.0205, 0.0423], [0.032, 0.0487], [0.045, 0.056], [0.065, 0.0664],
  [0.085, 0.074], [0.1075, 0.0767], [0.1085, 0.0768], [0.12, 0.077], [0.1315, 0.0744], [0.1325, 0.074], [0.15, 0.064],
  [0.166, 0.0495], [0.18, 0.036], [0.205, 0.029], [0.225, 0.036], [0.24, 0.048], [0.238, 0.044], [0.215, 0.027], [0.19, 0.024], [0.17, 0],
];
const BALL_RADIUS_M = 0.08;
const BALL_RINGS = 24;
const CUBE_SIDE_M = 0.15;

export function vase(): Shape {
  return turned(VASE, (height) => (height < 0.02 ? [170, 92, 60] : Math.abs(height - 0.12) < 0.012 ? [226, 196, 120] : [38, 92, 138]));
}

/** Matt and white: its shading is the room's light. */
export function ball(): Shape {
  const outline = Array.from({ length: BALL_RINGS + 1 }, (_, i) => {
    const angle = (Math.PI * i) / BALL_RINGS;
    return [BALL_RADIUS_M * (1 - Math.cos(angle)), BALL_RADIUS_M * Math.sin(angle)] as const;
  });
  return turned(outline, () => [255, 255, 255]);
}

export function cube(): Shape {
  const half = CUBE_SIDE_M / 2;
  const shape = { positions: [] as number[], normals: [] as number[], colors: [] as number[], triangles: [] as number[] };
  for (let axis = 0; axis < 3; axis++) {
    for (const side of [-1, 1]) {
      const first = shape.positions.length / 3;
      for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, 1]] as const) {
        const corner = [0, 0, 0];
        const normal = [0, 0, 0];
        normal[axis] = side;
        corner[axis] = side * half;
        corner[(axis + 1) % 3] = a * side * half; // the other way round on the other side
        corner[(axis + 2) % 3] = b * half;
        shape.positions.push(corner[0]!, corner[1]! + half, corner[2]!);
        shape.normals.push(...normal);
        shape.colors.push(214, 120, 62, 255);
      }
      shape.triangles.push(first, first + 1, first + 2, first, first + 2, first + 3);
    }
  }
  return packed(shape);
}

/** An outline turned about +y; its normals point to the left of its way, which is outside. */
function turned(outline: readonly (readonly [number, number])[], color: (height: number) => Rgb): Shape {
  const shape = { positions: [] as number[], normals: [] as number[], colors: [] as number[], triangles: [] as number[] };
  outline.forEach(([height, radius], ring) => {
    const [before, after] = [outline[Math.max(0, ring - 1)]!, outline[Math.min(outline.length - 1, ring + 1)]!];
    const length = Math.hypot(after[0] - before[0], after[1] - before[1]);
    const [out, up] = [(after[0] - before[0]) / length, (before[1] - after[1]) / length];
    for (let i = 0; i < SEGMENTS; i++) {
      const angle = (2 * Math.PI * i) / SEGMENTS;
      shape.positions.push(radius * Math.sin(angle), height, radius * Math.cos(angle));
      shape.normals.push(out * Math.sin(angle), up, out * Math.cos(angle));
      shape.colors.push(...color(height), 255);
    }
    if (ring + 1 < outline.length) joinRings(shape.triangles, ring, radius === 0, outline[ring + 1]![1] === 0);
  });
  return packed(shape);
}

/** Triangles between a ring and the next, counter-clockwise from outside; none where a ring is a point. */
function joinRings(triangles: number[], ring: number, isPoint: boolean, isNextPoint: boolean): void {
  for (let i = 0; i < SEGMENTS; i++) {
    const [here, right] = [ring * SEGMENTS + i, ring * SEGMENTS + ((i + 1) % SEGMENTS)];
    if (!isPoint) triangles.push(here, right, right + SEGMENTS);
    if (!isNextPoint) triangles.push(here, right + SEGMENTS, here + SEGMENTS);
  }
}

function packed(shape: { positions: number[]; normals: number[]; colors: number[]; triangles: number[] }): Shape {
  return {
    positions: new Float32Array(shape.positions),
    normals: new Float32Array(shape.normals),
    colors: new Uint8Array(shape.colors),
    triangles: new Uint32Array(shape.triangles),
  };
}
