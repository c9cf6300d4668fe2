// By which light an object is drawn, and what is not known of it.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { describeCertainty, lightOf, unknownPlaces } from "../src/lighting";
import { decodeServer } from "../src/messages";
import type { ArrivingLight, Light } from "../src/protocol";

const folder = process.env["PROBELESS_GOLDEN"] ?? join(import.meta.dirname, "..", "..", "..", "tests", "golden");
const golden = (name: string): Light => decodeServer(new Uint8Array(readFileSync(join(folder, `${name}.msgpack`)))) as Light;
const told = golden("light_at_places");
const [view, sofa] = told.at as [ArrivingLight, ArrivingLight];

test("an object is lit by what arrives at its own place, by its name", () => {
  assert.equal(lightOf(told, "sofa"), sofa);
  assert.notDeepEqual(sofa.sh, told.sh);
});

test("one whose place is not told is lit by the room's light", () => {
  assert.equal(lightOf(told, "chair"), told);
  const earlier = golden("earlier/light");
  assert.equal(earlier.at, undefined);
  assert.equal(lightOf(earlier, "sofa"), earlier);
  assert.deepEqual(unknownPlaces(earlier), []);
});

test("how well the direction is known", () => {
  assert.equal(describeCertainty({ spread_deg: 12.4, valid: true }), "Sure to about 12°");
  assert.equal(describeCertainty({ spread_deg: 25, valid: true }), "Sure to about 25°");
  assert.equal(describeCertainty({ spread_deg: 71.6, valid: false }), "Not sure: it may be off by 72°");
  assert.equal(describeCertainty({ spread_deg: null, valid: true }), "Sure to about 15°");
  assert.match(describeCertainty({ spread_deg: null, valid: false }), /^Not sure yet/);
});

test("what is not known of places", () => {
  assert.deepEqual(unknownPlaces({ ...told, at: [view] }), []);
  const at: ArrivingLight[] = [
    { ...view, spread_deg: 40.4, valid: false },
    { ...view, of: "place", index: 1, position: [1, -0.5, 2.25], spread_deg: null, valid: true },
    { ...sofa, spread_deg: null, valid: false },
    { ...sofa, object: null, index: 2, spread_deg: 8, seen: 0 },
  ];
  assert.deepEqual(unknownPlaces({ ...told, at }), [
    "Middle of the view: its direction may be off by 40°",
    "Place (1.00, -0.50, 2.25): how far its direction may be off is not known",
    "sofa: its direction is not known yet",
    "Object 3: no scanned surface is seen from there, its light is a guess",
  ]);
});
