// Buffers and attributes of WebGL, and rectangles drawn together.

export function makeBuffer(gl, data, kind = gl.ARRAY_BUFFER) {
  const buffer = gl.createBuffer();
  gl.bindVertexArray(null);
  gl.bindBuffer(kind, buffer);
  gl.bufferData(kind, data, gl.STATIC_DRAW);
  return buffer;
}

export function setAttribute(gl, place, buffer, size, type, normalized, stride, at = 0, every = 0) {
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, size, type, normalized, stride, at);
  gl.vertexAttribDivisor(place, every);
}

// Rectangles with the same corners (x, y of four), each with a row of floats, in parts of these lengths. Instances of four corners
// would be slow where the processor draws.
export class Batch {
  constructor(gl, corners, parts) {
    const row = parts.reduce((a, b) => a + b, 0);
    Object.assign(this, { gl, corners, row, count: 0, room: 0, array: gl.createVertexArray(), vertices: gl.createBuffer() });
    gl.bindVertexArray(this.array);
    setAttribute(gl, 0, this.vertices, 2, gl.FLOAT, false, 4 * (2 + row));
    let at = 8;
    parts.forEach((count, k) => {
      setAttribute(gl, k + 1, this.vertices, count, gl.FLOAT, false, 4 * (2 + row), at);
      at += 4 * count;
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  }

  fill(rows, use = this.gl.DYNAMIC_DRAW) {
    const { gl, row, corners } = this;
    const count = rows.length / row;
    const data = new Float32Array(count * 4 * (2 + row));
    for (let k = 0, to = 0; k < count; k++) {
      for (let corner = 0; corner < 4; corner++) {
        data[to++] = corners[2 * corner];
        data[to++] = corners[2 * corner + 1];
        for (let c = 0; c < row; c++) data[to++] = rows[k * row + c];
      }
    }
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.vertices);
    gl.bufferData(gl.ARRAY_BUFFER, data, use);
    if (count > this.room) {
      this.room = count;
      const order = Uint16Array.from({ length: 6 * count }, (_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6]);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, order, use);
    }
    this.count = count;
  }

  draw() {
    this.gl.bindVertexArray(this.array);
    this.gl.drawElements(this.gl.TRIANGLES, 6 * this.count, this.gl.UNSIGNED_SHORT, 0);
  }
}
