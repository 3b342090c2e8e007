// What both solvers have: the package's own kernels in WebAssembly, which gaussian_swaying/player/live_web/kernels.py writes into the block,
// the memory that they work in, the wind, and the pull of the visitor.
import { Wind } from "./wind.js";

/** @typedef {{held: Float64Array, offset: Float64Array, target: Float64Array}} Pull See gaussian_swaying/mpm/pull.py. */

const REACH = 0.06; // radius of what is pulled, as a share of the longest side
const KINDS = { f4: Float32Array, f8: Float64Array, i4: Int32Array };

export class Body {
  /** @param {{head: any, arrays: Record<string, any>}} block Throws an Error where the browser has no such WebAssembly. */
  constructor({ head, arrays }) {
    this.head = head;
    this.a = arrays;
    this.points = arrays.mass.length;
    const { image, fusedCode, plainCode } = arrays;
    const { start, places } = head.kernels;
    if (!globalThis.WebAssembly?.validate(plainCode)) throw new Error("this browser has no WebAssembly with SIMD");
    const memory = new WebAssembly.Memory({ initial: Math.ceil((start + image.length) / 65536) });
    const stack = new WebAssembly.Global({ value: "i32", mutable: true }, start);
    const { max, sin, cos, exp, log } = Math;
    const env = { __linear_memory: memory, __stack_pointer: stack, fmaxf: max, sinf: sin, cosf: cos, sin, cos, exp, log };
    const code = new WebAssembly.Module(WebAssembly.validate(fusedCode) ? fusedCode : plainCode);
    this.kernels = /** @type {any} */ (new WebAssembly.Instance(code, { env }).exports);
    new Uint8Array(memory.buffer).set(image, start);
    /** @type {Record<string, any>} */
    this.tables = {};
    for (const [name, [first, count, kind]] of Object.entries(places)) this.tables[name] = new KINDS[kind](memory.buffer, first, count);
    for (const { name, table, unit } of head.packed) this.tables[table].set(Float32Array.from(arrays[name], (x) => unit * x));
    this.wind = new Wind(head.wind, this.kernels, this.tables);
    /** Computes substeps in place of this processor. @type {import("./webgpu.js").Gpu | null} */
    this.gpu = null;
    /** Stiffness, as a multiple of that in the file. */
    this.stiffness = 1;
  }

  /** Back to rest. */
  reset() {
    this.time = 0;
    /** Whether substeps are as long as is still stable; else they are those of the package. */
    this.hurried = false;
    /** @type {Pull | null} */
    this.pull = null;
    this.wind.reset();
  }

  /** Writes what the kernels need of the wind and the pull in substeps that begin at some times [s]. */
  blow(/** @type {number[]} */ times) {
    const { pull, tables, points } = this;
    const { widths, pull: [row, column] } = this.head.kernels;
    const width = widths[pull ? 1 : 0];
    if (!this.head.idle) this.wind.write(times, width);
    if (!pull) return;
    times.forEach((_, k) => tables.winds.set(pull.target, width * k + column));
    const values = tables.values.subarray(points * row);
    this.a.sorted.forEach((own, p) => {
      for (let m = 0; m < 3; m++) values[m * points + p] = pull.offset[3 * own + m];
      values[3 * points + p] = pull.held[own];
    });
  }

  /**
   * Takes hold of the material where a ray meets it.
   * @param {number[]} eye [m] @param {number[]} ray unit vector @param {number} wide tangent of how far from the ray it may be
   * @returns {number[] | null} the place [m]
   */
  grab(eye, ray, wide) {
    const { mass } = this.a;
    this.kernels.read();
    const { position } = this.tables;
    let [best, at] = [Infinity, -1];
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
    const offset = Float64Array.from(position, (x, i) => x - mean[i % 3]);
    this.pull = { held, offset, target: Float64Array.from(mean) };
    return [...mean];
  }
}
