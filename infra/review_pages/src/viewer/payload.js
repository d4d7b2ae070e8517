// Reading of the parts that worldpose/formats/viewer_file.py writes, and posing of people from them.

import { JOINTS } from "./shaders.js";

const KINDS = { i1: Int8Array, u1: Uint8Array, i2: Int16Array, u2: Uint16Array, f4: Float32Array };
const MISSING = -32768;
const KEYPOINTS = 17;
const UNKNOWN_VIEWS = 255;

// COCO-17 keypoints whose values the 24 joints of a body take.
const TRUNK = [5, 6, 11, 12];
const NEAREST = [
  [11, 12], [11], [12], TRUNK, [13], [14], TRUNK, [15], [16], [5, 6], [15], [16], [5, 6], [5], [6], [0], [5], [6], [7], [8], [9], [10], [9], [10],
];

// Read a part: its header, with the arrays in it.
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  for (const [name, { type, shape, at }] of Object.entries(header.arrays)) {
    arrays[name] = new KINDS[type](buffer, 4 + length + at, shape.reduce((a, b) => a * b, 1));
  }
  return { ...header, shapes: header.arrays, arrays };
}

// Rotation vectors of a body as quaternions (w, x, y, z), in `out`.
function toQuaternions(out, range, at) {
  const { turns, turn_units: units } = range.arrays;
  for (let j = 0; j < JOINTS; j++) {
    const unit = units[j];
    const [x, y, z] = [turns[at + 3 * j] * unit, turns[at + 3 * j + 1] * unit, turns[at + 3 * j + 2] * unit];
    const angle = Math.hypot(x, y, z);
    const s = angle > 1e-9 ? Math.sin(angle / 2) / angle : 0.5;
    out[4 * j] = Math.cos(angle / 2);
    out[4 * j + 1] = s * x;
    out[4 * j + 2] = s * y;
    out[4 * j + 3] = s * z;
  }
}

const now_ = new Float64Array(4 * JOINTS);
const after_ = new Float64Array(4 * JOINTS);

// Turn the quaternions `now_` by a share of the way to `after_`.
function blend(share) {
  for (let j = 0; j < 4 * JOINTS; j += 4) {
    let dot = 0;
    for (let c = 0; c < 4; c++) dot += now_[j + c] * after_[j + c];
    let length = 0;
    for (let c = 0; c < 4; c++) {
      now_[j + c] += share * ((dot < 0 ? -after_[j + c] : after_[j + c]) - now_[j + c]);
      length += now_[j + c] ** 2;
    }
    for (let c = 0; c < 4; c++) now_[j + c] /= Math.sqrt(length);
  }
}

// Joints and bones of a body in frame k of a range, or between it and a frame of the next one; null where it is missing.
// `rotations` are those of the joints relative to the world, 9 numbers each, rows first.
export function poseBody(scene, column, now, k, next, kNext, share) {
  const { parents, rest_joints: rest } = scene.arrays;
  const bodies = now.shapes.turns.shape[1];
  const row = k * bodies + column;
  const place = now.arrays.place.subarray(3 * row, 3 * row + 3);
  if (!Number.isFinite(place[0])) return null;
  toQuaternions(now_, now, 72 * row);
  const to = [place[0], place[1], place[2]];
  const rowNext = kNext * bodies + column;
  if (next && share > 0 && Number.isFinite(next.arrays.place[3 * rowNext])) {
    toQuaternions(after_, next, 72 * rowNext);
    blend(share);
    for (let axis = 0; axis < 3; axis++) to[axis] += share * (next.arrays.place[3 * rowNext + axis] - place[axis]);
  }
  const rotations = new Float64Array(9 * JOINTS);
  const joints = new Float64Array(3 * JOINTS); // before the body is moved to its place
  const bones = new Float32Array(12 * JOINTS); // columns of the rotation, with the offset in w
  const local = new Float64Array(9);
  for (let j = 0; j < JOINTS; j++) {
    const [w, x, y, z] = [now_[4 * j], now_[4 * j + 1], now_[4 * j + 2], now_[4 * j + 3]];
    local[0] = 1 - 2 * (y * y + z * z); local[1] = 2 * (x * y - w * z); local[2] = 2 * (x * z + w * y);
    local[3] = 2 * (x * y + w * z); local[4] = 1 - 2 * (x * x + z * z); local[5] = 2 * (y * z - w * x);
    local[6] = 2 * (x * z - w * y); local[7] = 2 * (y * z + w * x); local[8] = 1 - 2 * (x * x + y * y);
    const own = 3 * (JOINTS * column + j);
    const parent = parents[j];
    const R = 9 * j;
    if (parent < 0) {
      rotations.set(local, R);
      for (let r = 0; r < 3; r++) joints[3 * j + r] = rest[own + r];
    } else {
      const P = 9 * parent;
      const before = 3 * (JOINTS * column + parent);
      for (let r = 0; r < 3; r++) {
        let at = joints[3 * parent + r];
        for (let c = 0; c < 3; c++) {
          rotations[R + 3 * r + c] = rotations[P + 3 * r] * local[c] + rotations[P + 3 * r + 1] * local[3 + c] + rotations[P + 3 * r + 2] * local[6 + c];
          at += rotations[P + 3 * r + c] * (rest[own + c] - rest[before + c]);
        }
        joints[3 * j + r] = at;
      }
    }
    for (let r = 0; r < 3; r++) {
      let offset = to[r] + joints[3 * j + r];
      for (let c = 0; c < 3; c++) {
        bones[12 * j + 4 * c + r] = rotations[R + 3 * r + c];
        offset -= rotations[R + 3 * r + c] * rest[own + c];
      }
      bones[12 * j + 4 * r + 3] = offset;
    }
  }
  const skeleton = Array.from({ length: JOINTS }, (_, j) => [0, 1, 2].map((axis) => joints[3 * j + axis] + to[axis]));
  return { bones, body: column, skeleton, rotations };
}

// Joint j of a person without a body, or null.
function jointAt(range, row, j) {
  const at = 3 * (KEYPOINTS * row + j);
  const { joints, anchor } = range.arrays;
  if (joints[at] === MISSING) return null;
  return [0, 1, 2].map((axis) => anchor[3 * row + axis] + range.joint_unit * joints[at + axis]);
}

function poseJoints(number, now, k, next, kNext, share) {
  const column = now.loose.indexOf(number);
  if (column < 0) return null;
  const columnNext = next && share > 0 ? next.loose.indexOf(number) : -1;
  const joints = Array.from({ length: KEYPOINTS }, (_, j) => {
    const here = jointAt(now, k * now.loose.length + column, j);
    const there = columnNext < 0 ? null : jointAt(next, kNext * next.loose.length + columnNext, j);
    return here && there ? here.map((value, axis) => value + share * (there[axis] - value)) : here;
  });
  return joints.some(Boolean) ? { joints } : null;
}

// Place of a person whom the feet alone place: x, y and standard deviation.
function placeFeet(number, now, k) {
  const column = now.plane.indexOf(number);
  if (column < 0) return null;
  const at = 3 * (k * now.plane.length + column);
  const [x, y, spread] = now.arrays.ground.subarray(at, at + 3);
  return Number.isFinite(x) ? { feet: [x, y], feetSpread: spread } : null;
}

// Standard deviation [m] of a code, or NaN.
export function spreadOf(scene, code) {
  const [least, most] = scene.spread;
  return code ? least * (most / least) ** ((code - 1) / 254) : NaN;
}

// Standard deviation and number of cameras of each keypoint of a person in a frame; NaN where unknown.
function evidence(scene, number, now, k) {
  const at = KEYPOINTS * (k * scene.people.length + number);
  const { spread, views } = now.arrays;
  return Array.from({ length: KEYPOINTS }, (_, j) => ({
    spread: spread ? spreadOf(scene, spread[at + j]) : NaN,
    views: views && views[at + j] !== UNKNOWN_VIEWS ? views[at + j] : NaN,
  }));
}

// Value of each of the 24 joints of a body, from its keypoints: the mean of those that have one.
export function toBody(values) {
  return NEAREST.map((near) => {
    const known = near.map((j) => values[j]).filter(Number.isFinite);
    return known.length ? known.reduce((a, b) => a + b, 0) / known.length : NaN;
  });
}

// A person in frame k of a range: body, joints or feet, with what is known about them; null where missing.
export function posePerson(scene, number, now, k, next = null, kNext = 0, share = 0) {
  const { body } = scene.people[number];
  let found = body !== null && now.arrays.turns ? poseBody(scene, body, now, k, next?.arrays.turns ? next : null, kNext, share) : null;
  found ??= poseJoints(number, now, k, next, kNext, share) ?? placeFeet(number, now, k);
  return found && { ...found, kind: found.skeleton ? "body" : found.joints ? "joints" : "feet", evidence: () => evidence(scene, number, now, k) };
}
