// What a session produces, as the page's panels show it.

import { byId, setText } from "./dom";
import { showLight } from "./light";
import { addNote, clearNotes, showNotes } from "./notes";
import { showPlan } from "./plan";
import type { Composite, Layer, Light, ServerMessage } from "./protocol";
import { FrameRate } from "./rate";
import { addTimings, clearTimings, showTimings } from "./timings";

/** The light changes slowly and is dear to draw on a phone. */
const LIGHT_MS = 100;

export class Panels {
  private answer: Composite | Layer | null = null;
  lastAnswer_ms = Number.NEGATIVE_INFINITY;
  private readonly rate = new FrameRate();
  private light: Light | null = null;
  /** Row-major, of the newest answer. */
  private worldFromCamera: readonly number[] | null = null;
  private isDrawing = false;
  private isLightDue = false;
  private lightShown_ms = Number.NEGATIVE_INFINITY;

  receive(message: ServerMessage): void {
    switch (message.type) {
      case "welcome":
        this.greet(message.session, message.server, message.device);
        return;
      case "light":
        this.light = message;
        this.isLightDue = true;
        return;
      case "composite":
      case "layer":
        this.receivePicture(message);
        return;
      case "dropped":
        addNote(`left out: ${message.reason}`, message.frame);
        break;
      case "error":
      case "bye":
        addNote(`the server says: ${message.reason}`, null);
        break;
      case "acknowledged":
        if (message.error !== null) addNote(`the server says: ${message.error}`, null);
        for (const note of message.notes) addNote(note, null);
        break;
      case "mesh_part":
      case "panorama":
        return;
      default:
        message satisfies never;
    }
    showNotes();
  }

  note(text: string): void {
    addNote(text, null);
    showNotes();
  }

  clear(): void {
    this.answer = this.light = this.worldFromCamera = null;
    this.lastAnswer_ms = Number.NEGATIVE_INFINITY;
  }

  /** A frame was answered, whose camera stood there. */
  noteAnswer(worldFromCamera: readonly number[] | null): void {
    this.worldFromCamera = worldFromCamera ?? this.worldFromCamera;
    this.lastAnswer_ms = performance.now();
    this.rate.add(this.lastAnswer_ms);
  }

  /** What changes with time alone. */
  refresh(now_ms: number): void {
    this.drawLight(now_ms);
    const fps = this.rate.value(now_ms);
    setText(byId("frame-rate"), fps === null ? "–" : fps.toFixed(1));
  }

  private greet(session: string, server: string, device: string): void {
    setText(byId("session"), session);
    setText(byId("server"), server);
    setText(byId("device"), device);
    this.rate.clear();
    clearTimings();
    clearNotes();
  }

  private receivePicture(message: Composite | Layer): void {
    this.answer = message;
    this.noteAnswer(message.world_from_camera);
    addTimings(message.timings);
    for (const note of message.notes) addNote(note, message.frame);
    if (this.isDrawing) return;
    this.isDrawing = true;
    requestAnimationFrame(() => this.draw());
  }

  private draw(): void {
    this.isDrawing = false;
    if (this.answer === null) return;
    showTimings(this.answer.timings);
    showPlan(this.answer.plan);
    showNotes();
    this.refresh(performance.now());
  }

  private drawLight(now_ms: number): void {
    const { light, worldFromCamera } = this;
    if (!this.isLightDue || light === null || worldFromCamera === null || now_ms - this.lightShown_ms < LIGHT_MS) return;
    this.isLightDue = false;
    this.lightShown_ms = now_ms;
    showLight(light, worldFromCamera);
  }
}
