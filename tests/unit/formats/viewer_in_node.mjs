// Poses people as the 3D view does; prints them, and some vertices of their surfaces.
import { readFileSync } from "node:fs";

const [module, sceneFile, ...rangeFiles] = process.argv.slice(2);
const { posePerson, unpack } = await import(module);
const read = (file) => unpack(new Uint8Array(readFileSync(file)).buffer);
const scene = read(sceneFile);

function surfaceOf(body) {
  const { surface, influences, shares } = scene.arrays;
  if (!surface) return null;
  const vertices = scene.shapes.surface.shape[1];
  const placed = [];
  for (let v = 0; v < vertices; v += 500) {
    const at = [0, 1, 2].map((c) => surface[3 * (body.body * vertices + v) + c] * scene.units.surface);
    const to = [0, 0, 0];
    const sum = shares.subarray(4 * v, 4 * v + 4).reduce((a, b) => a + b, 0);
    for (let n = 0; n < 4; n++) {
      const b = 12 * influences[4 * v + n];
      for (let r = 0; r < 3; r++) {
        const bone = body.bones;
        const moved = bone[b + r] * at[0] + bone[b + 4 + r] * at[1] + bone[b + 8 + r] * at[2] + bone[b + 4 * r + 3];
        to[r] += (shares[4 * v + n] / sum) * moved;
      }
    }
    placed.push(to);
  }
  return placed;
}

const frames = rangeFiles.flatMap((file) => {
  const range = read(file);
  return Array.from({ length: range.count }, (_, k) =>
    scene.people.map((_, number) => {
      const person = posePerson(scene, number, range, k);
      if (!person) return null;
      const { kind, skeleton, joints, feet, feetSpread } = person;
      const spread = person.evidence().map((each) => each.spread);
      const views = person.evidence().map((each) => each.views);
      const rotations = person.rotations && Array.from(person.rotations);
      return { kind, joints: skeleton ?? joints ?? null, rotations, feet, feetSpread, spread, views, placed: skeleton ? surfaceOf(person) : null };
    }),
  );
});
console.log(JSON.stringify({ people: scene.people, frames }));
