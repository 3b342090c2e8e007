// What all solvers have: what is simulated, its wind, and the pull of the visitor.
import { Wind } from "./wind.js";

/** @typedef {{held: Float64Array, offset: Float64Array, target: Float64Array}} Pull See gaussian_swaying/viewer/pull.py. */

const REACH = 0.06; // radius of what is pulled, as a share of the longest side
const QUICK = 40; // 1/s
const STRONGEST = 400; // m/s²

/**
 * Spring and damper on a point that is pulled: adds up to a force [N] in `out` 0 to 2.
 * @param {Pull} pull @param {number} p the point @param {Float64Array} place [m] @param {Float64Array} velocity [m/s]
 * @param {Float64Array} out @returns {number} its damping [kg/s]
 */
export function tug(pull, p, place, velocity, out) {
  const held = pull.held[p];
  const [x, y, z] = [0, 1, 2].map((m) => QUICK ** 2 * (pull.target[m] + pull.offset[3 * p + m] - place[m]));
  const limit = STRONGEST / Math.max(Math.hypot(x, y, z), STRONGEST);
  const damping = 2 * QUICK * held;
  out[0] = held * limit * x - damping * velocity[0];
  out[1] = held * limit * y - damping * velocity[1];
  out[2] = held * limit * z - damping * velocity[2];
  return damping;
}

export class Body {
  /** @param {{head: any, arrays: Record<string, any>}} block */
  constructor({ head, arrays }) {
    this.head = head;
    this.a = arrays;
    this.points = arrays.mass.length;
    this.wind = new Wind(head.wind, arrays.turbulence);
    this.idle = head.idle;
    /** Stiffness, as a multiple of that in the file. */
    this.stiffness = 1;
    /** Whether substeps are as long as is still stable; else they are those of the package. */
    this.hurried = false;
    /** @type {Pull | null} */
    this.pull = null;
  }

  /**
   * Takes hold of the material where a ray meets it.
   * @param {number[]} eye [m] @param {number[]} ray unit vector @param {number} wide tangent of how far from the ray it may be
   * @returns {number[] | null} the place [m]
   */
  grab(eye, ray, wide) {
    const { mass } = this.a;
    const position = new Float64Array(3 * this.points);
    let [best, at] = [Infinity, -1];
    this.positions(position);
    for (let p = 0; p < this.points; p++) {
      let depth = 0;
      for (let m = 0; m < 3; m++) depth += (position[3 * p + m] - eye[m]) * ray[m];
      const off = Math.hypot(...[0, 1, 2].map((m) => position[3 * p + m] - eye[m] - depth * ray[m]));
      const reached = Math.max(off - this.head.dx / 2, 0) / depth;
      if (depth > 0 && reached < wide && depth + 20 * off < best) [best, at] = [depth + 20 * off, p];
    }
    if (at < 0) return null;
    const centre = position.subarray(3 * at, 3 * at + 3);
    const reach = REACH * this.head.size;
    const held = new Float64Array(this.points);
    const mean = [0, 0, 0];
    let sum = 0;
    for (let p = 0; p < this.points; p++) {
      const far = Math.hypot(...[0, 1, 2].map((m) => position[3 * p + m] - centre[m]));
      held[p] = far < reach || p === at ? mass[p] * Math.exp(-(((2 * far) / reach) ** 2)) : 0;
      sum += held[p];
      for (let m = 0; m < 3; m++) mean[m] += held[p] * position[3 * p + m];
    }
    for (let m = 0; m < 3; m++) mean[m] /= sum;
    const offset = position.map((x, i) => x - mean[i % 3]);
    this.pull = { held, offset, target: Float64Array.from(mean) };
    return [...mean];
  }
}
