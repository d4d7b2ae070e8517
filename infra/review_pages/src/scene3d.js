// 3D view of a clip in plain WebGL 2: people as skinned bodies or capsules, the pitch, cameras. It needs no library, no
// network and no framework: a canvas for the picture, one for labels, and the binaries of flows/reports/scene_data.py.

const KINDS = { i1: Int8Array, u1: Uint8Array, i2: Int16Array, u2: Uint16Array, f4: Float32Array };
const MISSING = -32768;
const JOINTS = 24;
const HEAD = 15;
const NEAR = 0.3;
const FAR = 700;

// Read a binary: its header, with the arrays in it.
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  for (const [name, { type, shape, at }] of Object.entries(header.arrays)) {
    arrays[name] = new KINDS[type](buffer, 4 + length + at, shape.reduce((a, b) => a * b, 1));
  }
  return { ...header, shapes: header.arrays, arrays };
}

const COMMON = `#version 300 es
precision highp float;
uniform mat4 view;
`;
const LIT = `#version 300 es
precision highp float;
in vec3 normal; in vec3 tint; out vec4 color;
void main() {
  vec3 n = normalize(normal);
  float sun = max(0.0, dot(n, normalize(vec3(0.35, -0.45, 0.82))));
  color = vec4(tint * (0.5 + 0.16 * n.z + 0.42 * sun), 1.0);
}`;
const SHADERS = {
  body: [`${COMMON}
layout(location=0) in vec3 at; layout(location=1) in vec3 turned; layout(location=2) in vec4 which; layout(location=3) in vec4 share;
uniform vec4 bones[${3 * JOINTS}]; uniform vec3 paint; uniform float unit;
out vec3 normal; out vec3 tint;
void main() {
  vec4 place = vec4(at * unit, 1.0);
  vec4 part = share / dot(share, vec4(1.0)); // rounded shares would shift far people
  vec3 there = vec3(0.0); vec3 facing = vec3(0.0);
  for (int k = 0; k < 4; k++) {
    int b = 3 * int(which[k]);
    mat4x3 bone = mat4x3(bones[b].xyz, bones[b + 1].xyz, bones[b + 2].xyz, vec3(bones[b].w, bones[b + 1].w, bones[b + 2].w));
    there += part[k] * (bone * place);
    facing += part[k] * (mat3(bone) * turned);
  }
  normal = facing; tint = paint;
  gl_Position = view * vec4(there, 1.0);
}`, LIT],
  capsule: [`${COMMON}
layout(location=0) in vec3 at; layout(location=1) in float end; layout(location=2) in vec4 one; layout(location=3) in vec3 two; layout(location=4) in vec3 paint;
out vec3 normal; out vec3 tint;
void main() {
  vec3 along = two - one.xyz; float length_ = length(along);
  vec3 w = length_ > 1e-4 ? along / length_ : vec3(0.0, 0.0, 1.0);
  vec3 u = normalize(cross(w, abs(w.z) < 0.9 ? vec3(0.0, 0.0, 1.0) : vec3(1.0, 0.0, 0.0))); vec3 v = cross(w, u);
  normal = at.x * u + at.y * v + at.z * w; tint = paint;
  gl_Position = view * vec4(mix(one.xyz, two, end) + one.w * normal, 1.0);
}`, LIT],
  line: [`${COMMON}
layout(location=0) in vec2 corner; layout(location=1) in vec4 one; layout(location=2) in vec3 two; layout(location=3) in vec4 paint;
uniform vec2 size; uniform float least; out vec4 tint;
void main() {
  vec4 a = view * vec4(one.xyz, 1.0); vec4 b = view * vec4(two, 1.0);
  if (a.w < ${NEAR} && b.w < ${NEAR}) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
  if (a.w < ${NEAR}) a = mix(a, b, (${NEAR} - a.w) / (b.w - a.w));
  if (b.w < ${NEAR}) b = mix(b, a, (${NEAR} - b.w) / (a.w - b.w));
  vec2 p = a.xy / a.w * size, q = b.xy / b.w * size;
  vec2 along = q - p; along = length(along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
  vec4 here = corner.x < 0.5 ? a : b;
  float wide = one.w > 0.0 ? one.w * length(vec3(view[0][1], view[1][1], view[2][1])) * size.y / here.w : 0.0;
  vec2 off = vec2(-along.y, along.x) * corner.y * max(least, wide) * 0.5;
  gl_Position = vec4(here.xy + off * 2.0 / size * here.w * 0.5, here.zw);
  tint = paint;
}`, `#version 300 es
precision highp float;
in vec4 tint; out vec4 color;
void main() { color = tint; }`],
  ground: [`${COMMON}
layout(location=0) in vec2 corner; uniform vec3 middle; uniform vec2 reach; out vec2 where_;
void main() { where_ = middle.xy + corner * reach; gl_Position = view * vec4(where_, middle.z, 1.0); }`, `#version 300 es
precision highp float;
in vec2 where_; uniform vec3 dark; uniform vec3 light; out vec4 color;
void main() { color = vec4(mod(floor(where_.x / 5.5), 2.0) < 0.5 ? dark : light, 1.0); }`],
  shadow: [`${COMMON}
layout(location=0) in vec2 corner; layout(location=1) in vec4 at; out vec2 where_;
void main() { where_ = corner; gl_Position = view * vec4(at.xy + corner * at.w, at.z, 1.0); }`, `#version 300 es
precision highp float;
in vec2 where_; out vec4 color;
void main() { color = vec4(0.0, 0.0, 0.0, 0.42 * (1.0 - smoothstep(0.15, 1.0, length(where_)))); }`],
};

function rgb(hex) {
  return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);
}

// Rotation vectors of a pose as quaternions (w, x, y, z), in `out`.
function toQuaternions(out, pose, at, unit) {
  for (let j = 0; j < JOINTS; j++) {
    const [x, y, z] = [pose[at + 3 * j] * unit, pose[at + 3 * j + 1] * unit, pose[at + 3 * j + 2] * unit];
    const angle = Math.hypot(x, y, z);
    const s = angle > 1e-9 ? Math.sin(angle / 2) / angle : 0.5;
    out[4 * j] = Math.cos(angle / 2);
    out[4 * j + 1] = s * x;
    out[4 * j + 2] = s * y;
    out[4 * j + 3] = s * z;
  }
}

// Joints and bones of one body in frame k of a range, or between it and a frame of the next one; null where it is missing.
export function poseBody(scene, column, now, k, next, kNext, share) {
  const { parents, rest_joints: rest } = scene.arrays;
  const persons = now.shapes.pose.shape[1];
  const row = k * persons + column;
  const place = now.arrays.place.subarray(3 * row, 3 * row + 3);
  if (!Number.isFinite(place[0])) return null;
  const turns = new Float32Array(4 * JOINTS);
  toQuaternions(turns, now.arrays.pose, 72 * row, scene.units.angle);
  const to = [...place];
  const rowNext = kNext * persons + column;
  if (next && Number.isFinite(next.arrays.place[3 * rowNext])) {
    const after = new Float32Array(4 * JOINTS);
    toQuaternions(after, next.arrays.pose, 72 * rowNext, scene.units.angle);
    for (let j = 0; j < 4 * JOINTS; j += 4) {
      let dot = 0;
      for (let c = 0; c < 4; c++) dot += turns[j + c] * after[j + c];
      let length = 0;
      for (let c = 0; c < 4; c++) {
        turns[j + c] += share * ((dot < 0 ? -after[j + c] : after[j + c]) - turns[j + c]);
        length += turns[j + c] ** 2;
      }
      for (let c = 0; c < 4; c++) turns[j + c] /= Math.sqrt(length);
    }
    for (let axis = 0; axis < 3; axis++) to[axis] += share * (next.arrays.place[3 * rowNext + axis] - place[axis]);
  }
  const frames = []; // rotations, rows first
  const joints = [];
  const bones = new Float32Array(12 * JOINTS); // columns of the rotation, with the offset in w
  for (let j = 0; j < JOINTS; j++) {
    const [w, x, y, z] = turns.subarray(4 * j, 4 * j + 4);
    const local = [
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ];
    const own = rest.subarray(72 * column + 3 * j, 72 * column + 3 * j + 3);
    const parent = parents[j];
    let R = local;
    let joint = [...own];
    if (parent >= 0) {
      const P = frames[parent];
      R = new Array(9);
      for (let r = 0; r < 3; r++) {
        for (let c = 0; c < 3; c++) R[3 * r + c] = P[3 * r] * local[c] + P[3 * r + 1] * local[3 + c] + P[3 * r + 2] * local[6 + c];
      }
      const before = rest.subarray(72 * column + 3 * parent, 72 * column + 3 * parent + 3);
      const [dx, dy, dz] = [own[0] - before[0], own[1] - before[1], own[2] - before[2]];
      joint = [0, 1, 2].map((r) => joints[parent][r] + P[3 * r] * dx + P[3 * r + 1] * dy + P[3 * r + 2] * dz);
    }
    frames.push(R);
    joints.push(joint);
    for (let c = 0; c < 3; c++) for (let r = 0; r < 3; r++) bones[12 * j + 4 * c + r] = R[3 * r + c];
    for (let r = 0; r < 3; r++) {
      bones[12 * j + 4 * r + 3] = to[r] + joint[r] - (R[3 * r] * own[0] + R[3 * r + 1] * own[1] + R[3 * r + 2] * own[2]);
    }
  }
  return { bones, body: column, skeleton: joints.map((joint) => joint.map((value, axis) => value + to[axis])) };
}

export class Scene3D {
  // canvas: the picture; labels: a canvas above it; scene: unpacked; load: (first, count) to the buffer of a range;
  // ondraw: called after each picture.
  constructor(canvas, labels, scene, load, ondraw = () => {}) {
    Object.assign(this, { canvas, labels, scene, load, ondraw });
    const gl = canvas.getContext("webgl2", { antialias: true, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser shows no 3D view: it has no WebGL 2.");
    this.gl = gl;
    this.time = 0; // in frames of the view
    this.through = null; // name of a camera
    this.follow = null; // index of a person
    this.ranges = new Map(); // by number: unpacked, or a promise
    this.people = []; // their positions in the image drawn last
    this.#build();
    this.view = { at: [0, 0, 0.9], turn: -0.5, tilt: 0.42, far: 40 };
    this.watch = new ResizeObserver(() => this.draw());
    this.watch.observe(canvas);
  }

  destroy() {
    this.watch.disconnect();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  #build() {
    const { gl, scene } = this;
    this.programs = {};
    for (const [name, sources] of Object.entries(SHADERS)) {
      const program = gl.createProgram();
      sources.forEach((source, k) => {
        const shader = gl.createShader(k ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
        gl.shaderSource(shader, source);
        gl.compileShader(shader);
        if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
        gl.attachShader(program, shader);
      });
      gl.linkProgram(program);
      const places = {};
      for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
        const each = gl.getActiveUniform(program, k).name.replace("[0]", "");
        places[each] = gl.getUniformLocation(program, each);
      }
      this.programs[name] = { program, places };
    }
    const { surface, normals, influences, shares, faces } = scene.arrays;
    this.bodies = [];
    if (surface) {
      const [persons, vertices] = scene.shapes.surface.shape;
      const shared = [this.#buffer(normals), this.#buffer(influences), this.#buffer(shares)];
      const index = this.#buffer(faces, gl.ELEMENT_ARRAY_BUFFER);
      for (let p = 0; p < persons; p++) {
        const own = this.#buffer(surface.subarray(3 * vertices * p, 3 * vertices * (p + 1)));
        const array = gl.createVertexArray();
        gl.bindVertexArray(array);
        this.#attribute(0, own, 3, gl.SHORT, false, 6);
        this.#attribute(1, shared[0], 3, gl.BYTE, true, 4);
        this.#attribute(2, shared[1], 4, gl.UNSIGNED_BYTE, false, 4);
        this.#attribute(3, shared[2], 4, gl.UNSIGNED_BYTE, true, 4);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index);
        this.bodies.push({ array, count: faces.length });
      }
    }
    this.#buildCapsule();
    const quad = this.#buffer(new Float32Array([0, -1, 1, -1, 0, 1, 1, 1]));
    const square = this.#buffer(new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    this.lines = this.#instanced(quad, 2, [[1, 4], [2, 3], [3, 4]], 11);
    this.shadows = this.#instanced(square, 2, [[1, 4]], 4);
    this.square = gl.createVertexArray();
    gl.bindVertexArray(this.square);
    this.#attribute(0, square, 2, gl.FLOAT, false, 8);
    const white = [1, 1, 1, 0.9];
    const still = scene.markings.flatMap((line) => line.slice(1).map((to, k) => [...line[k], 0.12, ...to, ...white]));
    const heights = scene.markings.flat().map((point) => point[2]);
    this.low = heights.length ? Math.min(...heights) : 0;
    // A pitch is crowned: its height, by the distance from its long axis.
    this.crown = scene.markings.flat().map(([, y, z]) => [Math.abs(y), z]).sort((a, b) => a[0] - b[0]);
    if (!still.length) {
      for (let k = -10; k <= 10; k++) {
        still.push([k, -10, 0, 0, k, 10, 0, 1, 1, 1, 0.25], [-10, k, 0, 0, 10, k, 0, 1, 1, 1, 0.25]);
      }
    }
    this.markings = new Float32Array(still.flat());
  }

  #buffer(data, kind = this.gl.ARRAY_BUFFER) {
    const buffer = this.gl.createBuffer();
    this.gl.bindVertexArray(null);
    this.gl.bindBuffer(kind, buffer);
    this.gl.bufferData(kind, data, this.gl.STATIC_DRAW);
    return buffer;
  }

  #attribute(place, buffer, size, type, normalized, stride, at = 0, every = 0) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, type, normalized, stride, at);
    gl.vertexAttribDivisor(place, every);
  }

  // A shape that is drawn once for each row of floats.
  #instanced(shape, size, parts, row) {
    const { gl } = this;
    const rows = gl.createBuffer();
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    this.#attribute(0, shape, size, gl.FLOAT, false, 4 * size);
    let at = 0;
    for (const [place, count] of parts) {
      this.#attribute(place, rows, count, gl.FLOAT, false, 4 * row, at, 1);
      at += 4 * count;
    }
    return { array, rows, row };
  }

  #buildCapsule() {
    const { gl } = this;
    const [around, up] = [12, 6];
    const points = [];
    for (let ring = 0; ring <= up + 1; ring++) {
      // The middle ring twice: once for each end.
      const end = ring > up / 2 ? 1 : 0;
      const latitude = (Math.PI * (ring - end)) / up - Math.PI / 2;
      for (let k = 0; k < around; k++) {
        const a = (2 * Math.PI * k) / around;
        points.push(Math.cos(a) * Math.cos(latitude), Math.sin(a) * Math.cos(latitude), Math.sin(latitude), end);
      }
    }
    const index = [];
    for (let ring = 0; ring <= up; ring++) {
      for (let k = 0; k < around; k++) {
        const [a, b] = [ring * around + k, ring * around + ((k + 1) % around)];
        index.push(a, b, a + around, b, b + around, a + around);
      }
    }
    const shape = this.#buffer(new Float32Array(points));
    const order = this.#buffer(new Uint16Array(index), gl.ELEMENT_ARRAY_BUFFER);
    const rows = gl.createBuffer();
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    this.#attribute(0, shape, 3, gl.FLOAT, false, 16);
    this.#attribute(1, shape, 1, gl.FLOAT, false, 16, 12);
    this.#attribute(2, rows, 4, gl.FLOAT, false, 40, 0, 1);
    this.#attribute(3, rows, 3, gl.FLOAT, false, 40, 16, 1);
    this.#attribute(4, rows, 3, gl.FLOAT, false, 40, 28, 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, order);
    this.capsules = { array, rows, row: 10, index: index.length };
  }

  #groundAt(y) {
    const found = this.crown.find(([distance]) => distance >= Math.abs(y)) ?? this.crown.at(-1);
    return found ? found[1] : 0;
  }

  // The range that contains a frame, or null while it is loading.
  range(frame) {
    const length = this.scene.range_frames;
    const number = Math.floor(frame / length);
    if (number * length >= this.scene.frames || number < 0) return null;
    const known = this.ranges.get(number);
    if (!known) {
      const asked = this.load(number * length, length).then(
        (buffer) => {
          this.ranges.set(number, unpack(buffer));
          while (this.ranges.size > 6) this.ranges.delete([...this.ranges.keys()].find((each) => each !== number));
          this.draw();
        },
        (error) => {
          this.ranges.delete(number);
          this.onproblem?.(error);
        },
      );
      this.ranges.set(number, asked);
      return null;
    }
    return known instanceof Promise ? null : known;
  }

  // Joints and bones of all people at the present time, interpolated between two frames.
  #pose() {
    const { scene } = this;
    const frame = Math.min(scene.frames - 1, Math.max(0, Math.floor(this.time)));
    const share = Math.min(1, Math.max(0, this.time - frame));
    const now = this.range(frame);
    if (now && frame + 1 < scene.frames) this.range(Math.min(scene.frames - 1, frame + scene.range_frames / 2)); // ahead of time
    if (!now) return null;
    const next = share > 0 ? this.range(Math.min(scene.frames - 1, frame + 1)) : null;
    const k = frame - now.first;
    const kNext = next ? Math.min(scene.frames - 1, frame + 1) - next.first : 0;
    return scene.people.map((person, number) => {
      if (person.body !== null && now.arrays.pose) {
        const body = poseBody(scene, person.body, now, k, next, kNext, share);
        if (body) return body;
      }
      const column = now.loose.indexOf(number);
      if (column < 0) return null;
      const at = (k * now.loose.length + column) * 51;
      const columnNext = next ? next.loose.indexOf(number) : -1;
      const atNext = columnNext < 0 ? -1 : (kNext * next.loose.length + columnNext) * 51;
      const joints = [];
      for (let j = 0; j < 17; j++) {
        const a = now.arrays.joints.subarray(at + 3 * j, at + 3 * j + 3);
        const b = atNext < 0 ? a : next.arrays.joints.subarray(atNext + 3 * j, atNext + 3 * j + 3);
        if (a[0] === MISSING) joints.push(null);
        else joints.push([0, 1, 2].map((axis) => scene.units.joint * (a[axis] + (b[0] === MISSING ? 0 : share * (b[axis] - a[axis])))));
      }
      return joints.some(Boolean) ? { joints } : null;
    });
  }

  // Row of the camera that looks: rotation, translation, focal lengths, principal point, size.
  #looking(width, height) {
    const row = this.through === null ? null : this.cameraRow(this.through);
    if (row) return row;
    const { at, turn, tilt, far } = this.view;
    const [s, c, u, d] = [Math.sin(turn), Math.cos(turn), Math.sin(tilt), Math.cos(tilt)];
    const ahead = [-s * d, c * d, -u];
    const eye = at.map((value, k) => value - far * ahead[k]);
    const R = [c, s, 0, s * u, -c * u, -d, ...ahead];
    const t = [0, 1, 2].map((r) => -(R[3 * r] * eye[0] + R[3 * r + 1] * eye[1] + R[3 * r + 2] * eye[2]));
    const focal = 1.5 * Math.max(height, 0.62 * width);
    return [...R, ...t, focal, focal, (width - 1) / 2, (height - 1) / 2, width, height];
  }

  cameraRow(name) {
    const still = this.scene.cameras.find((camera) => camera.name === name);
    if (still) return still.row;
    const frame = Math.min(this.scene.frames - 1, Math.max(0, Math.round(this.time)));
    const range = this.range(frame);
    const rows = range?.arrays.broadcast;
    if (!rows || name !== this.scene.broadcast) return null;
    const row = Array.from(rows.subarray(18 * (frame - range.first), 18 * (frame - range.first) + 18));
    return Number.isFinite(row[0]) ? row : null;
  }

  // World to clip coordinates, by columns.
  #matrix(row, width, height) {
    const [fx, fy, cx, cy, w, h] = row.slice(12);
    const scale = Math.min(width / w, height / h);
    const [ax, bx] = [(2 * scale * fx) / width, (2 * scale * (cx + 0.5 - w / 2)) / width];
    const [ay, by] = [(2 * scale * fy) / height, (2 * scale * (cy + 0.5 - h / 2)) / height];
    const [k1, k2] = [(FAR + NEAR) / (FAR - NEAR), (-2 * FAR * NEAR) / (FAR - NEAR)];
    const of = (r, c) => (c < 3 ? row[3 * r + c] : row[9 + r]);
    const M = new Float32Array(16);
    for (let c = 0; c < 4; c++) {
      M[4 * c] = ax * of(0, c) + bx * of(2, c);
      M[4 * c + 1] = -(ay * of(1, c) + by * of(2, c));
      M[4 * c + 2] = k1 * of(2, c) + (c === 3 ? k2 : 0);
      M[4 * c + 3] = of(2, c);
    }
    return M;
  }

  draw() {
    if (this.wanted) return;
    this.wanted = requestAnimationFrame(() => {
      this.wanted = null;
      this.#paint();
    });
  }

  #paint() {
    const { gl, canvas, scene } = this;
    if (gl.isContextLost()) return;
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * ratio)));
    for (const each of [canvas, this.labels]) if (each.width !== width || each.height !== height) Object.assign(each, { width, height });
    const people = this.#pose();
    if (people) this.posed = people;
    const shown = people ?? this.posed ?? [];
    if (!this.isFramed && people?.some(Boolean)) this.home();
    if (this.follow !== null && shown[this.follow]) {
      const [x, y] = this.#middle(shown[this.follow]);
      this.view.at = [x, y, 0.9];
    }
    const M = this.#matrix(this.#looking(width, height), width, height);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.66, 0.75, 0.82, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.disable(gl.DEPTH_TEST);
    const isPitch = scene.markings.length > 0;
    this.#use("ground", M);
    gl.uniform3fv(this.programs.ground.places.middle, [0, 0, this.low]);
    gl.uniform2fv(this.programs.ground.places.reach, isPitch ? [66, 48] : [14, 14]);
    gl.uniform3fv(this.programs.ground.places.dark, isPitch ? [0.235, 0.42, 0.27] : [0.36, 0.4, 0.44]);
    gl.uniform3fv(this.programs.ground.places.light, isPitch ? [0.26, 0.455, 0.295] : [0.36, 0.4, 0.44]);
    gl.bindVertexArray(this.square);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    this.#drawLines(this.markings, M, width, height, 1.1 * ratio);
    const spots = shown.filter(Boolean).map((person) => {
      const [x, y] = this.#middle(person);
      return [x, y, this.#groundAt(y) + 0.01, 0.42];
    });
    this.#fill(this.shadows, new Float32Array(spots.flat()));
    this.#use("shadow", M);
    gl.bindVertexArray(this.shadows.array);
    if (spots.length) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, spots.length);
    gl.enable(gl.DEPTH_TEST);
    this.#drawPeople(shown, M);
    this.#drawLines(new Float32Array(this.#frusta().flat()), M, width, height, 1.3 * ratio);
    this.#write(shown, M, width, height, ratio);
    this.ondraw();
  }

  #use(name, M) {
    this.gl.useProgram(this.programs[name].program);
    this.gl.uniformMatrix4fv(this.programs[name].places.view, false, M);
  }

  #fill(what, rows) {
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, what.rows);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, rows, this.gl.DYNAMIC_DRAW);
  }

  #drawLines(rows, M, width, height, least) {
    if (!rows.length) return;
    const { gl } = this;
    this.#fill(this.lines, rows);
    this.#use("line", M);
    gl.uniform2f(this.programs.line.places.size, width, height);
    gl.uniform1f(this.programs.line.places.least, 2 * least);
    gl.bindVertexArray(this.lines.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, rows.length / 11);
  }

  #drawPeople(people, M) {
    const { gl, scene } = this;
    const rows = [];
    this.#use("body", M);
    gl.uniform1f(this.programs.body.places.unit, scene.units.surface);
    people.forEach((person, number) => {
      if (!person) return;
      const paint = rgb(scene.people[number].color).map((value) => (this.follow === number ? 0.45 + 0.55 * value : value));
      const mesh = person.bones && this.bodies[person.body];
      if (mesh) {
        gl.uniform4fv(this.programs.body.places.bones, person.bones);
        gl.uniform3fv(this.programs.body.places.paint, paint);
        gl.bindVertexArray(mesh.array);
        gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_SHORT, 0);
      } else if (person.skeleton) {
        const { parents } = scene.arrays;
        for (let j = 1; j < JOINTS; j++) {
          const radius = j === HEAD ? 0.1 : [1, 2, 3, 6, 9].includes(j) ? 0.1 : 0.055;
          rows.push([...person.skeleton[parents[j]], radius, ...person.skeleton[j], ...paint]);
        }
      } else {
        for (const [a, b] of scene.bones) {
          if (person.joints[a] && person.joints[b]) rows.push([...person.joints[a], a < 5 && b < 5 ? 0.07 : 0.055, ...person.joints[b], ...paint]);
        }
      }
    });
    if (!rows.length) return;
    this.#fill(this.capsules, new Float32Array(rows.flat()));
    this.#use("capsule", M);
    gl.bindVertexArray(this.capsules.array);
    gl.drawElementsInstanced(gl.TRIANGLES, this.capsules.index, gl.UNSIGNED_SHORT, 0, rows.length);
  }

  #centre(row) {
    return [0, 1, 2].map((axis) => -(row[axis] * row[9] + row[3 + axis] * row[10] + row[6 + axis] * row[11]));
  }

  // Lines from each camera to the corners of its image, 2.5 m away; of the broadcast camera to the ground.
  #frusta() {
    const lines = [];
    const all = [...this.scene.cameras.map((each) => each.name), ...(this.scene.broadcast ? [this.scene.broadcast] : [])];
    for (const name of all) {
      const row = this.through === name ? null : this.cameraRow(name);
      if (!row) continue;
      const isMoving = name === this.scene.broadcast;
      const centre = this.#centre(row);
      const [fx, fy, cx, cy, w, h] = row.slice(12);
      const corners = [[0, 0], [w, 0], [w, h], [0, h]].map(([u, v]) => {
        const ray = [(u - 0.5 - cx) / fx, (v - 0.5 - cy) / fy, 1];
        const to = [0, 1, 2].map((axis) => row[axis] * ray[0] + row[3 + axis] * ray[1] + row[6 + axis] * ray[2]);
        const far = isMoving ? (to[2] < -0.01 ? Math.min(-centre[2] / to[2], 200) : 200) : 2.5;
        return centre.map((value, axis) => value + far * to[axis]);
      });
      const paint = isMoving ? [1, 0.84, 0.29, 0.9] : [1, 1, 1, 0.75];
      corners.forEach((corner, k) => lines.push([...centre, 0, ...corner, ...paint], [...corner, 0, ...corners[(k + 1) % 4], ...paint]));
    }
    return lines;
  }

  #middle(person) {
    if (person.skeleton) return person.skeleton[0];
    const hips = [11, 12].map((j) => person.joints[j]).filter(Boolean);
    const all = hips.length ? hips : person.joints.filter(Boolean);
    return [0, 1, 2].map((axis) => all.reduce((sum, joint) => sum + joint[axis], 0) / all.length);
  }

  #write(people, M, width, height, ratio) {
    const pen = this.labels.getContext("2d");
    pen.clearRect(0, 0, width, height);
    pen.font = `600 ${12 * ratio}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.lineWidth = 3 * ratio;
    pen.strokeStyle = "rgba(0, 0, 0, .55)";
    pen.lineJoin = "round";
    const put = ([x, y, z], text, color) => {
      const w = M[3] * x + M[7] * y + M[11] * z + M[15];
      if (w < NEAR) return null;
      const at = [
        (width * (1 + (M[0] * x + M[4] * y + M[8] * z + M[12]) / w)) / 2,
        (height * (1 - (M[1] * x + M[5] * y + M[9] * z + M[13]) / w)) / 2,
      ];
      pen.strokeText(text, at[0], at[1]);
      pen.fillStyle = color;
      pen.fillText(text, at[0], at[1]);
      return at;
    };
    this.people = people.map((person, number) => {
      if (!person) return null;
      const middle = this.#middle(person);
      const top = person.skeleton ? person.skeleton[HEAD] : middle;
      const { id, name } = this.scene.people[number];
      const at = put([top[0], top[1], Math.max(top[2] + 0.32, middle[2] + 0.5)], name || String(id), "#fff");
      return at && { at: at.map((value) => value / ratio), world: middle };
    });
    for (const { name, row } of this.scene.cameras) {
      if (this.through === name) continue;
      const centre = this.#centre(row);
      put([centre[0], centre[1], centre[2] + 0.4], name, "#dfe9ee");
    }
  }

  // All people of this frame in the picture.
  home() {
    const people = (this.posed ?? []).filter(Boolean).map((person) => this.#middle(person));
    this.through = this.follow = null;
    if (people.length) {
      this.isFramed = true;
      const low = [0, 1].map((axis) => Math.min(...people.map((at) => at[axis])));
      const high = [0, 1].map((axis) => Math.max(...people.map((at) => at[axis])));
      const reach = Math.hypot(high[0] - low[0], high[1] - low[1]);
      const shape = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
      this.view = { at: [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0.9], turn: -0.5, tilt: 0.42, far: Math.max(9, (1.15 * reach) / Math.min(1, shape) + 4) };
    }
    this.draw();
  }

  look(change) {
    this.through = null;
    Object.assign(this.view, change);
    this.draw();
  }

  orbit(dx, dy) {
    const tilt = Math.min(1.57, Math.max(0.02, this.view.tilt + 0.006 * dy));
    this.look({ turn: this.view.turn - 0.006 * dx, tilt });
  }

  pan(dx, dy) {
    this.follow = null;
    const scale = this.view.far / (1.5 * Math.max(this.canvas.clientHeight, 0.62 * this.canvas.clientWidth));
    const [s, c] = [Math.sin(this.view.turn), Math.cos(this.view.turn)];
    const [right, ahead] = [-dx * scale, (dy * scale) / Math.max(0.25, Math.sin(this.view.tilt))];
    const [x, y, z] = this.view.at;
    this.look({ at: [x + c * right - s * ahead, y + s * right + c * ahead, z] });
  }

  zoom(factor) {
    this.look({ far: Math.min(400, Math.max(2, this.view.far * factor)) });
  }

  // Number of the person at a place on the canvas, or null.
  personAt(x, y) {
    let [best, near] = [null, 40];
    this.people.forEach((person, number) => {
      const distance = person ? Math.hypot(person.at[0] - x, person.at[1] + 14 - y) : Infinity;
      if (distance < near) [best, near] = [number, distance];
    });
    return best;
  }
}
