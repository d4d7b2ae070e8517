// How numbers and moments are written.

// A point that only its place names, `at_52.50_19.16`, is (52.5, 19.2) m.
export const spoken = (name) =>
  name.replace(/^at_(-?[\d.]+)_(-?\d+\.\d+)/, (_, ...place) => `(${place.slice(0, 2).map((text) => Number(Number(text).toFixed(1))).join(", ")}) m`)
    .replace(/\.again\w*$/, ", once more").replaceAll("_", " ");

export function shown(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value !== 0 && Math.abs(value) < 0.001) return value.toExponential(1);
  return Number(value.toPrecision(3)).toString();
}

const UNITS = { m: "m", mm: "mm", px: "px", rad: "rad", deg: "°", s: "s", frames: "frames", hz: "Hz" };

const unitOf = (name) => UNITS[/_([a-z]+)$/.exec(name)?.[1]];
const withoutUnit = (name) => spoken(unitOf(name) ? name.replace(/_[a-z]+$/, "") : name);

// The name of a metric, `offset_rms_m`, as a title: `offset rms [m]`.
export const metric = (name) => (unitOf(name) ? `${withoutUnit(name)} [${unitOf(name)}]` : withoutUnit(name));

// An expected error on the ground, in the unit that a person thinks in.
export function ground(metres) {
  if (metres === null || metres === undefined) return "–";
  return metres < 1 ? `${Number((100 * metres).toPrecision(2))} cm` : `${metres.toPrecision(2)} m`;
}

export function ago(moment) {
  if (!moment) return "–";
  const seconds = (Date.now() - new Date(moment)) / 1000;
  const steps = [
    [60, "s"],
    [60, "min"],
    [24, "h"],
    [Infinity, "d"],
  ];
  let value = Math.max(0, seconds);
  for (const [length, unit] of steps) {
    if (value < length) return `${Math.floor(value)} ${unit}`;
    value /= length;
  }
}

// A date as people read it: today the time alone.
export function moment(text) {
  const date = new Date(text);
  const time = date.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", hour12: false });
  if (date.toDateString() === new Date().toDateString()) return `today, ${time}`;
  return `${date.toLocaleDateString([], { day: "numeric", month: "short", year: "numeric" })}, ${time}`;
}

export const parts = (unit) => {
  const at = unit.indexOf("/");
  return [unit.slice(0, at), unit.slice(at + 1)];
};

// Results as operators say them.
const RESULTS = {
  static_calibration: "Calibration of", detection: "People in", camera_consistency: "Cameras that contradict each other in", tracking: "Tracks in", triangulation: "Joints in",
  bundle_adjustment: "Adjustment of the", body_fitting: "Bodies in", broadcast_calibration: "Camera of",
};
export function result(unit) {
  const [stage, name] = parts(unit);
  return `${RESULTS[stage] ?? spoken(stage)} ${name.replace(".", ", ")}`;
}

// A message that names results as the journal does, `tracking/clip`.
export const plain = (text) => text.replace(/\b([a-z_]+)\/[\w.-]*\w/g, (unit, stage) => (stage in RESULTS ? result(unit) : unit));

export function bytes(count) {
  if (count < 1e6) return `${Math.ceil(count / 1e3)} kB`;
  return count < 1e9 ? `${(count / 1e6).toFixed(0)} MB` : `${(count / 1e9).toFixed(1)} GB`;
}
