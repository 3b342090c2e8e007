// What a visitor has set, as the link of the page keeps it: #wind=4,0,0&gusts=0.5&stiffness=2&speed=0.25&view=x,y,z,x,y,z, and
// where it is computed: solver=webgpu or solver=worker

/**
 * @typedef {{wind: number[] | null, gusts: number, stiffness: number, speed: number, view: number[] | null,
 *   solver: string}} Settings
 */

/** @type {Settings} */
export const USUAL = { wind: null, gusts: 1, stiffness: 1, speed: 1, view: null, solver: "auto" };

const SOLVERS = ["webgpu", "worker"];

/** The least and the largest value of each, which the sliders have, too. */
export const LIMITS = { gusts: [0, 3], stiffness: [0.125, 4], speed: [0.05, 1] };
const FASTEST = 50; // m/s

/** The settings in a link; what is not there, or cannot be, is as usual. @param {string} text @returns {Settings} */
export function readSettings(text) {
  const given = new URLSearchParams(text.replace(/^[#?]/, ""));
  const found = { ...USUAL };
  const numbers = (name, count) => {
    const parts = (given.get(name) ?? "").split(",").map((part) => (part.trim() === "" ? NaN : Number(part)));
    return parts.length === count && parts.every(Number.isFinite) ? parts : null;
  };
  const wind = numbers("wind", 3);
  if (wind && Math.hypot(...wind) <= FASTEST) found.wind = wind;
  for (const name in LIMITS) {
    const one = numbers(name, 1);
    const [low, high] = LIMITS[name];
    if (one) found[name] = Math.min(Math.max(one[0], low), high);
  }
  const view = numbers("view", 6);
  if (view && Math.hypot(view[0] - view[3], view[1] - view[4], view[2] - view[5]) > 0) found.view = view;
  const solver = given.get("solver");
  if (solver !== null && SOLVERS.includes(solver)) found.solver = solver;
  return found;
}

/** @param {Settings} settings @returns {string} without the leading # */
export function writeSettings(settings) {
  const one = (part) => (typeof part === "number" ? String(Number(part.toFixed(3))) : part);
  const text = (value) => [value].flat().map(one).join(",");
  return Object.keys(USUAL)
    .filter((name) => settings[name] !== null && settings[name] !== USUAL[name])
    .map((name) => `${name}=${text(settings[name])}`)
    .join("&");
}
