// A body that sways by its modes; the definition is gaussian_swaying/mpm/formulations/modes.py.
import { onGroup } from "./aero.js";
import { Body, tug } from "./body.js";

const [LONGEST, SHORTEST] = [0.01, 0.0025]; // s
const PER_PERIOD = 20; // substeps
const [ROUNDS, LEFT] = [8, 1e-3]; // most rounds of the equations for the drag, and what they may leave

export class ModalSolver extends Body {
  /** @param {{head: any, arrays: Record<string, any>}} block */
  constructor(block) {
    super(block);
    const { head, arrays } = block;
    this.aero = { ...head.aero, maxAreaRatio: head.aero.maxAreaRatio ?? Infinity };
    const { omega } = arrays;
    const count = omega.length;
    for (const name of head.modes)
      this[name] = Float32Array.from(arrays[name], (x, i) => x * arrays[`${name}Step`][Math.floor(i / count)] * omega[i % count]);
    const field = () => new Float64Array(count);
    [this.q, this.p, this.middle, this.load, this.free, this.change, this.lost] = Array.from({ length: 7 }, field);
    this.resistance = new Float64Array(this.points);
    this.blown = new Float64Array(3);
    this.reset();
  }

  /** Back to rest. */
  reset() {
    this.q.fill(0);
    this.p.fill(0);
    this.wind.carried.fill(0);
    this.time = 0;
    this.pull = null;
    this.hurried = false;
  }

  /**
   * Advance by one frame.
   * @returns {number} substeps
   */
  advance() {
    const { frameDt, period, substep } = this.head;
    const wanted = period / Math.sqrt(this.stiffness) / PER_PERIOD;
    const steps = Math.ceil(frameDt / (substep ?? Math.min(Math.max(wanted, SHORTEST), LONGEST)) - 1e-9);
    const modes = Array.from(this.a.omega, (_, m) => this.oscillation(m, frameDt / steps));
    for (let k = 0; k < steps; k++) this.step(frameDt / steps, modes);
    if (!this.q.every(Number.isFinite)) throw new Error("the motion has become too fast to be computed");
    return steps;
  }

  /** What a substep makes of a mode: its square, decay times the sine over the frequency, and what is left of q and p. */
  oscillation(m, dt) {
    const { omega, ratio } = this.a;
    const { damping, viscous } = this.head;
    const square = this.stiffness * omega[m] ** 2;
    const alpha = ratio[m] * Math.sqrt(square) + (damping + viscous * square) / 2;
    const apart = square - alpha * alpha;
    const rate = Math.sqrt(Math.max(Math.abs(apart), 1e-12));
    const decay = Math.exp(-alpha * dt);
    const sine = (decay * (apart < 0 ? Math.sinh : Math.sin)(rate * dt)) / rate;
    const cosine = decay * (apart < 0 ? Math.cosh : Math.cos)(rate * dt);
    return { square, sine, ofPlace: cosine + alpha * sine, ofRate: cosine - alpha * sine };
  }

  step(dt, modes) {
    const { q, p, middle, load, free, change, lost, wind, idle, head, aero, pull, blown, resistance } = this;
    const { mass, area, tensor, vectors, firstVector } = this.a;
    const half = this.time + 0.5 * dt;
    for (let m = 0; m < q.length; m++) middle[m] = q[m] + 0.5 * dt * p[m];
    wind.carry(half, 0.5 * dt);
    if (!idle) wind.blow(half, blown);
    load.fill(0);
    for (let s = 0; s < this.points; s++) {
      this.at(s, middle, p);
      force.fill(0);
      if (!idle && area[s] > 0) {
        air.set(blown);
        if (wind.turbulence) wind.stir(half, place, air);
        onGroup(aero, air, velocity[0], velocity[1], velocity[2], R, tensor, 6 * s, vectors, firstVector[s], firstVector[s + 1], force);
      }
      if (pull?.held[s] > 0) {
        force[3] += tug(pull, s, place, velocity, pulled);
        for (let i = 0; i < 3; i++) force[i] += pulled[i];
      }
      for (let i = 0; i < 3; i++) force[i] += mass[s] * head.gravity[i];
      resistance[s] = 0.5 * force[3];
      for (let i = 0; i < 3; i++) local[i] = R[i] * force[0] + R[3 + i] * force[1] + R[6 + i] * force[2];
      spread(this.siteShape, s, local, load);
    }
    // the change of the rates, with the drag at the mean velocity of the substep, by minimal residuals
    change.fill(0);
    let whole = 0;
    for (let m = 0; m < q.length; m++) {
      const { square, sine, ofRate } = modes[m];
      free[m] = (ofRate - 1) * p[m] + sine * (load[m] - square * q[m]);
      whole += free[m] ** 2;
    }
    for (let round = 0, left = whole; round < ROUNDS && left > LEFT ** 2 * whole; round++) {
      lost.fill(0);
      for (let s = 0; s < this.points; s++) {
        if (resistance[s] === 0) continue;
        product(this.siteShape, s, free, local);
        for (let i = 0; i < 3; i++) local[i] *= resistance[s];
        spread(this.siteShape, s, local, lost);
      }
      let along = 0, size = 0;
      for (let m = 0; m < q.length; m++) {
        const image = free[m] + modes[m].sine * lost[m];
        along += free[m] * image, size += image * image;
      }
      left = 0;
      for (let m = 0; m < q.length; m++) {
        const part = (along / size) * free[m];
        change[m] += part;
        load[m] -= (along / size) * lost[m];
        free[m] -= part + (along / size) * modes[m].sine * lost[m];
        left += free[m] ** 2;
      }
    }
    for (let m = 0; m < q.length; m++) {
      const { square, sine, ofPlace } = modes[m];
      const rest = load[m] / square;
      q[m] = rest + ofPlace * (q[m] - rest) + sine * p[m];
      p[m] += change[m];
    }
    wind.carry(half, 0.5 * dt);
    this.time += dt;
  }

  /** Makes a site the one that is worked on: its place, rotation and velocity. */
  at(s, q, p) {
    product(this.siteShape, s, q, shift);
    product(this.siteTurn, s, q, turn);
    product(this.siteShape, s, p, local);
    const [sine, cosine] = rodrigues();
    const [x, y, z] = turn;
    const rest = 1 - cosine * (x * x + y * y + z * z);
    R[0] = rest + cosine * x * x, R[1] = cosine * x * y - sine * z, R[2] = cosine * x * z + sine * y;
    R[3] = cosine * x * y + sine * z, R[4] = rest + cosine * y * y, R[5] = cosine * y * z - sine * x;
    R[6] = cosine * x * z - sine * y, R[7] = cosine * y * z + sine * x, R[8] = rest + cosine * z * z;
    cross(turn, shift, first);
    for (let i = 0; i < 3; i++) {
      velocity[i] = R[3 * i] * local[0] + R[3 * i + 1] * local[1] + R[3 * i + 2] * local[2];
      place[i] = this.a.rest[3 * s + i] + shift[i] + 0.5 * first[i];
    }
  }

  /** As in Body, but of the mass that resists there: a few modes bend less around a place than the material does. */
  grab(eye, ray, wide) {
    const found = super.grab(eye, ray, wide);
    if (found === null) return null;
    const { held } = this.pull;
    const rows = 3 * this.q.length; // of the shapes of a site
    let mobility = 0;
    this.siteShape.forEach((x, i) => (mobility += (held[Math.floor(i / rows)] * x * x) / 3));
    for (let s = 0; s < this.points; s++) held[s] /= mobility;
    return found;
  }

  /** Places of all sites [m]. */
  positions(to) {
    for (let s = 0; s < this.points; s++) {
      this.at(s, this.q, this.p);
      to.set(place, 3 * s);
    }
  }

  /** Displacements of the nodes that Gaussians follow [m], four numbers each. */
  drawn() {
    const count = this.nodeShape.length / this.q.length / 3;
    const found = new Float32Array(4 * count);
    for (let k = 0; k < count; k++) {
      product(this.nodeShape, k, this.q, shift);
      product(this.nodeTurn, k, this.q, turn);
      const [, cosine, cubic] = rodrigues();
      cross(turn, shift, first);
      cross(turn, first, second);
      for (let i = 0; i < 3; i++) found[4 * k + i] = shift[i] + cosine * first[i] + cubic * second[i];
    }
    return found;
  }
}

// ---- the site or node that is worked on

const vector = () => new Float64Array(3);
const [shift, turn, local, velocity, place, air, pulled, first, second] = Array.from({ length: 9 }, vector);
const [R, force] = [new Float64Array(9), new Float64Array(4)]; // its rotation, and its force [N] with its resistance [kg/s]

/** A vector of a site or node by amplitudes, into `to`. */
function product(/** @type {Float32Array} */ shape, /** @type {number} */ row, /** @type {Float64Array} */ amplitudes, /** @type {Float64Array} */ to) {
  const count = amplitudes.length;
  let [x, y, z] = [0, 0, 0];
  for (let m = 0, a = 3 * row * count, b = a + count, c = b + count; m < count; m++, a++, b++, c++) {
    const own = amplitudes[m];
    x += shape[a] * own, y += shape[b] * own, z += shape[c] * own;
  }
  to[0] = x, to[1] = y, to[2] = z;
}

/** Adds the load of a force on a site to that on the modes. */
function spread(/** @type {Float32Array} */ shape, /** @type {number} */ row, /** @type {Float64Array} */ force, /** @type {Float64Array} */ load) {
  const count = load.length;
  const x = force[0], y = force[1], z = force[2];
  for (let m = 0, a = 3 * row * count, b = a + count, c = b + count; m < count; m++, a++, b++, c++)
    load[m] += shape[a] * x + shape[b] * y + shape[c] * z;
}

/** Factors of `turn`: the sine of its angle a over a, (1 - cos a) / a² and (1 - sin(a) / a) / a². */
function rodrigues() {
  const square = turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2;
  if (square < 1e-4) return [1 - square / 6, 0.5 - square / 24, 1 / 6 - square / 120];
  const angle = Math.sqrt(square);
  const sine = Math.sin(angle) / angle;
  return [sine, (1 - Math.cos(angle)) / square, (1 - sine) / square];
}

function cross(a, b, to) {
  to[0] = a[1] * b[2] - a[2] * b[1], to[1] = a[2] * b[0] - a[0] * b[2], to[2] = a[0] * b[1] - a[1] * b[0];
}
