// Cameras of the 3D view as rows of 18 numbers: rotation (rows first), translation, focal lengths, principal point, image size;
// axes of OpenCV.

import { FAR, NEAR } from "./shaders.js";

export function centreOf(row) {
  return [0, 1, 2].map((axis) => -(row[axis] * row[9] + row[3 + axis] * row[10] + row[6 + axis] * row[11]));
}

// Camera that looks at a place from a distance.
export function orbitRow({ at, turn, tilt, far }, width, height) {
  const [s, c, u, d] = [Math.sin(turn), Math.cos(turn), Math.sin(tilt), Math.cos(tilt)];
  const ahead = [-s * d, c * d, -u];
  const eye = at.map((value, k) => value - far * ahead[k]);
  const R = [c, s, 0, s * u, -c * u, -d, ...ahead];
  const t = [0, 1, 2].map((r) => -(R[3 * r] * eye[0] + R[3 * r + 1] * eye[1] + R[3 * r + 2] * eye[2]));
  const focal = 1.5 * Math.max(height, 0.62 * width);
  return [...R, ...t, focal, focal, (width - 1) / 2, (height - 1) / 2, width, height];
}

// World to clip coordinates, by columns; the camera's image fits into the canvas.
export function matrixOf(row, width, height) {
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

// Place of a point on the canvas [px], or null behind the camera.
export function project(M, [x, y, z], width, height) {
  const w = M[3] * x + M[7] * y + M[11] * z + M[15];
  if (w < NEAR) return null;
  return [(width * (1 + (M[0] * x + M[4] * y + M[8] * z + M[12]) / w)) / 2, (height * (1 - (M[1] * x + M[5] * y + M[9] * z + M[13]) / w)) / 2];
}

// Lines (two points, paint) from a camera to the corners of its image and around it, at a depth [m], or null: on the ground.
export function frustum(row, depth, paint) {
  const centre = centreOf(row);
  const [fx, fy, cx, cy, w, h] = row.slice(12);
  const corners = [[0, 0], [w, 0], [w, h], [0, h]].map(([u, v]) => {
    const ray = [(u - 0.5 - cx) / fx, (v - 0.5 - cy) / fy, 1];
    const to = [0, 1, 2].map((axis) => row[axis] * ray[0] + row[3 + axis] * ray[1] + row[6 + axis] * ray[2]);
    const far = depth ?? (to[2] < -0.01 ? Math.min(-centre[2] / to[2], 200) : 200);
    return centre.map((value, axis) => value + far * to[axis]);
  });
  return corners.flatMap((corner, k) => [[...centre, 0, ...corner, ...paint], [...corner, 0, ...corners[(k + 1) % 4], ...paint]]);
}
