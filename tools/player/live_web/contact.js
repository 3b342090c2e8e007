// Contact with obstacles that stand still; the definition is gaussian_swaying/mpm/contact.py, with no pairs.

const PUSH = 0.01; // share of an overlap that a substep removes
const PUSH_CELLS = 0.004; // most of it [cells]
const CREEP = 0.01; // of friction that sticks
const SLACK = 0.02; // gap up to which a constraint counts as acting [cells]
const TOLERANCE = 5e-5; // [cells]
const TINY = 1e-30;

/**
 * @typedef {{kind: "half_space" | "capsule" | "box", center: number[], numbers: number[], friction: number, gap: number,
 *   start: number, end: number | null}} Obstacle `numbers`: a normal; a radius and half of the axis; half sides and the axes as rows
 */

/**
 * Distance from the surface of an obstacle; the definitions are in geometry/distance.py.
 * @param {Obstacle} obstacle @param {number} x place relative to its centre [m] @param {number} y @param {number} z
 * @param {Float64Array} out the unit normal @returns {number} [m], negative inside
 */
export function distance({ kind, numbers: n }, x, y, z, out) {
  if (kind === "half_space") {
    out.set(n);
    return x * n[0] + y * n[1] + z * n[2];
  }
  if (kind === "capsule") {
    const square = Math.max(n[1] * n[1] + n[2] * n[2] + n[3] * n[3], TINY);
    const along = Math.min(Math.max((x * n[1] + y * n[2] + z * n[3]) / square, -1), 1);
    return outwards(x - along * n[1], y - along * n[2], z - along * n[3], out) - n[0];
  }
  const place = [0, 1, 2].map((k) => x * n[3 + k] + y * n[6 + k] + z * n[9 + k]); // along its sides
  const beyond = place.map((at, k) => Math.abs(at) - n[k]);
  const deepest = Math.max(...beyond);
  let found = deepest;
  if (deepest <= 0) out.fill(0)[beyond.indexOf(deepest)] = 1;
  else found = outwards(...beyond.map((b) => Math.max(b, 0)), out);
  const [a, b, c] = place.map((at, k) => (at < 0 ? -out[k] : out[k]));
  for (let m = 0; m < 3; m++) out[m] = a * n[3 + 3 * m] + b * n[4 + 3 * m] + c * n[5 + 3 * m];
  return found;
}

/** Length and direction of a vector; z for zero. */
function outwards(x, y, z, out) {
  const length = Math.sqrt(x * x + y * y + z * z);
  if (length > 1e-19) out[0] = x / length, out[1] = y / length, out[2] = z / length;
  else out[0] = out[1] = 0, out[2] = 1;
  return length;
}

export class Contact {
  /** @param {{head: any, arrays: Record<string, any>}} block @param {number} wide numbers of a node in the fields */
  constructor({ head, arrays }, wide) {
    this.wide = wide;
    this.obstacles = /** @type {Obstacle[]} */ (head.obstacles);
    this.dx = head.dx;
    this.iterations = head.iterations;
    this.node = arrays.sampleNode;
    this.weight = arrays.sampleWeight;
    this.place = arrays.samplePlace;
    this.half = arrays.sampleHalf; // of the thickness
    this.inverse = arrays.inverseMass;
    this.count = this.half.length;
    this.load = new Float64Array(this.inverse.length);
  }

  /** A field of the nodes at a sample, into `moving`. */
  read(field, sample) {
    const { node, weight, wide } = this;
    let x = 0, y = 0, z = 0;
    for (let k = 27 * sample; k < 27 * sample + 27; k++) {
      const at = wide * node[k];
      x += weight[k] * field[at], y += weight[k] * field[at + 1], z += weight[k] * field[at + 2];
    }
    moving[0] = x, moving[1] = y, moving[2] = z;
  }

  /**
   * Changes the velocity of the nodes so that no sample enters an obstacle.
   * @param {ArrayLike<number>} moved displacement of the samples [m], `wide` numbers each
   */
  apply(velocity, moved, time, dt) {
    const { obstacles, place, half, dx, wide } = this;
    const held = []; // constraints that act: {sample, normal, gap, friction}
    for (const obstacle of obstacles) {
      const { center, gap: kept, friction, start, end } = obstacle;
      if (time + 1e-9 < start || (end !== null && time + 1e-9 >= end)) continue;
      for (let s = 0; s < this.count; s++) {
        const [at, from] = [3 * s, wide * s];
        const [x, y, z] = [place[at] + moved[from], place[at + 1] + moved[from + 1], place[at + 2] + moved[from + 2]];
        const gap = distance(obstacle, x - center[0], y - center[1], z - center[2], normal) - kept - half[s];
        if (gap > dx) continue; // nothing crosses a cell in a substep
        this.read(velocity, s);
        const ahead = gap + dt * (moving[0] * normal[0] + moving[1] * normal[1] + moving[2] * normal[2]);
        if (Math.min(ahead, gap) < SLACK * dx) held.push({ sample: s, normal: normal.slice(), gap, friction });
      }
    }
    if (held.length) this.resolve(velocity, held, dt);
  }

  resolve(velocity, held, dt) {
    const { dx, iterations } = this;
    const steps = this.steps(held);
    const target = held.map(({ gap }) => (gap > 0 ? -gap : Math.min(-gap * PUSH, PUSH_CELLS * dx)) / dt);
    const applied = new Float64Array(3 * held.length);
    const last = new Float64Array(3 * held.length);
    const next = new Float64Array(3 * held.length);
    let theta = 1;
    let back = false; // whether the momentum led the wrong way: it then starts again
    for (let k = 0; k < iterations; k++) {
      let lacks = 0;
      held.forEach(({ sample, normal: [n0, n1, n2], friction }, i) => {
        this.read(velocity, sample);
        const at = 3 * i;
        const along = moving[0] * n0 + moving[1] * n1 + moving[2] * n2;
        const lacking = target[i] - along;
        lacks = Math.max(lacks, lacking);
        const ahead = applied[at] * n0 + applied[at + 1] * n1 + applied[at + 2] * n2;
        const press = Math.max(ahead + steps[i] * lacking, 0);
        const rub = (m, n) => (1 - CREEP) * (applied[at + m] - ahead * n) - steps[i] * (moving[m] - along * n);
        const [r0, r1, r2] = [rub(0, n0), rub(1, n1), rub(2, n2)];
        const share = Math.min((friction * press) / Math.max(Math.hypot(r0, r1, r2), TINY), 1);
        next[at] = press * n0 + share * r0, next[at + 1] = press * n1 + share * r1, next[at + 2] = press * n2 + share * r2;
      });
      if (k > 0 && lacks * dt < TOLERANCE * dx) break;
      const following = 0.5 * (1 + Math.sqrt(1 + 4 * theta * theta));
      const momentum = back || k === iterations - 1 ? 0 : (theta - 1) / following;
      theta = back ? 1 : following;
      let against = 0;
      for (let i = 0; i < next.length; i++) {
        const wanted = next[i] + momentum * (next[i] - last[i]);
        change[i % 3] = wanted - applied[i];
        against += (applied[i] - next[i]) * (next[i] - last[i]);
        applied[i] = wanted;
        if (i % 3 === 2) this.push(velocity, held[(i - 2) / 3].sample, change);
      }
      back = against > 0;
      last.set(next);
    }
    held.forEach(({ sample }, i) => {
      for (let m = 0; m < 3; m++) change[m] = last[3 * i + m] - applied[3 * i + m];
      this.push(velocity, sample, change);
    });
  }

  /** How much a unit of velocity that is lacking changes the impulse of each constraint [kg]. */
  steps(held) {
    const { node, weight, inverse, load } = this;
    for (const { sample } of held)
      for (let k = 27 * sample; k < 27 * sample + 27; k++) load[node[k]] += inverse[node[k]] * Math.abs(weight[k]);
    const found = held.map(({ sample }) => {
      let sum = 0;
      for (let k = 27 * sample; k < 27 * sample + 27; k++) sum += Math.abs(weight[k]) * load[node[k]];
      return sum > 0 ? 1 / sum : 0;
    });
    for (const { sample } of held) for (let k = 27 * sample; k < 27 * sample + 27; k++) load[node[k]] = 0;
    return found;
  }

  push(velocity, sample, impulse) {
    const { node, weight, inverse, wide } = this;
    for (let k = 27 * sample; k < 27 * sample + 27; k++) {
      const at = wide * node[k];
      const share = inverse[node[k]] * weight[k];
      for (let m = 0; m < 3; m++) velocity[at + m] += share * impulse[m];
    }
  }
}

const [moving, normal, change] = [new Float64Array(3), new Float64Array(3), new Float64Array(3)];
