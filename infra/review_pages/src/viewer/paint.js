// Colours of people: their own, their team's, or by how well their joints are known.

export const GREY = [0.6, 0.62, 0.63];
// After Okabe and Ito; the first two are those of the teams in the order of their names.
const TEAMS = ["#d55e00", "#0072b2", "#f0e442", "#009e73"];
// From well known to badly known: distinguishable with any colour vision, and in grey.
const RAMP = [[0.13, 0.3, 0.62], [0.24, 0.6, 0.75], [0.94, 0.86, 0.42], [0.93, 0.5, 0.16], [0.7, 0.1, 0.12]];
export const SPREAD_SCALE = [0.005, 0.2]; // m
const VIEWS_SCALE = [6, 1]; // cameras

export const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);
export const css = (color) => `rgb(${color.map((value) => Math.round(255 * value)).join(" ")})`;

function ramp(share) {
  const at = Math.min(1, Math.max(0, share)) * (RAMP.length - 1);
  const k = Math.min(RAMP.length - 2, Math.floor(at));
  return RAMP[k].map((value, c) => value + (at - k) * (RAMP[k + 1][c] - value));
}

export function spreadColor(spread) {
  const [least, most] = SPREAD_SCALE;
  return Number.isFinite(spread) ? ramp(Math.log(spread / least) / Math.log(most / least)) : GREY;
}

function viewsColor(views) {
  const [most, least] = VIEWS_SCALE;
  return Number.isFinite(views) ? ramp((most - views) / (most - least)) : GREY;
}

const teamColor = (teams, name) => (name ? rgb(TEAMS[teams.indexOf(name) % TEAMS.length]) : GREY);
export const teamsOf = (scene) => [...new Set(scene.people.map((person) => person.team).filter(Boolean))].sort();

// Ways to colour people, by name: their title, the text and gradient of the legend, and the colour of a keypoint's evidence.
export function paintings(scene) {
  const bar = `linear-gradient(to right, ${RAMP.map(css).join(", ")})`;
  const teams = teamsOf(scene);
  return {
    person: { title: "by person" },
    ...(teams.length ? { team: { title: "by team", teams: teams.map((name) => [name, css(teamColor(teams, name))]) } } : {}),
    spread: { title: "by uncertainty", bar, low: "5 mm", high: "200 mm", about: "standard deviation per axis; grey: unknown", of: (each) => spreadColor(each.spread), value: "spread" },
    views: { title: "by cameras", bar, low: "6 or more cameras", high: "1 or none", about: "cameras that contribute; grey: unknown", of: (each) => viewsColor(each.views), value: "views" },
  };
}

// Colour of a person as a whole.
export function personColor(scene, number, painting) {
  const { team, color } = scene.people[number];
  return painting === "team" ? teamColor(teamsOf(scene), team) : rgb(color);
}
