// How numbers and moments are written.

export const spoken = (name) => name.replaceAll("_", " ");

export function shown(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value !== 0 && Math.abs(value) < 0.001) return value.toExponential(1);
  return Number(value.toPrecision(3)).toString();
}

const UNITS = { m: "m", mm: "mm", px: "px", rad: "rad", deg: "°", s: "s", frames: "frames", hz: "Hz" };

// Metrics whose names alone mislead.
const WORDS = { clicks_wrong: "outlier clicks" };

const unitOf = (name) => UNITS[/_([a-z]+)$/.exec(name)?.[1]];
const withoutUnit = (name) => WORDS[name] ?? spoken(unitOf(name) ? name.replace(/_[a-z]+$/, "") : name);

// The name of a metric, `offset_rms_m`, as a title: `offset rms [m]`.
export const metric = (name) => (unitOf(name) ? `${withoutUnit(name)} [${unitOf(name)}]` : withoutUnit(name));

// Why a gate holds a result, `offset_rms_m is 0.05, at most 0.03 passes`, as a person reads it: `offset rms: 0.05 m, limit 0.03 m`.
export const reason = (text) =>
  text
    .replace(/^(\w+) is (\S+?)( \(.*\))?, at most (\S+) passes$/, (_, name, value, parts, limit) => {
      const behind = unitOf(name) ? ` ${unitOf(name)}` : "";
      return `${withoutUnit(name)}: ${value}${behind}${parts ?? ""}, limit ${limit}${behind}`;
    })
    .replace(/^(\w+)(?= could not be computed$)/, (name) => withoutUnit(name));

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

// The state of a match as `worldpose status` has it: its latest run, and the units that differ from it.
export function unsettled({ units }) {
  return units ? { stale: units.stale, missing: units.missing, ready: units.ready, all: units.stale + units.missing + units.ready } : { stale: 0, missing: 0, ready: 0, all: 0 };
}

export const isOutdated = (match) => Boolean(match.run) && unsettled(match).stale + unsettled(match).ready > 0;

const unitCount = (count) => `${count} ${count === 1 ? "unit" : "units"}`;

export function outdated(match) {
  const { stale, missing, ready } = unsettled(match);
  return stale + missing ? `out of date: ${unitCount(stale + missing)} to recompute` : `out of date: ${unitCount(ready)} to take over from earlier runs`;
}

export const parts = (unit) => {
  const at = unit.indexOf("/");
  return [unit.slice(0, at), unit.slice(at + 1)];
};

export function bytes(count) {
  if (count < 1e6) return `${Math.ceil(count / 1e3)} kB`;
  return count < 1e9 ? `${(count / 1e6).toFixed(0)} MB` : `${(count / 1e9).toFixed(1)} GB`;
}
