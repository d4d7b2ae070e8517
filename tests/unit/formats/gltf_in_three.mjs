// Validate a .glb with the Khronos validator, and pose it with three.js at some times.
//
// node gltf_in_three.mjs NODE_MODULES FILE TIME...: one JSON object with the validator's issues and,
// for each time, position and quaternion x y z w of every named node, in the node `world`.

import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const [modules, file, ...times] = process.argv.slice(2);
const require = createRequire(pathToFileURL(`${modules}/x.js`));
const load = (path) => import(pathToFileURL(`${modules}/three/${path}`));
globalThis.self = globalThis;
const { AnimationMixer, LoopOnce, Quaternion, Vector3 } = await load("build/three.module.js");
const { GLTFLoader } = await load("examples/jsm/loaders/GLTFLoader.js");

const bytes = new Uint8Array(readFileSync(file));
const { issues } = await require("gltf-validator").validateBytes(bytes);
const { scene, animations, cameras, asset } = await new GLTFLoader().parseAsync(bytes.buffer, "");
const world = scene.getObjectByName("world");
const mixer = new AnimationMixer(scene);
for (const clip of animations) {
  const action = mixer.clipAction(clip).setLoop(LoopOnce).play();
  action.clampWhenFinished = true; // else the last frame is the first
}
const frames = times.map((time) => {
  mixer.setTime(Number(time));
  scene.updateMatrixWorld(true);
  const nodes = {};
  const back = world.getWorldQuaternion(new Quaternion()).invert();
  scene.traverse((node) => {
    if (!node.name) return;
    const place = world.worldToLocal(node.getWorldPosition(new Vector3()));
    const turn = node.getWorldQuaternion(new Quaternion()).premultiply(back);
    nodes[node.name] = { place: place.toArray(), turn: turn.toArray(), scale: node.scale.x };
  });
  const surfaces = {};
  scene.traverse((node) => {
    if (!node.isSkinnedMesh) return;
    node.skeleton.update();
    const point = node.getVertexPosition(0, new Vector3()).applyMatrix4(node.matrixWorld);
    surfaces[node.name] = world.worldToLocal(point).toArray();
  });
  return { nodes, surfaces };
});
const lenses = cameras.map(({ name, fov, aspect }) => ({ name, fov, aspect }));
console.log(JSON.stringify({ issues, asset, duration: animations[0].duration, lenses, frames }));
