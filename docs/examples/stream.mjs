// Streams frames of a program's own to a probeless server and prints the light: `node stream.mjs URL [FRAMES]`, node 22.

import { StreamClient } from "probeless";

const [width, height] = [160, 120];
const camera = { width, height, fx: 150, fy: 150, cx: 79.5, cy: 59.5, depth_scale_m: 0.001 };

/** Yours come from a camera: sRGB, depth in units of `depth_scale_m` (0: none), and where the camera is. */
function myFrame(index) {
  const data = new Uint8Array(3 * width * height).fill(180);
  return {
    timestamp_s: index / 30,
    world_from_camera: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], // x right, y down, z forward; null: the server tracks
    color: { width, height, codec: "raw", data }, // or the bytes of a JPEG or PNG
    depth: new Uint16Array(width * height).fill(1500),
  };
}

const [, , url, count = "5"] = process.argv;
const wishes = { poses: "given", volume_m: [-1, -1, 0.5, 1, 1, 2.5], voxel_m: 0.01, up: [0, -1, 0], answer: "light" };
const client = await StreamClient.connect(url, { client: "my program", camera, wishes, keep_s: 30 });
for (let index = 0; index < Number(count); index++) {
  await client.ready(); // a live camera takes its newest frame here
  const answer = await client.send(myFrame(index));
  if (answer.type === "dropped") console.error(answer.reason);
  else console.log(JSON.stringify({ frame: answer.light.frame, sh: answer.light.sh_webxr, valid: answer.light.valid }));
}
client.close();
