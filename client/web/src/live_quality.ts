// The preset beside the picture: the form's own, which is out of sight while the picture fills the screen.

import { byId } from "./dom";

const own = byId<HTMLSelectElement>("live-preset");

/** `form`: whose preset this is; a change there is a change here. */
export function showLiveQuality(form: HTMLFormElement): void {
  const preset = form.elements.namedItem("preset") as HTMLSelectElement;
  own.replaceChildren(...[...preset.options].map((option) => option.cloneNode(true)));
  own.addEventListener("change", () => {
    preset.value = own.value;
    preset.dispatchEvent(new Event("change", { bubbles: true }));
  });
}

/** `isCapturing`: who only watches has no say in it. */
export function refreshLiveQuality(form: HTMLFormElement, isCapturing: boolean): void {
  byId("live-quality").hidden = !isCapturing;
  const { value } = form.elements.namedItem("preset") as HTMLSelectElement;
  if (own.value !== value && document.activeElement !== own) own.value = value;
}
