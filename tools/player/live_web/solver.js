// Frames of a body by the material point method in its total Lagrangian form, whose substeps a subclass computes; the definition is
// gaussian_swaying/mpm/total.py.
import { Body } from "./body.js";

export const LOOKS = 8; // checks of the Courant number in a frame, as in simulation/stepper.py
const LIMIT = 0.5; // a frame that exceeds it is repeated with shorter substeps
const RETRIES = 4;
const SAMPLES = 5; // winds of a frame that the drag is bounded with
export const WIDE = 4; // numbers of a node, of which the last one means nothing
const MOST_GROWTH = 1000; // a frame that takes this many times the substeps of the first has diverged

export class Solver extends Body {
  /** @param {{head: any, arrays: Record<string, any>}} block */
  constructor(block) {
    super(block);
    const { cellStart, inverseMass } = block.arrays;
    this.cells = cellStart.length - 1;
    this.nodes = inverseMass.length; // the last one stands for all without mass, and does not move
    this.displacement = new Float32Array(WIDE * this.nodes);
    this.velocity = new Float32Array(WIDE * this.nodes);
    this.before = { displacement: this.displacement.slice(), velocity: this.velocity.slice() };
    this.blown = new Float64Array(3);
    this.speed = new Float64Array(this.points);
    this.first = null; // substeps of the first frame
    this.reset();
  }

  /** Back to rest. */
  reset() {
    this.displacement.fill(0);
    this.velocity.fill(0);
    this.time = 0;
    this.substep = 0; // the last one [s]
    this.pull = null;
    this.hurried = false;
    /** The last measurement, by `look`: when, the fastest wave [m/s], and the time of the viscous stress times its stiffening [s]. */
    this.seen = { time: NaN, stiffness: 1, wave: 0, viscous: 0 };
  }

  // ---- frames

  /**
   * Advance by one frame, with as many substeps as it needs.
   * @returns {number} substeps
   */
  advance() {
    const frame = this.frame();
    let told = frame.next();
    while (!told.done) told = frame.next(this.roll(this.head.frameDt / told.value, told.value));
    return told.value;
  }

  /**
   * The trials of a frame: yields its substeps, and gets how far the fastest wave came in one of them [m], which `roll` returns.
   * @returns {Generator<number, number, number>}
   */
  *frame() {
    const { dx } = this.head;
    const cfl = this.courant();
    const { before } = this;
    before.displacement.set(this.displacement);
    before.velocity.set(this.velocity);
    const [time, substep] = [this.time, this.substep];
    let steps = this.substeps();
    this.first ??= steps;
    for (let retry = 0; ; retry++) {
      if (steps > MOST_GROWTH * this.first) throw new Error("the motion has become too fast to be computed");
      const courant = (yield steps) / dx;
      if (courant <= Math.max(LIMIT, 1.25 * cfl) || this.head.substep !== null) return steps;
      if (retry === RETRIES) {
        if (courant <= 2) return steps;
        throw new Error("the motion has become too fast to be computed");
      }
      const growth = Number.isFinite(courant) ? courant / cfl : 4;
      steps = Math.floor(steps * Math.min(growth * 1.1, 4)) + 1;
      this.displacement.set(before.displacement);
      this.velocity.set(before.velocity);
      [this.time, this.substep] = [time, substep];
    }
  }

  /** The wanted Courant number. */
  courant() {
    return this.hurried ? this.head.longest : this.head.cfl;
  }

  /** Substeps of the next frame, from waves in the material and drag on light patches. */
  substeps() {
    const { frameDt, dx, substep } = this.head;
    this.look();
    const { viscous } = this.seen;
    let longest = substep ?? this.courant() / Math.max(this.seen.wave / dx, 1e-30);
    if (viscous > 0 && substep === null) longest = longest ** 2 / (viscous + Math.sqrt(viscous ** 2 + longest ** 2));
    const waves = Math.max(1, Math.ceil(frameDt / longest - 1e-6));
    return this.aero.implicit ? waves : Math.max(waves, Math.floor(this.drag() * frameDt) + 1);
  }

  /** The largest rate of drag on a patch in the next frame [1/s]. */
  drag() {
    const { aero, head, blown } = this;
    if (this.idle) return 0;
    let blowing = 0;
    for (let k = 0; k < SAMPLES; k++) {
      this.wind.blow(this.time + (k * head.frameDt) / (SAMPLES - 1), blown);
      blowing = Math.max(blowing, Math.hypot(...blown));
    }
    const coefficient = (aero.law === 2 ? 0.5 : 1) * aero.drag + aero.friction + Math.abs(aero.lift);
    let rate = 0;
    const { area, mass } = this.a;
    for (let p = 0; p < this.points; p++)
      if (area[p] > 0) rate = Math.max(rate, ((blowing + this.speed[p]) * area[p]) / mass[p]);
    return aero.airDensity * coefficient * rate;
  }

  /** How far the fastest wave came in a substep of `dt` [m] when it was measured, see MPMSolver.cfl_number. */
  far(dt) {
    return Math.sqrt(dt * dt + 2 * this.seen.viscous * dt) * this.seen.wave;
  }

  /** How long forces act in a substep of `dt` [s]: the mean of the old one and the new one. */
  kick(dt) {
    return this.substep > 0 ? Math.min(0.5 * (this.substep + dt), 2 * dt) : dt;
  }

  /** Displacements of the nodes that Gaussians follow [m], four numbers each. */
  drawn() {
    const { followed } = this.a;
    const found = new Float32Array(4 * followed.length);
    for (let k = 0; k < followed.length; k++)
      for (let m = 0; m < 3; m++) found[4 * k + m] = this.displacement[WIDE * followed[k] + m];
    return found;
  }
}
