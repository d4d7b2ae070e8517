// Names in the 3D view: drawn once into a sheet of letters, and from there as rectangles of the picture.

import { project } from "./lens.js";

const HIGH = 18; // px of one line at ratio 1

export class Labels {
  // texts: all that will be written.
  constructor(gl, texts, ratio) {
    this.gl = gl;
    this.boxes = new Map();
    const sheet = document.createElement("canvas");
    const pen = sheet.getContext("2d");
    const font = `600 ${12 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
    pen.font = font;
    const high = Math.ceil(HIGH * ratio);
    const widths = texts.map((text) => 2 * Math.ceil(pen.measureText(text).width / 2 + 3 * ratio));
    const wide = Math.min(2048, Math.max(256, ...widths));
    let [x, y] = [0, 0];
    texts.forEach((text, k) => {
      const width = Math.min(wide, widths[k]);
      if (x + width > wide) [x, y] = [0, y + high];
      this.boxes.set(text, [x, y, width, high]);
      x += width;
    });
    [sheet.width, sheet.height] = [wide, y + high];
    Object.assign(pen, { font, textAlign: "center", textBaseline: "middle", lineWidth: 3 * ratio, lineJoin: "round", strokeStyle: "rgba(0, 0, 0, .6)", fillStyle: "#fff" });
    for (const [text, [left, top, width]] of this.boxes) {
      pen.strokeText(text, left + width / 2, top + high / 2);
      pen.fillText(text, left + width / 2, top + high / 2);
    }
    this.size = [sheet.width, sheet.height];
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, sheet);
    for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, gl.NEAREST);
    for (const which of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, which, gl.CLAMP_TO_EDGE);
  }

  // Rows of instances: texts above their places, without those that would overlap a nearer one.
  apart(found, M, width, height) {
    const kept = [];
    const depth = ([[x, y, z]]) => M[3] * x + M[7] * y + M[11] * z + M[15];
    return found.toSorted((a, b) => depth(a) - depth(b)).flatMap(([place, text, color]) => {
      const [at, box] = [project(M, place, width, height), this.boxes.get(text)];
      if (!at || kept.some(([x, y, wide]) => 2 * Math.abs(at[0] - x) < wide + box[2] && Math.abs(at[1] - y) < box[3])) return [];
      kept.push([...at, box[2]]);
      return [...place, ...box, ...color];
    });
  }

  destroy() {
    this.gl.deleteTexture(this.texture);
  }
}
