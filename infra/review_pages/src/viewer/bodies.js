// Surfaces of bodies, which follow their bones. Each has three, from fine to rough.

import { makeBuffer, setAttribute } from "./buffers.js";
import { JOINTS, POSE_TEXELS } from "./shaders.js";

// px: heights of a person in the picture above which the surfaces in their order are used
const FINE = [150, 60, 0];
const REDUCED = [300, 60, 0];
const ROUGH = 2; // the last of them

// Which surface a person of this height in the picture needs.
export const levelOf = (tall, reduced) => (reduced ? REDUCED : FINE).findIndex((least) => tall > least);

export class Bodies {
  constructor(gl, scene) {
    Object.assign(this, { gl, scene });
    const { surface, normals, influences, shares, faces, coarse_faces: coarse } = scene.arrays;
    const [persons, vertices] = scene.shapes.surface.shape;
    const [own, ...shared] = [surface, normals, influences, shares].map((each) => makeBuffer(gl, each));
    const orders = [faces, coarse].map((each) => ({ index: makeBuffer(gl, each, gl.ELEMENT_ARRAY_BUFFER), count: each.length }));
    this.surfaces = Array.from({ length: persons }, (_, p) =>
      orders.map(({ index, count }) => {
        const array = gl.createVertexArray();
        gl.bindVertexArray(array);
        this.#attributes([own, ...shared], 6 * vertices * p);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index);
        return { array, count };
      }),
    );
    this.#buildRough(persons, vertices);
    this.poses = new Float32Array(4 * POSE_TEXELS * persons);
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, gl.NEAREST);
  }

  // The rough surfaces of all people together: each call costs where the processor draws.
  #buildRough(persons, vertices) {
    const { gl } = this;
    const { surface, normals, influences, shares, rough_faces: rough } = this.scene.arrays;
    const used = [...new Set(rough)];
    const places = new Map(used.map((vertex, k) => [vertex, k]));
    const all = Array.from({ length: persons }, (_, p) => p);
    const gather = (from, size, step) => all.flatMap((p) => used.flatMap((v) => Array.from(from.subarray(step * p + size * v, step * p + size * (v + 1)))));
    const buffers = [
      makeBuffer(gl, new Int16Array(gather(surface, 3, 3 * vertices))),
      makeBuffer(gl, new Int8Array(gather(normals, 4, 0))),
      makeBuffer(gl, new Uint8Array(gather(influences, 4, 0))),
      makeBuffer(gl, new Uint8Array(gather(shares, 4, 0))),
    ];
    const numbers = makeBuffer(gl, new Float32Array(all.flatMap((p) => used.map(() => p))));
    const order = all.flatMap((p) => Array.from(rough, (v) => p * used.length + places.get(v)));
    const index = makeBuffer(gl, new Uint32Array(order), gl.ELEMENT_ARRAY_BUFFER);
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    this.#attributes(buffers, 0);
    setAttribute(gl, 4, numbers, 1, gl.FLOAT, false, 4);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index);
    this.rough = { array, count: order.length };
  }

  #attributes([places, normals, influences, shares], at) {
    const { gl } = this;
    setAttribute(gl, 0, places, 3, gl.SHORT, false, 6, at);
    setAttribute(gl, 1, normals, 3, gl.BYTE, true, 4);
    setAttribute(gl, 2, influences, 4, gl.UNSIGNED_BYTE, false, 4);
    setAttribute(gl, 3, shares, 4, gl.UNSIGNED_BYTE, true, 4);
  }

  // Draw bodies: each a posed person, colours of the joints, and the level of its surface. The program of bodies is in use.
  draw(meshes, places, reduced) {
    const { gl, poses } = this;
    poses.fill(0);
    for (const { person, colors, level } of meshes) {
      const row = 4 * POSE_TEXELS * person.body;
      poses.set(person.bones, row);
      colors.forEach((color, j) => poses.set([...color, level + 1], row + 12 * JOINTS + 4 * j));
    }
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, POSE_TEXELS, this.surfaces.length, 0, gl.RGBA, gl.FLOAT, poses);
    gl.uniform1f(places.unit, this.scene.units.surface);
    gl.uniform1i(places.joints, reduced ? 2 : 4);
    for (const { person, level } of meshes) {
      if (level === ROUGH) continue;
      const { array, count } = this.surfaces[person.body][level];
      gl.uniform1f(places.level, level + 1);
      gl.bindVertexArray(array);
      gl.vertexAttrib1f(4, person.body);
      gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_SHORT, 0);
    }
    if (!meshes.some((each) => each.level === ROUGH)) return;
    gl.uniform1f(places.level, ROUGH + 1);
    gl.bindVertexArray(this.rough.array);
    gl.drawElements(gl.TRIANGLES, this.rough.count, gl.UNSIGNED_INT, 0);
  }
}
