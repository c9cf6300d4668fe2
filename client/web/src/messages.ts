// Bytes to messages and back, as in protocol/codec.py.

import { Decoder, encode as pack } from "@msgpack/msgpack";
import { type ClientMessage, MAX_MESSAGE_BYTES, type ServerMessage } from "./protocol";

const decoder = new Decoder({
  maxStrLength: MAX_MESSAGE_BYTES,
  maxBinLength: MAX_MESSAGE_BYTES,
  maxArrayLength: 4096,
  maxMapLength: 256,
  maxExtLength: 0,
});

const CLIENT_TAGS: ReadonlySet<unknown> = new Set<ClientMessage["type"]>([
  "hello",
  "watch",
  "frame",
  "place_object",
  "move_object",
  "remove_object",
  "quality",
  "request_mesh",
  "request_panorama",
  "bye",
]);

const SERVER_TAGS: ReadonlySet<unknown> = new Set<ServerMessage["type"]>([
  "welcome",
  "composite",
  "layer",
  "light",
  "dropped",
  "mesh_part",
  "panorama",
  "acknowledged",
  "error",
  "bye",
]);

export function encode(message: ClientMessage): Uint8Array<ArrayBuffer> {
  return pack(message);
}

/** The message a server sent. Throws Error with one line for bytes that are none; the fields are the server's word. */
export function decodeServer(data: ArrayBuffer | Uint8Array): ServerMessage {
  const value = decodeTagged(data);
  if (value === null || !SERVER_TAGS.has(value.type)) throw new Error("not a message of a server of this version");
  return value as ServerMessage;
}

/** The message a client sent, from a recording; null for a server's. Throws Error likewise. */
export function decodeClient(data: Uint8Array): ClientMessage | null {
  const value = decodeTagged(data);
  if (value !== null && CLIENT_TAGS.has(value.type)) return value as ClientMessage;
  if (value !== null && SERVER_TAGS.has(value.type)) return null;
  throw new Error("not a message of this version");
}

function decodeTagged(data: ArrayBuffer | Uint8Array): { type: unknown } | null {
  const value: unknown = decoder.decode(data);
  return typeof value === "object" && value !== null && "type" in value ? value : null;
}
