// Looks on at a probeless server and uses its light. In a browser as in node 22: `node light.mjs URL [ROOM [KEY]]`.

import { decode, encode } from "@msgpack/msgpack";

const SUBPROTOCOL = "probeless-v1";

/** Calls `onLight` with every light until `stop()`; `onEnd` gets why the server closed. */
export function watchLight(pageUrl, { room = null, roomKey = null, onLight, onEnd = () => {} }) {
  const url = new URL(pageUrl);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  url.pathname = "/v1/stream"; // the token stays in ?token=
  const socket = new WebSocket(url, SUBPROTOCOL);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    const watch = { type: "watch" };
    if (room !== null) Object.assign(watch, { room, room_key: roomKey });
    socket.send(encode(watch));
  };
  socket.onmessage = ({ data }) => {
    const message = decode(new Uint8Array(data));
    if (message.type === "light") onLight(message);
    if (message.type === "error") onEnd(message.reason);
  };
  socket.onclose = ({ reason, code }) => onEnd(reason || `code ${code}`);
  return { stop: () => socket.close(1000) };
}

/** With three.js: `probe = new THREE.LightProbe(); applyLight(probe, light); scene.add(probe)`; +y is up. */
export function applyLight(probe, light) {
  probe.sh.fromArray(light.sh_webxr);
  probe.intensity = light.valid ? 1 : 0.5; // as you like: the pictures do not fix its direction yet
}

const isProgram = typeof process !== "undefined" && process.argv[1]?.endsWith("light.mjs");
if (isProgram) {
  const [, , pageUrl, room = null, roomKey = null] = process.argv;
  const watching = watchLight(pageUrl, {
    room,
    roomKey,
    onLight: (light) => {
      console.log(JSON.stringify({ frame: light.frame, sh: light.sh_webxr, valid: light.valid }));
      watching.stop();
    },
    onEnd: (reason) => console.error(reason),
  });
}
