// The coverage map as a picture: how far off the camera puts what stands on the pitch.

const BEST = 0.005; // [m]
const WORST = 1.0; // [m]
// Dark is well known, bright is not; brightness alone tells it, for any colour vision.
const STEPS = [
  [12, 44, 84],
  [38, 88, 120],
  [94, 130, 126],
  [164, 168, 112],
  [240, 216, 92],
];

export const STOPS = [0.01, 0.03, 0.1, 0.3];

export function shade(metres) {
  const share = Math.log(metres / BEST) / Math.log(WORST / BEST);
  const at = Math.max(0, Math.min(0.9999, share)) * (STEPS.length - 1);
  const k = Math.floor(at);
  return STEPS[k].map((value, c) => Math.round(value + (at - k) * (STEPS[k + 1][c] - value)));
}

// A data URL of one pixel a place, first row at the bottom of the map, and where it lies [m].
export function coverage({ x, y, expected }) {
  const canvas = document.createElement("canvas");
  canvas.width = x.length;
  canvas.height = y.length;
  const context = canvas.getContext("2d");
  const image = context.createImageData(x.length, y.length);
  for (let row = 0; row < y.length; row++) {
    for (let column = 0; column < x.length; column++) {
      const value = expected[row][column];
      if (value === null) continue;
      const at = 4 * ((y.length - 1 - row) * x.length + column);
      image.data.set([...shade(value), 255], at);
    }
  }
  context.putImageData(image, 0, 0);
  const step = [(x.at(-1) - x[0]) / (x.length - 1), (y.at(-1) - y[0]) / (y.length - 1)];
  return {
    url: canvas.toDataURL(),
    x: x[0] - step[0] / 2,
    y: -(y.at(-1) + step[1] / 2),
    width: x.at(-1) - x[0] + step[0],
    height: y.at(-1) - y[0] + step[1],
  };
}
