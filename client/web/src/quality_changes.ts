// How finely light is sampled, changed in the form while a session runs.

import { type Choice, putQuality, quality, read } from "./form";
import type { Asked } from "./session";

export class QualityChanges {
  /** What was asked for last and is not answered yet, and what holds. */
  private asked: { choice: Choice; request: number } | null = null;
  private granted: Choice | null = null;

  /** `ask`: sends a request, and gives its number. */
  constructor(
    private readonly form: HTMLFormElement,
    private readonly ask: (asked: Asked) => number,
    private readonly say: (text: string) => void,
  ) {}

  /** A session begins with this. */
  begin(choice: Choice): void {
    this.asked = null;
    this.granted = choice;
  }

  change(): void {
    const choice = read(this.form);
    this.say("");
    this.asked = { choice, request: this.ask({ type: "quality", ...quality(choice) } as Asked) };
  }

  /** The server has answered: what was asked for last holds, or what held before still does, and the form says so. */
  acknowledge(request: number, error: string | null): void {
    const { asked, granted } = this;
    if (asked?.request !== request) return;
    this.asked = null;
    if (error === null) this.granted = asked.choice;
    else if (granted !== null) {
      putQuality(this.form, granted);
      this.say(`${error} (preset stays ${granted.preset})`);
    }
  }
}
