// A body by the material point method in its total Lagrangian form, by the package's own kernels in WebAssembly, which
// gaussian_swaying/viewer/live_web/kernels.py writes into the block. Its frames are those of gaussian_swaying/simulation/step.py.
import { Body } from "./body.js";

export const LOOKS = 8; // checks of the Courant number in a frame
export const MOST = 256; // substeps that the tables have room for
const LIMIT = 0.5; // a frame that exceeds it is repeated with shorter substeps
const RETRIES = 4;
const SAMPLES = 5; // winds of a frame that the drag is bounded with
const MOST_GROWTH = 1000; // a frame that takes this many times the substeps of the first has diverged
const ROW = 8; // numbers of a node: displacement and velocity, four each
const TIMES = 4; // numbers of a substep in the table of times, of which the first row is that before

export class Solver extends Body {
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
    const view = ([first, bytes], Kind = Float32Array) => new Kind(memory.buffer, first, bytes / Kind.BYTES_PER_ELEMENT);
    this.tables = Object.fromEntries(Object.entries(places).map(([name, place]) => [name, view(place)]));
    this.first = view(places.first, Int32Array); // substep within the tables
    this.clock = view(places.clock, Float64Array);
    this.length = view(places.step, Float64Array);
    this.moduli = this.tables.material.slice(this.points, 3 * this.points);
    this.curving = this.tables.curving?.slice(); // the square of which is a stiffness
    this.before = this.tables.fields.slice();
    this.blown = new Float64Array(3);
    /** Computes substeps in place of this processor. @type {import("./webgpu.js").Gpu | null} */
    this.gpu = null;
    this.steps = null; // of the first frame
    this.reset();
  }

  /** Back to rest. */
  reset() {
    this.tables.fields.fill(0);
    this.tables.velocity.fill(0);
    this.time = 0;
    this.substep = 0; // the last one [s]
    this.pull = null;
    this.hurried = false;
    /** The last measurement: when, the square of the fastest wave [m²/s²], and that of the largest stretch. */
    this.seen = { time: NaN, wave: 0, stretch: 1 };
  }

  // ---- frames

  /**
   * Advance by one frame, with as many substeps as it needs.
   * @returns {number | Promise<number>} substeps; the promise of a graphics card is rejected with NoWebGPU where that fails
   */
  advance() {
    const frame = this.frame();
    let told = frame.next();
    if (this.gpu) return this.gpu.finish(frame, told, this);
    while (!told.done) told = frame.next(this.roll(...told.value));
    return told.value;
  }

  /**
   * The trials of a frame: yields the length [s] and number of substeps, and gets how far the fastest wave came in one of them [m].
   * @returns {Generator<[number, number], number, number>}
   */
  *frame() {
    const { dx, frameDt } = this.head;
    const cfl = this.hurried ? this.head.longest : this.head.cfl;
    const { fields } = this.tables;
    this.before.set(fields);
    const [time, substep] = [this.time, this.substep];
    if (this.seen.time !== time) this.measure();
    let steps = this.substeps(cfl);
    this.steps ??= steps;
    for (let retry = 0; ; retry++) {
      if (steps > MOST_GROWTH * this.steps) throw new Error("the motion has become too fast to be computed");
      const courant = (yield [frameDt / steps, steps]) / dx;
      if (courant <= Math.max(LIMIT, 1.25 * cfl) || this.head.substep !== null) return steps;
      if (retry === RETRIES) {
        if (courant <= 2) return steps;
        throw new Error("the motion has become too fast to be computed");
      }
      const growth = Number.isFinite(courant) ? courant / cfl : 4;
      steps = Math.floor(steps * Math.min(growth * 1.1, 4)) + 1;
      fields.set(this.before);
      [this.time, this.substep] = [time, substep];
    }
  }

  /** Substeps of the next frame, from waves in the material and drag on light patches. */
  substeps(cfl) {
    const { frameDt, dx, substep } = this.head;
    const [wave, viscous] = [this.wave(), this.viscous()];
    let longest = substep ?? cfl / Math.max(wave / dx, 1e-30);
    if (viscous > 0 && substep === null) longest = longest ** 2 / (viscous + Math.sqrt(viscous ** 2 + longest ** 2));
    const waves = Math.max(1, Math.ceil(frameDt / longest - 1e-6));
    return this.a.rate.length === 0 ? waves : Math.max(waves, Math.floor(this.drag() * frameDt) + 1);
  }

  /** The largest rate of drag on a patch in the next frame [1/s]. */
  drag() {
    const { blown } = this;
    const { velocity } = this.tables;
    let [blowing, largest] = [0, 0];
    for (let k = 0; k < SAMPLES; k++) {
      this.wind.blow(this.time + (k * this.head.frameDt) / (SAMPLES - 1), blown);
      blowing = Math.max(blowing, Math.hypot(...blown));
    }
    this.a.rate.forEach((rate, p) => {
      const speed = Math.hypot(velocity[3 * p], velocity[3 * p + 1], velocity[3 * p + 2]);
      largest = Math.max(largest, rate * (blowing + speed));
    });
    return largest;
  }

  /** The fastest wave [m/s]: stress is the stiffness times that in the file, and so is the square of the wave. */
  wave() {
    return Math.sqrt(this.stiffness * (this.seen.wave + this.head.bending)); // see Formulation.with_bending
  }

  /** The time of the viscous stress times its stiffening [s]. */
  viscous() {
    return this.head.viscous * Math.max(this.seen.stretch, 1);
  }

  /** How far the fastest wave came in a substep of `dt` [m] when it was measured, see MPMSolver.cfl_number. */
  far(dt) {
    return Math.sqrt(dt * dt + 2 * this.viscous() * dt) * this.wave();
  }

  // ---- substeps

  /** Takes substeps of `dt` [s]; returns how far the fastest wave came in one of them [m]. */
  roll(dt, steps) {
    let farthest = 0;
    const far = () => {
      this.measure();
      farthest = Math.max(farthest, this.far(dt));
    };
    const every = Math.max(1, Math.ceil(steps / LOOKS));
    const run = this.kernels[this.pull ? "held" : "free"];
    for (let k = 0; k < steps; k++) {
      if (k > 0 && k % every === 0) far();
      if (k % MOST === 0) this.write(dt, Math.min(MOST, steps - k));
      this.first[0] = k % MOST;
      this.clock[0] = this.time;
      run();
      this.time += dt;
    }
    this.first[0] = 0;
    far();
    this.kernels.read();
    return farthest;
  }

  /** Measures what decides about the Courant number. */
  measure() {
    const { fastest } = this.tables;
    fastest.fill(0);
    this.kernels.look();
    this.see(fastest);
  }

  /** Takes a measurement. */
  see(/** @type {ArrayLike<number>} */ fastest) {
    this.seen = { time: this.time, wave: fastest[0] ** 2, stretch: fastest[1] ** 2 };
  }

  /** Writes the tables of the next substeps of `dt` [s]. */
  write(dt, steps) {
    const { tables, head, points, pull } = this;
    const { widths, pull: [row, column] } = head.kernels;
    const width = widths[pull ? 1 : 0];
    for (let k = 0; k < steps; k++) {
      const kick = this.substep > 0 ? Math.min(0.5 * (this.substep + dt), 2 * dt) : dt; // how long forces act
      tables.schedule.set([kick, dt, Math.exp(-head.damping * kick)], TIMES * (k + 1));
      if (!this.idle) {
        this.wind.blow(this.time + k * dt, this.blown);
        tables.winds.set(this.blown, width * k);
      }
      if (pull) tables.winds.set(pull.target, width * k + column);
      this.substep = dt;
    }
    this.length[0] = dt;
    tables.material.set(this.moduli.map((x) => x * this.stiffness), points);
    tables.curving?.set(this.curving.map((x) => x * Math.sqrt(this.stiffness)));
    if (!pull) return;
    const values = tables.values.subarray(points * row);
    this.a.order.forEach((own, p) => {
      for (let m = 0; m < 3; m++) values[m * points + p] = pull.offset[3 * own + m];
      values[3 * points + p] = pull.held[own];
    });
  }

  // ---- what is seen

  /** Places of all points [m]. */
  positions(to) {
    this.kernels.read();
    to.set(this.tables.position);
  }

  /** Displacements of the nodes that Gaussians follow [m], four numbers each. */
  drawn() {
    const { fields } = this.tables;
    const found = new Float32Array(4 * this.a.followed.length);
    this.a.followed.forEach((node, k) => found.set(fields.subarray(ROW * node, ROW * node + 3), 4 * k));
    return found;
  }
}
