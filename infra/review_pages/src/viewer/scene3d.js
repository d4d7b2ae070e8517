// 3D view of a clip in plain WebGL 2: people as skinned bodies, capsules or discs, the pitch, cameras. It needs no library, no
// network and no framework: a canvas, and the parts of worldpose/formats/viewer_file.py.

import { Bodies, levelOf } from "./bodies.js";
import { Batch, makeBuffer, setAttribute } from "./buffers.js";
import { Labels } from "./labels.js";
import { centreOf, frustum, matrixOf, orbitRow, project } from "./lens.js";
import { GREY, paintings, personColor, spreadColor } from "./paint.js";
import { posePerson, toBody, unpack } from "./payload.js";
import { JOINTS, NEAR, SHADERS } from "./shaders.js";

const HEAD = 15;
const TRUNK = new Set([1, 2, 3, 6, 9]); // joints whose bones are thick
const STRIPE = 5.5; // m
const PERSON = 1.8; // m
const RANGES = 12; // that stay in memory

// Whether this browser draws with the processor alone: then edges are not smoothed, and detail is reduced.
function drawsInSoftware() {
  const probe = document.createElement("canvas").getContext("webgl2");
  if (!probe) throw new Error("This browser shows no 3D view: it has no WebGL 2.");
  const names = probe.getExtension("WEBGL_debug_renderer_info");
  const name = String(probe.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : probe.RENDERER));
  probe.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

export class Scene3D {
  // canvas: the picture; scene: unpacked; load: (first, count) to the buffer of a range; ondraw: called after each picture.
  constructor(canvas, scene, load, ondraw = () => {}) {
    Object.assign(this, { canvas, scene, load, ondraw });
    this.isSlow = drawsInSoftware();
    const gl = canvas.getContext("webgl2", { antialias: !this.isSlow, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser shows no 3D view: it has no WebGL 2.");
    this.gl = gl;
    this.time = 0; // in frames
    this.through = null; // name of a camera
    this.follow = null; // index of a person
    this.painting = "person";
    this.names = true;
    this.cameraDepth = scene.markings.length ? 2.5 : 0.5; // of the pyramids of static cameras [m]: a pitch, or a room
    this.reduced = this.isSlow;
    this.ranges = new Map(); // by number: unpacked, or a promise
    this.paintings = paintings(scene);
    this.#build();
    this.view = { at: [0, 0, 0.9], turn: -0.5, tilt: 0.42, far: 40 };
    this.watch = new ResizeObserver(() => {
      if (!this.isTouched) this.#frame();
      this.draw();
    });
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
    this.bodies = scene.arrays.surface ? new Bodies(gl, scene) : null;
    this.#buildCapsule();
    const square = [-1, -1, 1, -1, -1, 1, 1, 1];
    const line = [0, -1, 1, -1, 0, 1, 1, 1];
    this.lines = new Batch(gl, line, [4, 3, 4]);
    this.painted = new Batch(gl, line, [4, 3, 4]);
    this.spots = new Batch(gl, square, [4, 4]);
    this.words = new Batch(gl, square, [3, 4, 3]);
    this.stripes = new Batch(gl, square, [4, 3]);
    this.#buildGround();
  }

  #buildGround() {
    const { markings } = this.scene;
    const white = [1, 1, 1, 0.9];
    const still = markings.flatMap((line) => line.slice(1).map((to, k) => [...line[k], 0.12, ...to, ...white]));
    const heights = markings.flat().map((point) => point[2]);
    this.low = heights.length ? Math.min(...heights) : 0;
    // A pitch is crowned: its height, by the distance from its long axis.
    this.crown = markings.flat().map(([, y, z]) => [Math.abs(y), z]).sort((a, b) => a[0] - b[0]);
    if (!still.length) {
      for (let k = -10; k <= 10; k++) {
        still.push([k, -10, 0, 0, k, 10, 0, 1, 1, 1, 0.25], [-10, k, 0, 0, 10, k, 0, 1, 1, 1, 0.25]);
      }
    }
    this.painted.fill(still.flat(), this.gl.STATIC_DRAW);
    this.stripes.fill(this.#stripes(), this.gl.STATIC_DRAW);
  }

  // Boxes (x, y of two corners) and colours of the mown grass, or of plain ground where there is no pitch.
  #stripes() {
    const points = this.scene.markings.flat();
    if (!points.length) return [-14, -14, 14, 14, 0.36, 0.4, 0.44];
    const [x, y] = [0, 1].map((axis) => 10 + Math.max(...points.map((point) => Math.abs(point[axis]))));
    const count = 2 * Math.ceil(x / STRIPE);
    return Array.from({ length: count }, (_, k) => {
      const left = (k - count / 2) * STRIPE;
      return [Math.max(-x, left), -y, Math.min(x, left + STRIPE), y, ...(k % 2 ? [0.26, 0.455, 0.295] : [0.235, 0.42, 0.27])];
    }).flat();
  }

  #buildCapsule() {
    const { gl } = this;
    const [around, up] = this.isSlow ? [7, 4] : [12, 6];
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
    const shape = makeBuffer(gl, new Float32Array(points));
    const order = makeBuffer(gl, new Uint16Array(index), gl.ELEMENT_ARRAY_BUFFER);
    const rows = gl.createBuffer();
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    setAttribute(gl, 0, shape, 3, gl.FLOAT, false, 16);
    setAttribute(gl, 1, shape, 1, gl.FLOAT, false, 16, 12);
    setAttribute(gl, 2, rows, 4, gl.FLOAT, false, 40, 0, 1);
    setAttribute(gl, 3, rows, 3, gl.FLOAT, false, 40, 16, 1);
    setAttribute(gl, 4, rows, 3, gl.FLOAT, false, 40, 28, 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, order);
    this.capsules = { array, rows, index: index.length };
  }

  #groundAt(y) {
    const found = this.crown.find(([distance]) => distance >= Math.abs(y)) ?? this.crown.at(-1);
    return found ? found[1] : 0;
  }

  // A promise of the range that contains a frame.
  async rangeOf(frame) {
    const number = Math.floor(frame / this.scene.range_frames);
    if (!this.ranges.has(number)) this.#load(number);
    return this.ranges.get(number);
  }

  #load(number) {
    const length = this.scene.range_frames;
    const asked = this.load(number * length, length).then(
      (buffer) => {
        const found = unpack(buffer);
        this.ranges.set(number, found);
        while (this.ranges.size > RANGES) this.ranges.delete([...this.ranges.keys()].find((each) => each !== number));
        this.draw();
        return found;
      },
      (error) => {
        this.ranges.delete(number);
        this.onproblem?.(error);
      },
    );
    this.ranges.set(number, asked);
  }

  // The range that contains a frame, or null while it is loading.
  range(frame) {
    const number = Math.floor(frame / this.scene.range_frames);
    if (frame >= this.scene.frames || number < 0) return null;
    const known = this.ranges.get(number);
    if (!known) this.#load(number);
    return !known || known instanceof Promise ? null : known;
  }

  // All people of a frame, as they are without interpolation.
  async peopleAt(frame) {
    const range = await this.rangeOf(frame);
    return this.scene.people.map((_, number) => posePerson(this.scene, number, range, frame - range.first));
  }

  // All people at the present time, interpolated between two frames; null while they are loading.
  #pose() {
    const { scene } = this;
    const last = scene.frames - 1;
    const frame = Math.min(last, Math.max(0, Math.floor(this.time)));
    const share = Math.min(1, Math.max(0, this.time - frame));
    const now = this.range(frame);
    if (!now) return null;
    this.range(Math.min(last, frame + Math.floor(scene.range_frames / 2))); // ahead of time
    const next = share > 0 && frame < last ? this.range(frame + 1) : null;
    return scene.people.map((_, number) => posePerson(scene, number, now, frame - now.first, next, next ? frame + 1 - next.first : 0, share));
  }

  // Row of the camera that looks.
  #looking(width, height) {
    const row = this.through === null ? null : this.cameraRow(this.through);
    return row ?? orbitRow(this.view, width, height);
  }

  cameraRow(name) {
    const still = this.scene.cameras.find((camera) => camera.name === name);
    if (still) return still.row;
    const frame = Math.min(this.scene.frames - 1, Math.max(0, Math.round(this.time)));
    const range = this.range(frame);
    const rows = range?.arrays.moving;
    const { moving } = this.scene;
    if (!rows || !moving.includes(name)) return null;
    const begin = 18 * ((frame - range.first) * moving.length + moving.indexOf(name));
    const row = Array.from(rows.subarray(begin, begin + 18));
    return Number.isFinite(row[0]) ? row : null;
  }

  draw() {
    if (this.wanted) return;
    this.wanted = requestAnimationFrame(() => {
      this.wanted = null;
      this.paint();
    });
  }

  // Draw the picture now.
  paint() {
    const { gl, canvas, scene } = this;
    if (gl.isContextLost()) return;
    const ratio = this.reduced ? 1 : Math.min(2, window.devicePixelRatio || 1);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * ratio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const people = this.#pose();
    if (people) this.posed = people;
    const shown = people ?? this.posed ?? [];
    if (!this.isFramed && people?.some(Boolean)) this.#frame();
    if (this.follow !== null && shown[this.follow]) {
      const [x, y] = this.#middle(shown[this.follow]);
      this.view.at = [x, y, 0.9];
    }
    const M = matrixOf(this.#looking(width, height), width, height);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.66, 0.75, 0.82, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    this.#drawGround(M);
    gl.enable(gl.BLEND);
    this.#drawLines(this.painted, M, width, height, 1.1 * ratio);
    this.#drawSpots(shown, M);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    this.#drawPeople(shown, M, width, height);
    gl.disable(gl.CULL_FACE);
    gl.enable(gl.BLEND);
    this.lines.fill(this.#frusta(shown));
    this.#drawLines(this.lines, M, width, height, 1.3 * ratio);
    gl.disable(gl.DEPTH_TEST);
    if (this.names) this.#write(shown, M, width, height, ratio);
    this.last = { M, width, height, ratio, shown };
    this.pictures = (this.pictures ?? 0) + 1;
    this.ondraw();
  }

  #use(name, M) {
    this.gl.useProgram(this.programs[name].program);
    this.gl.uniformMatrix4fv(this.programs[name].places.view, false, M);
    return this.programs[name].places;
  }

  #drawGround(M) {
    const places = this.#use("ground", M);
    this.gl.uniform1f(places.level, this.low);
    this.stripes.draw();
  }

  #drawLines(batch, M, width, height, least) {
    const { gl } = this;
    const places = this.#use("line", M);
    gl.uniform2f(places.size, width, height);
    gl.uniform1f(places.least, 2 * least);
    batch.draw();
  }

  // Shadows of bodies, and discs of people whom their feet alone place.
  #drawSpots(people, M) {
    const rows = [];
    people.forEach((person, number) => {
      if (!person) return;
      const [x, y] = this.#middle(person);
      const z = this.#groundAt(y) + 0.01;
      rows.push(x, y, z, 0.42, 0, 0, 0, 0.42);
      if (person.feet) rows.push(x, y, z, 0.5, ...this.#discColor(person, number), 1);
    });
    this.spots.fill(rows);
    this.#use("spot", M);
    this.spots.draw();
  }

  #discColor(person, number) {
    if (this.painting === "spread") return spreadColor(person.feetSpread);
    return this.painting === "views" ? GREY : this.#colorOf(number);
  }

  #colorOf(number) {
    const color = personColor(this.scene, number, this.painting);
    return this.follow === number ? color.map((value) => 0.45 + 0.55 * value) : color;
  }

  // Colours of the joints of a person, 24 of a body or 17 keypoints.
  #jointColors(person, number) {
    const { of, value } = this.paintings[this.painting];
    const count = person.skeleton ? JOINTS : 17;
    if (!of) return new Array(count).fill(this.#colorOf(number));
    const values = person.evidence().map((each) => each[value]);
    return (person.skeleton ? toBody(values) : values).map((each) => of({ [value]: each }));
  }

  // Which of its surfaces a body needs, by its height in the picture; null outside of the picture.
  #level(person, M, width, height) {
    const [x, y, z] = this.#middle(person);
    const w = M[3] * x + M[7] * y + M[11] * z + M[15];
    const tall = (PERSON * Math.hypot(M[1], M[5], M[9]) * height) / (2 * Math.max(w, NEAR));
    const spot = project(M, [x, y, z], width, height);
    if (!spot) return w > -PERSON ? 0 : null;
    const away = Math.max(Math.abs(spot[0] - width / 2) - width / 2, Math.abs(spot[1] - height / 2) - height / 2);
    if (away > tall) return null;
    return levelOf(tall, this.reduced);
  }

  #drawPeople(people, M, width, height) {
    const { scene } = this;
    const meshes = [];
    const rows = [];
    people.forEach((person, number) => {
      if (!person || person.feet) return;
      const level = this.#level(person, M, width, height);
      if (level === null) return;
      const colors = this.#jointColors(person, number);
      if (person.skeleton && this.bodies) {
        meshes.push({ person, colors, level });
      } else if (person.skeleton) {
        const { parents } = scene.arrays;
        for (let j = 1; j < JOINTS; j++) {
          const radius = j === HEAD || TRUNK.has(j) ? 0.1 : 0.055;
          rows.push(...person.skeleton[parents[j]], radius, ...person.skeleton[j], ...colors[j]);
        }
      } else {
        for (const [a, b] of scene.bones) {
          if (person.joints[a] && person.joints[b]) rows.push(...person.joints[a], a < 5 && b < 5 ? 0.07 : 0.055, ...person.joints[b], ...colors[b]);
        }
      }
    });
    if (meshes.length) this.bodies.draw(meshes, this.#use("body", M), this.reduced);
    if (rows.length) this.#drawCapsules(rows, M);
  }

  #drawCapsules(rows, M) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.capsules.rows);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(rows), gl.DYNAMIC_DRAW);
    this.#use("capsule", M);
    gl.bindVertexArray(this.capsules.array);
    gl.drawElementsInstanced(gl.TRIANGLES, this.capsules.index, gl.UNSIGNED_SHORT, 0, rows.length / 10);
  }

  // Lines of each camera to the corners of its image, of a broadcast camera to the ground; and a pole for each person on a disc.
  #frusta(people) {
    const rows = [];
    for (const { name, row } of this.scene.cameras) if (this.through !== name) rows.push(...frustum(row, this.cameraDepth, [1, 1, 1, 0.75]).flat());
    for (const name of this.scene.moving) {
      const row = this.through === name ? null : this.cameraRow(name);
      if (row) rows.push(...frustum(row, null, [1, 0.84, 0.29, 0.9]).flat());
    }
    people.forEach((person, number) => {
      if (!person?.feet) return;
      const [x, y] = person.feet;
      const z = this.#groundAt(y);
      rows.push(x, y, z, 0.05, x, y, z + this.#stature(number), ...this.#discColor(person, number), 0.8);
    });
    return rows;
  }

  // Height of a person on a disc [m].
  #stature(number) {
    return this.scene.people[number].height ?? 1.8;
  }

  #middle(person) {
    if (person.skeleton) return person.skeleton[0];
    if (person.feet) return [...person.feet, this.#groundAt(person.feet[1]) + 0.9];
    const hips = [11, 12].map((j) => person.joints[j]).filter(Boolean);
    const all = hips.length ? hips : person.joints.filter(Boolean);
    return [0, 1, 2].map((axis) => all.reduce((sum, joint) => sum + joint[axis], 0) / all.length);
  }

  // What is written above a person; people on discs say that.
  #nameOf(number, isOnDisc) {
    const { id, name } = this.scene.people[number];
    return `${name || id}${isOnDisc ? " (feet)" : ""}`;
  }

  #write(people, M, width, height, ratio) {
    const { gl } = this;
    if (this.labels?.ratio !== ratio) {
      this.labels?.destroy();
      const texts = this.scene.people.flatMap((_, number) => [this.#nameOf(number, false), this.#nameOf(number, true)]);
      this.labels = new Labels(gl, [...new Set([...texts, ...this.scene.cameras.map((each) => each.name), ...this.scene.moving])], ratio);
      this.labels.ratio = ratio;
    }
    const found = [];
    people.forEach((person, number) => {
      if (!person) return;
      const middle = this.#middle(person);
      const top = person.skeleton ? person.skeleton[HEAD] : middle;
      const high = person.feet ? this.#groundAt(middle[1]) + this.#stature(number) + 0.1 : Math.max(top[2] + 0.26, middle[2] + 0.5);
      found.push([[top[0], top[1], high], this.#nameOf(number, Boolean(person.feet)), this.follow === number ? [1, 0.9, 0.4] : [1, 1, 1]]);
    });
    for (const name of [...this.scene.cameras.map((each) => each.name), ...this.scene.moving]) {
      const row = this.through === name ? null : this.cameraRow(name);
      if (!row) continue;
      const [x, y, z] = centreOf(row);
      found.push([[x, y, z + 0.16 * this.cameraDepth], name, this.scene.moving.includes(name) ? [1, 0.84, 0.29] : [0.87, 0.91, 0.93]]);
    }
    this.words.fill(this.labels.apart(found, M, width, height));
    const places = this.#use("label", M);
    gl.uniform2f(places.size, width, height);
    gl.uniform2fv(places.sheet, this.labels.size);
    gl.bindTexture(gl.TEXTURE_2D, this.labels.texture);
    this.words.draw();
  }

  #frame() {
    const people = (this.posed ?? []).filter(Boolean).map((person) => this.#middle(person));
    if (!people.length) return;
    this.isFramed = true;
    const [width, height] = [Math.max(1, this.canvas.clientWidth), Math.max(1, this.canvas.clientHeight)];
    const middle = [0, 1].map((axis) => (Math.min(...people.map((at) => at[axis])) + Math.max(...people.map((at) => at[axis]))) / 2);
    this.view = { at: [...middle, 0.9], turn: -0.5, tilt: 0.42, far: 9 };
    const isInside = (at, M) => {
      const spot = project(M, at, width, height);
      return spot && Math.abs(spot[0] / width - 0.5) < 0.46 && Math.abs(spot[1] / height - 0.5) < 0.44;
    };
    const ends = people.flatMap(([x, y, z]) => [[x, y, z - 1], [x, y, z + 1.3]]);
    while (this.view.far < 300) {
      const M = matrixOf(orbitRow(this.view, width, height), width, height);
      if (ends.every((at) => isInside(at, M))) break;
      this.view.far *= 1.05;
    }
  }

  // All people of this frame in the picture.
  home() {
    this.through = this.follow = null;
    this.isTouched = false;
    this.#frame();
    this.draw();
  }

  look(change) {
    this.isTouched = true; // from now on the view is the user's, whatever the size of the page
    this.through = null;
    Object.assign(this.view, change);
    this.draw();
  }

  // Turn the view by these numbers of pixels.
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
    if (!this.last) return null;
    const { M, width, height, ratio, shown } = this.last;
    let [best, near] = [null, 40];
    shown.forEach((person, number) => {
      const at = person && project(M, this.#middle(person), width, height);
      const distance = at ? Math.hypot(at[0] / ratio - x, at[1] / ratio - y) : Infinity;
      if (distance < near) [best, near] = [number, distance];
    });
    return best;
  }
}
