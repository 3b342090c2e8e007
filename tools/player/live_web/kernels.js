// The solver by the package's own kernels in WebAssembly, which gaussian_swaying/viewer/live_web/kernels.py writes into the block.
import { QUICK, tug } from "./body.js";
import { LOOKS, Solver, WIDE } from "./solver.js";

const ROW = 8; // numbers of a node in the kernels' memory: displacement and velocity, four each
const OLD = 1 / (16 * QUICK); // s, for which the force of a pull is used again, as reading all points takes as long as a substep
const TIMES = 4; // numbers of a substep in the table of times, of which the first row is that before

export class KernelSolver extends Solver {
  /** @param {{head: any, arrays: Record<string, any>}} block Throws an Error where the browser has no such WebAssembly. */
  constructor(block) {
    super(block);
    const { image, fusedCode, plainCode } = block.arrays;
    const { start, places } = block.head.kernels;
    if (!globalThis.WebAssembly?.validate(plainCode)) throw new Error("this browser has no WebAssembly with SIMD");
    const memory = new WebAssembly.Memory({ initial: Math.ceil((start + image.length) / 65536) });
    const stack = new WebAssembly.Global({ value: "i32", mutable: true }, start);
    const env = { __linear_memory: memory, __stack_pointer: stack, fmaxf: Math.max, sinf: Math.sin, cosf: Math.cos };
    const code = new WebAssembly.Module(WebAssembly.validate(fusedCode) ? fusedCode : plainCode);
    this.kernels = /** @type {any} */ (new WebAssembly.Instance(code, { env }).exports);
    new Uint8Array(memory.buffer).set(image, start);
    const view = (name, Kind = Float32Array) => {
      const [first, bytes] = places[name];
      return new Kind(memory.buffer, first, bytes / Kind.BYTES_PER_ELEMENT);
    };
    this.tables = Object.fromEntries(Object.keys(places).map((name) => [name, view(name)]));
    this.clock = view("clock", Float64Array);
    this.length = view("step", Float64Array);
    this.moduli = this.tables.material.slice(this.points, 3 * this.points);
    this.curving = this.tables.curving?.slice(); // the square of which is a stiffness
    this.stiffened = 1;
    /** The pull whose force is in the table, and since when. @type {{pull: any, time: number}} */
    this.tugged = { pull: null, time: 0 };
  }

  /** The state to or from the memory of the kernels. */
  exchange(/** @type {boolean} */ out) {
    const { fields } = this.tables;
    const { active } = this.a;
    for (let k = 0; k < active.length; k++)
      for (let m = 0; m < 3; m++) {
        const [at, own] = [ROW * active[k] + m, WIDE * k + m];
        if (out) (this.displacement[own] = fields[at]), (this.velocity[own] = fields[at + 4]);
        else (fields[at] = this.displacement[own]), (fields[at + 4] = this.velocity[own]);
      }
  }

  /** See Solver. */
  roll(dt, steps) {
    this.exchange(false);
    let farthest = 0;
    const far = () => {
      this.measure();
      farthest = Math.max(farthest, this.far(dt));
    };
    const every = Math.max(1, Math.ceil(steps / LOOKS));
    for (let k = 0; k < steps; k++) {
      if (k > 0 && k % every === 0) far();
      this.step(dt);
    }
    far();
    this.exchange(true);
    return farthest;
  }

  /** See Solver. */
  look() {
    this.exchange(false);
    this.measure();
    this.kernels.read();
    const { velocity } = this.tables;
    for (let p = 0; p < this.points; p++) {
      const at = 3 * this.a.order[p];
      this.speed[p] = Math.hypot(velocity[at], velocity[at + 1], velocity[at + 2]);
    }
  }

  /** What decides about the Courant number; stress is the stiffness times that in the file, and so is the square of the wave. */
  measure() {
    const { stiffness, head } = this;
    const { fastest } = this.tables;
    fastest.fill(0);
    this.kernels.look();
    const wave = Math.sqrt(stiffness * (fastest[0] ** 2 + head.bending)); // see Formulation.with_bending
    this.seen = { time: this.time, stiffness, wave, viscous: head.viscous * Math.max(fastest[1] ** 2, 1) };
  }

  stiffen() {
    if (this.stiffened === this.stiffness) return;
    this.stiffened = this.stiffness;
    this.tables.material.set(this.moduli.map((x) => x * this.stiffness), this.points);
    this.tables.curving?.set(this.curving.map((x) => x * Math.sqrt(this.stiffness)));
  }

  /** One substep of `dt` [s]. */
  step(dt) {
    const { tables, kernels, head } = this;
    this.stiffen();
    const kick = this.kick(dt);
    tables.schedule.set([kick, dt, Math.exp(-head.damping * kick)], TIMES);
    this.clock[0] = this.time;
    this.length[0] = dt;
    if (!this.idle) {
      this.wind.blow(this.time, this.blown);
      tables.winds.set(this.blown);
    }
    if (this.pull) {
      const { pull, time } = this.tugged;
      if (pull !== this.pull || this.time < time || this.time - time >= OLD) this.tug(this.pull);
      kernels.pulled();
    } else {
      kernels.free();
    }
    this.time += dt;
    this.substep = dt;
  }

  /** A spring and a damper to where the visitor pulls, on the points that are held. */
  tug(/** @type {import("./body.js").Pull} */ pull) {
    const { position, velocity, force } = this.tables;
    this.tugged = { pull, time: this.time };
    this.kernels.read();
    force.fill(0);
    for (let p = 0; p < this.points; p++) {
      if (pull.held[p] === 0) continue;
      const at = this.a.order[p];
      const [place, speed] = [position, velocity].map((field) => field.subarray(3 * at, 3 * at + 3));
      const own = force.subarray(4 * at, 4 * at + 4);
      own[3] = tug(pull, p, place, speed, own);
    }
  }

  /** Places of all points [m]. */
  positions(to) {
    this.exchange(false);
    this.kernels.read();
    for (let p = 0; p < this.points; p++)
      for (let m = 0; m < 3; m++) to[3 * p + m] = this.tables.position[3 * this.a.order[p] + m];
  }
}
