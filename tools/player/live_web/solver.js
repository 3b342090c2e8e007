// The material point method in its total Lagrangian form; the definition is gaussian_swaying/mpm/formulations/total.py.
import { onGroup, onPatch } from "./aero.js";
import { Body, tug } from "./body.js";
import { Contact } from "./contact.js";
import { largestSquare, stress, waveModulus } from "./laws.js";

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
    const { head, arrays } = block;
    this.cells = arrays.cellStart.length - 1;
    this.nodes = arrays.inverseMass.length; // the last one stands for all without mass, and does not move
    this.displacement = new Float64Array(WIDE * this.nodes);
    this.velocity = new Float64Array(WIDE * this.nodes);
    this.force = new Float64Array(WIDE * this.nodes);
    this.resistance = new Float64Array(this.nodes);
    this.shift = new Float64Array(head.planes.length ? WIDE * this.nodes : 0);
    this.before = { displacement: this.displacement.slice(), velocity: this.velocity.slice() };
    this.cell = new Int32Array(this.points); // of each point
    for (let c = 0; c < this.cells; c++) this.cell.fill(c, arrays.cellStart[c], arrays.cellStart[c + 1]);
    this.blown = new Float64Array(3);
    this.now = new Float64Array(3);
    this.still = Int32Array.from(arrays.held.keys()).filter((k) => arrays.held[k]); // nodes that are held
    this.contact = head.obstacles.length ? new Contact(block, WIDE) : null;
    this.moved = new Float64Array(WIDE * (this.contact?.count ?? 0));
    this.rates = new Float64Array(3 * head.rows);
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
    /** The last measurement: when, the fastest wave [m/s], and the time of the viscous stress times its stiffening [s]. */
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
   * The trials of a frame: yields its substeps, and gets what `roll` returned for them.
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

  /** Substeps of one length; returns how far the fastest wave came in one of them [m], see MPMSolver.cfl_number. */
  roll(dt, steps) {
    let farthest = 0;
    const far = () => Math.sqrt(dt * dt + 2 * this.seen.viscous * dt) * this.seen.wave;
    const every = Math.max(1, Math.ceil(steps / LOOKS));
    for (let k = 0; k < steps; k++) {
      const looked = k > 0 && k % every === 0;
      this.step(dt, looked);
      if (looked) farthest = Math.max(farthest, far());
      if (!Number.isFinite(farthest)) return NaN;
    }
    this.look();
    return Math.max(farthest, far());
  }

  /** Measures the fastest wave [m/s] and, for the drag, the points; see `particles`. */
  look() {
    if (this.seen.time !== this.time || this.seen.stiffness !== this.stiffness) this.particles(true, false);
  }

  /** The largest rate of drag on a patch in the next frame [1/s]. */
  drag() {
    const { aero, head, now } = this;
    if (this.idle) return 0;
    let blowing = 0;
    for (let k = 0; k < SAMPLES; k++) {
      this.wind.blow(this.time + (k * head.frameDt) / (SAMPLES - 1), now);
      blowing = Math.max(blowing, Math.hypot(now[0], now[1], now[2]));
    }
    const coefficient = (aero.law === 2 ? 0.5 : 1) * aero.drag + aero.friction + Math.abs(aero.lift);
    let rate = 0;
    const { area, mass } = this.a;
    for (let p = 0; p < this.points; p++)
      if (area[p] > 0) rate = Math.max(rate, ((blowing + this.speed[p]) * area[p]) / mass[p]);
    return aero.airDensity * coefficient * rate;
  }

  // ---- a substep

  /** How long forces act in a substep of `dt` [s]: the mean of the old one and the new one. */
  kick(dt) {
    return this.substep > 0 ? Math.min(0.5 * (this.substep + dt), 2 * dt) : dt;
  }

  /** One substep of symplectic Euler of `dt` [s]; `looked` says that the state before it is measured. */
  step(dt, looked) {
    const { head } = this;
    const kick = this.kick(dt);
    if (!this.idle) this.wind.blow(this.time, this.blown);
    this.dragged = this.pull !== null || (!this.idle && this.aero.implicit);
    this.force.fill(0);
    if (this.dragged) this.resistance.fill(0);
    this.particles(looked, true);
    if (this.pull !== null) this.pulls(this.pull);
    if (head.planes.length) this.shifts();
    this.accelerate(kick);
    if (this.contact) {
      this.samples();
      this.contact.apply(this.velocity, this.moved, this.time, dt);
    }
    for (const plane of head.planes) this.stop(plane);
    for (const k of this.still) this.velocity.fill(0, WIDE * k, WIDE * k + 3);
    this.hold();
    this.move(dt);
    this.time += dt;
    this.substep = dt;
  }

  /**
   * The pass over all points: with `looked` measures the fastest wave and the speeds, with `pushed` sums forces at the nodes.
   * @param {boolean} looked @param {boolean} pushed
   */
  particles(looked, pushed) {
    const { a, aero, idle, stiffness, head } = this;
    const { force: A } = this;
    const { fraction, volume, mass, law, mu, lam, area, cellStart, cellNodes } = a;
    const viscous = head.viscous;
    let fastest = 0;
    let stretched = 1;
    const grouped = head.grouped;
    const inverse = 1 / head.dx;
    for (let c = 0; c < this.cells; c++) {
      const first = 27 * c;
      this.gather(first);
      a27.fill(0);
      for (let p = cellStart[c]; p < cellStart[c + 1]; p++) {
        weights(fraction, 3 * p, w, g, inverse);
        const z0 = w[6], z1 = w[7], z2 = w[8], y0 = g[6], y1 = g[7], y2 = g[8];
        let F0 = 1, F1 = 0, F2 = 0, F3 = 0, F4 = 1, F5 = 0, F6 = 0, F7 = 0, F8 = 1;
        for (let i = 0, at = 0; i < 3; i++)
          for (let j = 3; j < 6; j++, at += 9) {
            const q0 = u27[at], q1 = u27[at + 1], q2 = u27[at + 2], q3 = u27[at + 3], q4 = u27[at + 4];
            const q5 = u27[at + 5], q6 = u27[at + 6], q7 = u27[at + 7], q8 = u27[at + 8];
            const s0 = z0 * q0 + z1 * q3 + z2 * q6, s1 = z0 * q1 + z1 * q4 + z2 * q7, s2 = z0 * q2 + z1 * q5 + z2 * q8;
            const x = g[i] * w[j], y = w[i] * g[j], z = w[i] * w[j];
            F0 += x * s0, F3 += x * s1, F6 += x * s2;
            F1 += y * s0, F4 += y * s1, F7 += y * s2;
            F2 += z * (y0 * q0 + y1 * q3 + y2 * q6);
            F5 += z * (y0 * q1 + y1 * q4 + y2 * q7);
            F8 += z * (y0 * q2 + y1 * q5 + y2 * q8);
          }
        F[0] = F0, F[1] = F1, F[2] = F2, F[3] = F3, F[4] = F4, F[5] = F5, F[6] = F6, F[7] = F7, F[8] = F8;
        if (looked) {
          interpolate(v27, velocity);
          this.speed[p] = Math.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1] + velocity[2] * velocity[2]);
          const square = (stiffness * waveModulus(law[p], F, mu[p], lam[p]) * volume[p]) / mass[p];
          if (!(square <= fastest)) fastest = square; // NaN, too
          if (viscous > 0) stretched = Math.max(stretched, largestSquare(F));
          if (!pushed) continue;
        }
        stress(law[p], F, mu[p], lam[p], P);
        const size = -volume[p] * stiffness;
        let p0 = size * P[0], p1 = size * P[1], p2 = size * P[2], p3 = size * P[3], p4 = size * P[4];
        let p5 = size * P[5], p6 = size * P[6], p7 = size * P[7], p8 = size * P[8];
        if (viscous > 0) {
          this.viscousStress(mu[p] * stiffness, lam[p] * stiffness);
          const own = -volume[p];
          p0 += own * P[0], p1 += own * P[1], p2 += own * P[2], p3 += own * P[3], p4 += own * P[4];
          p5 += own * P[5], p6 += own * P[6], p7 += own * P[7], p8 += own * P[8];
        }
        let b0 = 0, b1 = 0, b2 = 0, drag = 0;
        if (!idle && area[p] > 0) {
          interpolate(v27, velocity);
          if (grouped) onGroup(aero, this.blown, velocity[0], velocity[1], velocity[2], F, a.tensor, 6 * p, a.vectors, a.firstVector[p], a.firstVector[p + 1], out);
          else onPatch(aero, this.blown, velocity[0], velocity[1], velocity[2], F, a.patch, 4 * p, out);
          b0 = out[0], b1 = out[1], b2 = out[2], drag = out[3];
        }
        for (let i = 0, at = 0; i < 3; i++)
          for (let j = 3; j < 6; j++, at += 9) {
            const x = g[i] * w[j], y = w[i] * g[j], z = w[i] * w[j];
            const e0 = b0 * z + p0 * x + p1 * y, e1 = b1 * z + p3 * x + p4 * y, e2 = b2 * z + p6 * x + p7 * y;
            const h0 = p2 * z, h1 = p5 * z, h2 = p8 * z;
            a27[at] += z0 * e0 + y0 * h0, a27[at + 1] += z0 * e1 + y0 * h1, a27[at + 2] += z0 * e2 + y0 * h2;
            a27[at + 3] += z1 * e0 + y1 * h0, a27[at + 4] += z1 * e1 + y1 * h1, a27[at + 5] += z1 * e2 + y1 * h2;
            a27[at + 6] += z2 * e0 + y2 * h0, a27[at + 7] += z2 * e1 + y2 * h1, a27[at + 8] += z2 * e2 + y2 * h2;
          }
        if (drag > 0) this.spreadResistance(first, drag);
      }
      for (let k = 0; pushed && k < 27; k++) {
        const at = WIDE * cellNodes[first + k];
        const from = 3 * k;
        A[at] += a27[from], A[at + 1] += a27[from + 1], A[at + 2] += a27[from + 2];
      }
    }
    if (looked) this.seen = { time: this.time, stiffness, wave: Math.sqrt(fastest), viscous: viscous * stretched };
  }

  /** Kelvin and Voigt's stress of the point that `particles` works on, into P. */
  viscousStress(mu, lam) {
    rateOf(v27, L);
    const time = this.head.viscous;
    let trace = 0;
    for (let i = 0; i < 3; i++)
      for (let k = 0; k < 3; k++) E[3 * i + k] = F[i] * L[k] + F[3 + i] * L[3 + k] + F[6 + i] * L[6 + k];
    for (let i = 0; i < 3; i++) trace += E[4 * i];
    for (let i = 0; i < 3; i++)
      for (let k = 0; k < 3; k++) {
        let sum = lam * trace * F[3 * i + k];
        for (let j = 0; j < 3; j++) sum += mu * F[3 * i + j] * (E[3 * j + k] + E[3 * k + j]);
        P[3 * i + k] = time * sum;
      }
  }

  /** A spring and a damper to where the visitor pulls, on the points that are held. */
  pulls(/** @type {Pull} */ pull) {
    const { rest } = this.a;
    for (let p = 0; p < this.points; p++) {
      if (pull.held[p] === 0) continue;
      this.at(p, 27 * this.cell[p]);
      interpolate(v27, velocity);
      const damping = tug(pull, p, place.map((x, m) => rest[3 * p + m] + x), velocity, out);
      this.push(p, out, damping);
    }
  }

  /** Adds a force [N] and its damping [kg/s] on the point that is worked on. */
  push(p, force, damping) {
    const first = 27 * this.cell[p];
    for (let k = 0; k < 27; k++) for (let m = 0; m < 3; m++) this.force[WIDE * this.a.cellNodes[first + k] + m] += weightOf(k) * force[m];
    this.spreadResistance(first, damping);
  }

  spreadResistance(first, drag) {
    for (let k = 0; k < 27; k++) this.resistance[this.a.cellNodes[first + k]] += drag * weightOf(k);
  }

  /** Mass times displacement of the points, for the centres of the masses that nodes carry. */
  shifts() {
    const { shift: S } = this;
    const { mass, cellNodes } = this.a;
    S.fill(0);
    for (let p = 0; p < this.points; p++) {
      const first = 27 * this.cell[p];
      this.at(p, first);
      for (let k = 0; k < 27; k++) {
        const at = WIDE * cellNodes[first + k];
        const own = mass[p] * weightOf(k);
        S[at] += own * place[0], S[at + 1] += own * place[1], S[at + 2] += own * place[2];
      }
    }
  }

  /** The fields of the nodes of a cell, into `u27` and `v27`. */
  gather(first) {
    const { displacement: U, velocity: V } = this;
    const { cellNodes } = this.a;
    for (let k = 0; k < 27; k++) {
      const at = WIDE * cellNodes[first + k];
      const to = 3 * k;
      u27[to] = U[at], u27[to + 1] = U[at + 1], u27[to + 2] = U[at + 2];
      v27[to] = V[at], v27[to + 1] = V[at + 1], v27[to + 2] = V[at + 2];
    }
  }

  /** Makes a point the one that is worked on: fields of its nodes, weights, and its displacement. */
  at(p, first) {
    this.gather(first);
    weights(this.a.fraction, 3 * p, w, g, 1 / this.head.dx);
    interpolate(u27, place);
  }

  /** Velocities of the nodes after `kick` seconds of force, gravity and damping. */
  accelerate(kick) {
    const { force: A, velocity: V, resistance: D, head, dragged } = this;
    const { inverseMass, nodeDamping } = this.a;
    const damped = nodeDamping.length > 0;
    const [g0, g1, g2] = head.gravity;
    const all = Math.exp(-head.damping * kick);
    for (let k = 0; k < this.nodes - 1; k++) {
      const at = WIDE * k;
      const inverse = inverseMass[k];
      const decay = damped ? all * Math.exp(-kick * nodeDamping[k]) : all;
      const push = dragged ? kick / (1 + kick * D[k] * inverse) : kick;
      V[at] = decay * (V[at] + push * (A[at] * inverse + g0));
      V[at + 1] = decay * (V[at + 1] + push * (A[at + 1] * inverse + g1));
      V[at + 2] = decay * (V[at + 2] + push * (A[at + 2] * inverse + g2));
    }
  }

  /** Displacement of the samples of contact, into `moved`. */
  samples() {
    const { displacement: U, moved } = this;
    const { sampleNode, sampleWeight } = this.a;
    moved.fill(0);
    for (let k = 0; k < sampleNode.length; k++) {
      const [at, from] = [WIDE * Math.floor(k / 27), WIDE * sampleNode[k]];
      for (let m = 0; m < 3; m++) moved[at + m] += sampleWeight[k] * U[from + m];
    }
  }

  /** Whether a boundary acts now. */
  acts({ start, end }) {
    const now = this.time + 1e-9;
    return now >= start && (end === null || now < end);
  }

  /** Stops the nodes at or behind a plane, as plane_velocity in mpm/colliders.py. */
  stop(plane) {
    if (!this.acts(plane)) return;
    const { point, normal: [n0, n1, n2], kind, friction } = plane;
    const { velocity: V, shift: S } = this;
    const { inverseMass, nodeRest } = this.a;
    for (let k = 0; k < this.nodes - 1; k++) {
      const [at, from] = [WIDE * k, 3 * k];
      const inverse = inverseMass[k];
      const depth =
        (nodeRest[from] + S[at] * inverse - point[0]) * n0 +
        (nodeRest[from + 1] + S[at + 1] * inverse - point[1]) * n1 +
        (nodeRest[from + 2] + S[at + 2] * inverse - point[2]) * n2;
      if (depth > 0) continue;
      if (kind === "sticky") {
        V[at] = V[at + 1] = V[at + 2] = 0;
        continue;
      }
      const along = V[at] * n0 + V[at + 1] * n1 + V[at + 2] * n2;
      const removed = kind === "separate" ? Math.min(along, 0) : along;
      let [t0, t1, t2] = [V[at] - along * n0, V[at + 1] - along * n1, V[at + 2] - along * n2];
      if (friction > 0) {
        const left = Math.max(0, 1 - (friction * Math.abs(removed)) / Math.max(Math.hypot(t0, t1, t2), 1e-30));
        [t0, t1, t2] = [left * t0, left * t1, left * t2];
      }
      V[at] = t0 + (along - removed) * n0;
      V[at + 1] = t1 + (along - removed) * n1;
      V[at + 2] = t2 + (along - removed) * n2;
    }
  }

  /** Stops the held points exactly, see gaussian_swaying/mpm/pins.py. */
  hold() {
    const { velocity: V, rates } = this;
    const { rowNode, rowWeight, affected, push } = this.a;
    const { rows } = this.head;
    for (let r = 0; r < rows; r++) {
      let [x, y, z] = [0, 0, 0];
      for (let k = 27 * r; k < 27 * r + 27; k++) {
        const at = WIDE * rowNode[k];
        x += rowWeight[k] * V[at];
        y += rowWeight[k] * V[at + 1];
        z += rowWeight[k] * V[at + 2];
      }
      rates[3 * r] = x;
      rates[3 * r + 1] = y;
      rates[3 * r + 2] = z;
    }
    for (let k = 0; k < affected.length; k++) {
      let [x, y, z] = [0, 0, 0];
      for (let r = 0, from = rows * k; r < rows; r++, from++) {
        x += push[from] * rates[3 * r];
        y += push[from] * rates[3 * r + 1];
        z += push[from] * rates[3 * r + 2];
      }
      const at = WIDE * affected[k];
      V[at] -= x;
      V[at + 1] -= y;
      V[at + 2] -= z;
    }
  }

  move(dt) {
    const { displacement: U, velocity: V } = this;
    for (let k = 0; k < U.length; k++) U[k] += dt * V[k];
  }

  /** Places of all points [m]. */
  positions(to) {
    for (let p = 0; p < this.points; p++) {
      this.at(p, 27 * this.cell[p]);
      for (let m = 0; m < 3; m++) to[3 * p + m] = this.a.rest[3 * p + m] + place[m];
    }
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

// ---- the point that is worked on

const [u27, v27, a27] = [new Float64Array(81), new Float64Array(81), new Float64Array(81)];
const [w, g] = [new Float64Array(9), new Float64Array(9)]; // weights and slopes along x, y and z
const [F, P, L, E] = [new Float64Array(9), new Float64Array(9), new Float64Array(9), new Float64Array(9)];
const [velocity, place, out] = [new Float64Array(3), new Float64Array(3), new Float64Array(4)];

/** Weights of quadratic B-splines and their slopes [1/m], along the three axes. */
function weights(fraction, at, w, g, inverse) {
  for (let axis = 0; axis < 3; axis++) {
    const f = fraction[at + axis];
    const k = 3 * axis;
    w[k] = 0.5 * (1.5 - f) * (1.5 - f);
    w[k + 1] = 0.75 - (f - 1) * (f - 1);
    w[k + 2] = 0.5 * (f - 0.5) * (f - 0.5);
    g[k] = (f - 1.5) * inverse;
    g[k + 1] = (2 - 2 * f) * inverse;
    g[k + 2] = (f - 0.5) * inverse;
  }
}

/** Weight of a node of the point that is worked on. */
const weightOf = (/** @type {number} */ k) => w[Math.floor(k / 9)] * w[3 + (Math.floor(k / 3) % 3)] * w[6 + (k % 3)];

/** Interpolates a field of the 27 nodes. */
function interpolate(field, to) {
  let t0 = 0, t1 = 0, t2 = 0;
  const z0 = w[6], z1 = w[7], z2 = w[8];
  for (let i = 0, at = 0; i < 3; i++)
    for (let j = 3; j < 6; j++, at += 9) {
      const z = w[i] * w[j];
      t0 += z * (z0 * field[at] + z1 * field[at + 3] + z2 * field[at + 6]);
      t1 += z * (z0 * field[at + 1] + z1 * field[at + 4] + z2 * field[at + 7]);
      t2 += z * (z0 * field[at + 2] + z1 * field[at + 5] + z2 * field[at + 8]);
    }
  to[0] = t0, to[1] = t1, to[2] = t2;
}

/** Gradient of a field of the 27 nodes, [component, axis]. */
function rateOf(field, to) {
  to.fill(0);
  for (let k = 0; k < 27; k++) {
    const i = Math.floor(k / 9), j = 3 + (Math.floor(k / 3) % 3), l = 6 + (k % 3);
    const x = g[i] * w[j] * w[l], y = w[i] * g[j] * w[l], z = w[i] * w[j] * g[l];
    for (let m = 0; m < 3; m++) {
      to[3 * m] += x * field[3 * k + m];
      to[3 * m + 1] += y * field[3 * k + m];
      to[3 * m + 2] += z * field[3 * k + m];
    }
  }
}
