// A GLB of one mesh with colours at its vertices.

export interface Shape {
  /** x, y, z of each vertex; +y is up. */
  positions: Float32Array<ArrayBuffer>;
  normals: Float32Array<ArrayBuffer>;
  /** sRGB with an alpha, a byte each. */
  colors: Uint8Array<ArrayBuffer>;
  triangles: Uint32Array<ArrayBuffer>;
}

const [FLOAT, UINT32, UINT8] = [5126, 5125, 5121] as const;
const [MAGIC, JSON_CHUNK, BIN_CHUNK] = [0x46546c67, 0x4e4f534a, 0x004e4942] as const;

export function toGlb(shape: Shape): Uint8Array<ArrayBuffer> {
  const parts = [shape.positions, shape.normals, shape.colors, shape.triangles];
  const count = shape.positions.length / 3;
  let byteOffset = 0;
  const bufferViews = parts.map(({ byteLength }) => {
    const view = { buffer: 0, byteOffset, byteLength };
    byteOffset += byteLength; // all are whole numbers of four bytes
    return view;
  });
  const document = {
    asset: { version: "2.0" },
    scene: 0,
    scenes: [{ nodes: [0] }],
    nodes: [{ mesh: 0 }],
    materials: [{ pbrMetallicRoughness: { metallicFactor: 0 } }],
    meshes: [{ primitives: [{ attributes: { POSITION: 0, NORMAL: 1, COLOR_0: 2 }, indices: 3, material: 0 }] }],
    buffers: [{ byteLength: byteOffset }],
    bufferViews,
    accessors: [
      { bufferView: 0, componentType: FLOAT, count, type: "VEC3", ...bounds(shape.positions) },
      { bufferView: 1, componentType: FLOAT, count, type: "VEC3" },
      { bufferView: 2, componentType: UINT8, count, type: "VEC4", normalized: true },
      { bufferView: 3, componentType: UINT32, count: shape.triangles.length, type: "SCALAR" },
    ],
  };
  return container(new TextEncoder().encode(JSON.stringify(document)), parts);
}

function container(text: Uint8Array, parts: readonly ArrayBufferView<ArrayBuffer>[]): Uint8Array<ArrayBuffer> {
  const textBytes = Math.ceil(text.length / 4) * 4;
  const bodyBytes = parts.reduce((sum, part) => sum + part.byteLength, 0);
  const glb = new Uint8Array(12 + 8 + textBytes + 8 + bodyBytes);
  const words = new DataView(glb.buffer);
  [MAGIC, 2, glb.length, textBytes, JSON_CHUNK].forEach((word, i) => words.setUint32(4 * i, word, true));
  glb.fill(0x20, 20, 20 + textBytes);
  glb.set(text, 20);
  [bodyBytes, BIN_CHUNK].forEach((word, i) => words.setUint32(20 + textBytes + 4 * i, word, true));
  let at = 28 + textBytes;
  for (const part of parts) {
    glb.set(new Uint8Array(part.buffer, part.byteOffset, part.byteLength), at);
    at += part.byteLength;
  }
  return glb;
}

function bounds(positions: Float32Array): { min: number[]; max: number[] } {
  const axes = [0, 1, 2].map((axis) => positions.filter((_, i) => i % 3 === axis));
  return { min: axes.map((values) => Math.min(...values)), max: axes.map((values) => Math.max(...values)) };
}
