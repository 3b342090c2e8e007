// The solver by the package's own kernels in WebAssembly, which gaussian_swaying/viewer/live_web/kernels.py writes into the block.
import { largestSquare } from "./laws.js";
import { Solver, WIDE } from "./solver.js";

const ROW = 8; // numbers of a node in the kernels' memory: displacement and velocity, four each
const TIMES = 4; // numbers of a substep in the table of times, of which the first row is that before

export class KernelSolver extends Solver {
  /** @param {{head: any, arrays: Record<string, any>}} block Throws an Error where the browser has no such WebAssembly. */
  constructor(block) {
    super(block);
    const { image, fusedCode, plainCode } = block.arrays;
    const { start, places } = block.head.kernels;
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
    this.inside = false; // whether the state is that in the memory
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
    this.inside = true;
    const far = super.roll(dt, steps);
    this.inside = false;
    this.exchange(true);
    return far;
  }

  /** See Solver; within a frame only what decides about the Courant number. */
  look() {
    const { tables, seen, stiffness, head, inside } = this;
    if (seen.time === this.time && seen.stiffness === stiffness) return;
    this.exchange(inside);
    const bending = Math.sqrt(stiffness * head.bending); // see Formulation.with_bending
    if (!tables.fastest) { // several laws
      super.look();
      this.seen.wave = Math.hypot(this.seen.wave, bending);
      return;
    }
    this.stiffen();
    tables.fastest[0] = 0;
    this.kernels.look();
    let stretched = 1;
    if (!inside || head.viscous > 0) this.kernels.read();
    for (let p = 0; !inside && p < this.points; p++) {
      const [at, { velocity: v }] = [3 * this.a.order[p], tables];
      this.speed[p] = Math.sqrt(v[at] * v[at] + v[at + 1] * v[at + 1] + v[at + 2] * v[at + 2]);
    }
    for (let p = 0; head.viscous > 0 && p < this.points; p++)
      stretched = Math.max(stretched, largestSquare(tables.F.subarray(9 * p, 9 * p + 9)));
    const wave = Math.hypot(tables.fastest[0], bending);
    this.seen = { time: this.time, stiffness, wave, viscous: head.viscous * stretched };
  }

  stiffen() {
    if (this.stiffened === this.stiffness) return;
    this.stiffened = this.stiffness;
    this.tables.material.set(this.moduli.map((x) => x * this.stiffness), this.points);
    this.tables.curving?.set(this.curving.map((x) => x * Math.sqrt(this.stiffness)));
  }

  /** See Solver. */
  step(dt, looked) {
    const { tables, kernels, head } = this;
    if (looked) this.look();
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
      this.exchange(true);
      tables.force.fill(0);
      this.pulls(this.pull);
      kernels.pulled();
    } else {
      kernels.free();
    }
    this.time += dt;
    this.substep = dt;
  }

  /** See Solver. */
  push(p, force, damping) {
    this.tables.force.set([...force.subarray(0, 3), damping], 4 * this.a.order[p]);
  }
}
