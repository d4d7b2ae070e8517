// Poses people as the 3D view does; prints their joints and some vertices of their surfaces.
import { readFileSync } from "node:fs";

const [module, sceneFile, framesFile] = process.argv.slice(2);
const { poseBody, unpack } = await import(module);
const read = (file) => unpack(new Uint8Array(readFileSync(file)).buffer);
const [scene, range] = [read(sceneFile), read(framesFile)];
const people = scene.people.map((person) =>
  Array.from({ length: range.count }, (_, k) => {
    const body = poseBody(scene, person.body, range, k, null, 0, 0);
    if (!body) return null;
    const { surface, influences, shares } = scene.arrays;
    const vertices = scene.shapes.surface.shape[1];
    const placed = [];
    for (let v = 0; v < vertices; v += 500) {
      const at = [0, 1, 2].map((c) => surface[3 * (person.body * vertices + v) + c] * scene.units.surface);
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
    return { joints: body.skeleton, placed };
  }),
);
console.log(JSON.stringify({ first: scene.first, every: scene.every, people }));
