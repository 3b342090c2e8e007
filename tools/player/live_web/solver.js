// A body by the material point method in its total Lagrangian form; its frames are those of gaussian_swaying/simulation/step.py.
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
    this.moduli = this.tables.material.slice(this.points, 3 * this.points);
    this.curving = this.tables.curving?.slice(); // the square of which is a stiffness
    this.before = this.tables.fields.slice();
    this.steps = null; // of the first frame
    this.reset();
  }

  /** Back to rest. */
  reset() {
    super.reset();
    this.tables.fields.fill(0);
    this.tables.velocity.fill(0);
    this.substep = 0; // the last one [s]
    this.tables.status?.fill(0);
    const { least, interval } = this.head.contact ?? {};
    this.trust(least, interval);
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
    const [time, substep, come] = [this.time, this.substep, this.wind.come];
    this.wind.come = [...come];
    if (this.seen.time !== time) this.measure();
    let steps = this.substeps(cfl);
    this.steps ??= steps;
    for (let retry = 0; ; ) {
      if (steps > MOST_GROWTH * this.steps) throw new Error("the motion has become too fast to be computed");
      const courant = (yield [frameDt / steps, steps]) / dx;
      const fits = this.fits(steps);
      if (fits && (courant <= Math.max(LIMIT, 1.25 * cfl) || this.head.substep !== null)) return steps;
      if (fits) {
        if (retry++ === RETRIES) {
          if (courant <= 2) return steps;
          throw new Error("the motion has become too fast to be computed");
        }
        const growth = Number.isFinite(courant) ? courant / cfl : 4;
        steps = Math.floor(steps * Math.min(growth * 1.1, 4)) + 1;
      }
      fields.set(this.before);
      [this.time, this.substep, this.wind.come] = [time, substep, [...come]];
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
    const { velocity } = this.tables;
    const times = Array.from({ length: SAMPLES }, (_, k) => this.time + (k * this.head.frameDt) / (SAMPLES - 1));
    const air = this.wind.blow(times);
    const blowing = Math.max(...times.map((_, k) => Math.hypot(...air.subarray(3 * k, 3 * k + 3))));
    let largest = 0;
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
      if (k % this.interval === 0) this.list();
      this.tables.first[0] = k % MOST;
      this.tables.clock[0] = this.time;
      run();
      this.time += dt;
    }
    this.tables.first[0] = 0;
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
    const { tables, head, points } = this;
    for (let k = 0; k < steps; k++) {
      const kick = this.substep > 0 ? Math.min(0.5 * (this.substep + dt), 2 * dt) : dt; // how long forces act
      tables.schedule.set([kick, dt, Math.exp(-head.damping * kick)], TIMES * (k + 1));
      this.substep = dt;
    }
    tables.step[0] = dt;
    tables.clock[0] = this.time;
    this.kernels.turn?.(); // obstacles
    for (let k = 0; `pose${k}` in tables; k++) tables[`row${k}`].set(tables[`pose${k}`]);
    tables.material.set(this.moduli.map((x) => x * this.stiffness), points);
    tables.curving?.set(this.curving.map((x) => x * Math.sqrt(this.stiffness)));
    this.blow(Array.from({ length: steps }, (_, k) => this.time + k * dt));
  }

  // ---- contact of the material with itself; see ContactRun in gaussian_swaying/mpm/contact.py

  /** Makes lists for places that come closer by a margin [m], after each `interval` of substeps; never where nothing touches. */
  trust(margin, interval = Infinity) {
    this.margin = margin;
    this.interval = interval;
    this.tables.limit?.set([this.head.contact.gap + margin]);
  }

  /** Lists what may touch. */
  list() {
    const { kernels, tables } = this;
    const { samples, low, hashes, cells, start, order, ordered, status } = tables;
    if (!samples) return;
    kernels.place();
    low.fill(Infinity);
    samples.forEach((x, i) => (low[i % 3] = Math.min(low[i % 3], x)));
    status[0] = 0;
    kernels.cell();
    start.fill(0);
    for (const hash of hashes) start[hash + 1]++;
    for (let k = 1; k < start.length; k++) start[k] += start[k - 1];
    const next = start.slice();
    hashes.forEach((hash, p) => (order[next[hash]++] = p));
    const many = order.length;
    for (let plane = 0; plane < ordered.length; plane += many) order.forEach((p, k) => (ordered[plane + k] = cells[plane + p]));
    kernels.list();
  }

  /** Whether the lists of the last substeps were complete; if not, the next ones will be. */
  fits(steps) {
    const { motion, status } = this.tables;
    if (!motion) return true;
    const { least, sure, longest, room, slots } = this.head.contact;
    if (status[1] > room || status[2] > slots) throw new Error("too much of the material touches itself");
    const { margin } = this;
    const moved = motion[0];
    motion[0] = 0;
    if (!(moved < 1e9)) return true;
    const step = sure * Math.max(moved / Math.min(steps, this.interval), 1e-9);
    this.trust(Math.max(least, step), Math.min(longest, Math.floor(Math.max(least, step) / step)));
    return moved <= margin;
  }

  // ---- what is seen

  /** Displacements of the nodes that Gaussians follow [m], four numbers each. */
  drawn() {
    const { fields } = this.tables;
    const found = new Float32Array(4 * this.a.followed.length);
    this.a.followed.forEach((node, k) => found.set(fields.subarray(ROW * node, ROW * node + 3), 4 * k));
    return found;
  }
}
