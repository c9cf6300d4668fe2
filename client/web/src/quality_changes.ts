// How finely light is sampled, changed in the form while a session runs.

import { type Choice, putQuality, quality, read } from "./form";
import type { Asked } from "./session";

export class QualityChanges {
  /** What was asked for and is not answered yet, by its number, in order; and what holds. */
  private readonly asked = new Map<number, Choice>();
  private granted: Choice | null = null;

  /** `ask`: sends a request, and gives its number. */
  constructor(
    private readonly form: HTMLFormElement,
    private readonly ask: (asked: Asked) => number,
    private readonly say: (text: string) => void,
  ) {}

  /** A session begins with this. */
  begin(choice: Choice): void {
    this.asked.clear();
    this.granted = choice;
  }

  change(): void {
    const choice = read(this.form);
    this.say("");
    this.asked.set(this.ask({ type: "quality", ...quality(choice) } as Asked), choice);
  }

  /** The server has answered: what was asked for holds, or what held before still does, and the form says so. */
  acknowledge(request: number, error: string | null): void {
    const choice = this.asked.get(request);
    if (choice === undefined) return;
    this.asked.delete(request);
    if (error === null) this.granted = choice;
    else if (this.granted !== null) {
      if (this.asked.size === 0) putQuality(this.form, this.granted); // else the person has changed it meanwhile
      this.say(`${error} (preset stays ${this.granted.preset})`);
    }
  }
}
