// What the npm package `probeless` offers to programs: the wire's types, its messages, a socket that comes back, sessions.

export type { Address, ConnectionState, Hooks, Pauses } from "./connection";
export { CAPTURING, Connection, REFUSED_CAPTURE, streamUrl, WATCHING } from "./connection";
export { decodeDepth, encodeDepth } from "./depth";
export { describeCertainty, lightOf, unknownPlaces } from "./lighting";
export { decodeServer, encode } from "./messages";
export * from "./protocol";
export type { Asked, Request, Setup } from "./session";
export type { Answer, SessionOptions, Shot } from "./stream_client";
export { StreamClient } from "./stream_client";
