// By which light an object is drawn, for clients that draw by themselves, and what is not known of a light, in words.

import { type ArrivingLight, type Light, VALID_SPREAD_DEG } from "./protocol";

/** The light that arrives where the object of this name stands; where that is not told, the room's light itself. */
export function lightOf(light: Light, object: string): ArrivingLight | Light {
  return places(light).find((each) => each.of === "object" && each.object === object) ?? light;
}

/** The light that a person cares for: at the first object, else in the middle of the view, else the room's; and its name. */
export function placeShown(light: Light): { light: ArrivingLight | Light; name: string } {
  const at = places(light);
  const object = at.find(({ of }) => of === "object");
  if (object !== undefined) return { light: object, name: "at the virtual object" };
  const view = at.find(({ of }) => of === "view");
  return view === undefined ? { light, name: "of the room" } : { light: view, name: "in the middle of the view" };
}

/** How well the dominant direction is known. */
export function describeCertainty({ spread_deg, valid }: Pick<Light, "spread_deg" | "valid">): string {
  if (spread_deg == null) return valid ? "Sure to about 15°" : "Not sure yet: the pictures so far do not fix the direction";
  const within = `${Math.round(spread_deg)}°`;
  return spread_deg <= VALID_SPREAD_DEG ? `Sure to about ${within}` : `Not sure: it may be off by ${within}`;
}

/** What is not known of the light at places, a line each. */
export function unknownPlaces(light: Light): string[] {
  return places(light).flatMap((place) => {
    const doubt = doubtOf(place);
    return doubt === null ? [] : [`${nameOf(place)}: ${doubt}`];
  });
}

function doubtOf({ seen, spread_deg, valid }: ArrivingLight): string | null {
  if (seen === 0) return "no scanned surface is seen from there, its light is a guess";
  if (spread_deg === null) return valid ? "how far its direction may be off is not known" : "its direction is not known yet";
  return spread_deg <= VALID_SPREAD_DEG ? null : `its direction may be off by ${Math.round(spread_deg)}°`;
}

function nameOf({ of, index, position, object }: ArrivingLight): string {
  if (of === "view") return "Middle of the view";
  if (of === "object") return object ?? `Object ${index + 1}`;
  return `Place (${position.map((value) => value.toFixed(2)).join(", ")})`;
}

/** Earlier servers tell none. */
function places(light: Light): readonly ArrivingLight[] {
  return (light.at as ArrivingLight[] | undefined) ?? [];
}
