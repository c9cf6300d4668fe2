// Reads a recording (protocol/README.md): consecutive messages in a file, read in chunks.

import { decodeClient } from "../messages";
import { type CameraModel, type ClientMessage, type Frame, type Hello, MAX_MESSAGE_BYTES, type PlaceObject, type Wishes } from "../protocol";
import { lengthOfValue } from "./message_length";
import { reasonOf, SourceError } from "./source";

/** Minimum size of a chunk. */
const PIECE_BYTES = 1 << 18;

export interface RecordedFrame {
  camera: CameraModel;
  wishes: Wishes;
  frame: Frame;
  /** Placed before this frame, in this recording; of earlier frames too. */
  objects: readonly PlaceObject[];
}

/** Error in a file, in one sentence. */
const noRecording = (file: File, at: number, why: string): SourceError =>
  new SourceError(`${file.name} is no recording (byte ${at}: ${why}): choose a file that probeless stream SOURCE --record FILE has made.`);

/** The frames of a recording in order. Throws SourceError. `onCut` is called if the file ends inside a message. */
export async function* framesOf(file: File, onCut: (text: string) => void): AsyncGenerator<RecordedFrame> {
  let hello: Hello | null = null;
  const objects: PlaceObject[] = [];
  for await (const { at, bytes } of messagesOf(file, onCut)) {
    const message = read(file, at, bytes);
    if (message.type === "hello") hello = message;
    if (message.type === "place_object") objects.push(message);
    if (message.type !== "frame") continue;
    if (hello === null) throw noRecording(file, at, "a frame before any hello");
    yield { camera: hello.camera, wishes: hello.wishes ?? {}, frame: message, objects };
  }
}

function read(file: File, at: number, bytes: Uint8Array): ClientMessage | { type: "other" } {
  let message: ClientMessage | null;
  try {
    message = decodeClient(bytes);
  } catch (error) {
    throw noRecording(file, at, reasonOf(error));
  }
  if (message === null) return { type: "other" };
  const codec = message.type === "frame" ? message.color?.codec : null;
  if (codec && !SINGLE.has(codec)) {
    throw new SourceError(`${file.name} holds ${codec} video, whose pictures build on one another: the page streams recordings of single pictures (stream --record without --color h264).`);
  }
  return message;
}

/** Codecs of independent images: frames may be skipped if the server is slower than the recording. */
const SINGLE: ReadonlySet<string> = new Set(["jpeg", "png", "raw"]);

/** Each complete message and its offset. */
async function* messagesOf(file: File, onCut: (text: string) => void): AsyncGenerator<{ at: number; bytes: Uint8Array<ArrayBuffer> }> {
  let piece = new Uint8Array();
  let start = 0; // of the piece in the file
  let at = 0; // of the message in the piece
  while (start + at < file.size) {
    const length = measured(file, start + at, piece.subarray(at));
    if (at + length <= piece.length) {
      yield { at: start + at, bytes: piece.slice(at, at + length) };
      at += length;
      continue;
    }
    start += at;
    at = 0;
    const end = Math.min(file.size, start + Math.max(PIECE_BYTES, length));
    if (start + length > file.size) return onCut(`${file.name} was cut off inside a message: its last ${file.size - start} bytes were left out.`);
    piece = await slice(file, start, end);
  }
}

function measured(file: File, at: number, bytes: Uint8Array): number {
  let length: number;
  try {
    length = lengthOfValue(bytes);
  } catch (error) {
    throw noRecording(file, at, reasonOf(error));
  }
  if (length > MAX_MESSAGE_BYTES) throw noRecording(file, at, "a message longer than any may be");
  return length;
}

async function slice(file: File, start: number, end: number): Promise<Uint8Array<ArrayBuffer>> {
  try {
    return new Uint8Array(await file.slice(start, end).arrayBuffer());
  } catch (error) {
    throw new SourceError(`${file.name} can no longer be read (${reasonOf(error)}): choose it again.`);
  }
}
