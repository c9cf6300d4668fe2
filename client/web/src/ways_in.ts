// How a person begins: the sample, this device's camera, or another computer; and what this device lacks.

import { reasonOf } from "./capture/source";
import { findSupport } from "./capture/support";
import { byId, make, setText } from "./dom";
import { deviceOf, hintFor } from "./device_hint";
import { type Choice, noteChoice, read } from "./form";
import { fetchSample } from "./sample";

const form = byId<HTMLFormElement>("capture-form");

/** `begin`: starts a session of this choice. Must be called once. */
export function offerWaysIn(begin: (choice: Choice) => void): void {
  const tryButton = byId<HTMLButtonElement>("try");
  tryButton.addEventListener("click", () => void trySample(tryButton, begin));
  byId("use-camera").addEventListener("click", () => {
    form.querySelector<HTMLInputElement>('input[value="xr"]')!.checked = true;
    noteChoice(form);
    begin(read(form));
  });
  void showSupport();
}

async function trySample(button: HTMLButtonElement, begin: (choice: Choice) => void): Promise<void> {
  button.disabled = true;
  setText(byId("try-said"), "Fetching the sample…");
  try {
    const file = await fetchSample();
    begin({ ...read(form), source: "recorded", room: "", key: "", marker: null, answer: "picture", file, loops: true });
    setText(byId("try-said"), "");
  } catch (error) {
    setText(byId("try-said"), reasonOf(error));
  } finally {
    button.disabled = false;
  }
}

/** The command with which there is something to see; it breaks between words only. */
export function showCommand(words: readonly string[]): void {
  byId("hint").append(...words.flatMap((word) => [make("span", "", word), " "]));
}

async function showSupport(): Promise<void> {
  const support = await findSupport();
  const device = deviceOf(navigator.userAgent, navigator.maxTouchPoints);
  const hint = byId("device-hint");
  setText(hint, hintFor(device, support) ?? "");
  hint.hidden = hint.textContent === "";
  byId("use-camera").hidden = support.xr !== null || device === "quest";
  for (const [name, lack] of [["xr", support.xr], ["camera", support.camera]] as const) {
    const words = byId(`lacks-${name}`);
    words.hidden = lack === null;
    setText(words, lack ?? "");
    const input = form.querySelector<HTMLInputElement>(`input[value="${name}"]`)!;
    input.disabled = lack !== null;
    if (lack !== null && input.checked) form.querySelector<HTMLInputElement>('input[value="watch"]')!.checked = true;
  }
  noteChoice(form);
}
