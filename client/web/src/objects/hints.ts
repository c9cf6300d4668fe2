// What fingers, or mouse and keys, do with objects: told for what this device has.

const hasFingers = (): boolean => matchMedia("(pointer: coarse)").matches;

export const placingHint = (): string => (hasFingers() ? "Tap a surface in the picture: it is put there." : "Click a surface in the picture: it is put there.");

export const handlingHint = (): string =>
  hasFingers()
    ? "Drag it with a finger; two fingers turn and size it."
    : "Drag it, or use the arrow keys; [ and ] turn it, + and − size it, Delete removes it, Ctrl+Z undoes.";
