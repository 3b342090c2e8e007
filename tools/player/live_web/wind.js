// The wind over time: a flow, sway and gusts; the definition is WindField in gaussian_swaying/wind/field.py.

/**
 * @typedef {{kind: "sway", amplitude: number, period: number, phase: number}} Sway
 * @typedef {{kind: "uniform", delta: number, interval: number, start: string}} UniformGust
 * @typedef {{kind: "gaussian", std: number, interval: number, start: string}} GaussianGust
 * @typedef {{times: number[], flows: number[][], linear: boolean, modulations: (Sway | UniformGust | GaussianGust)[],
 *   turbulence?: {cells: number[], axes: number[][], side: number, offset: number[], scale: number}}} Flow
 */

const WORD = (1n << 64n) - 1n;

/** The finaliser of SplitMix64 (Steele, Lea & Flood 2014). */
function mix(/** @type {bigint} */ x) {
  x = ((x ^ (x >> 30n)) * 0xbf58476d1ce4e5b9n) & WORD;
  x = ((x ^ (x >> 27n)) * 0x94d049bb133111ebn) & WORD;
  return x ^ (x >> 31n);
}

/** A uniform number in (0, 1) that depends on the generator, a counter and a lane only. */
export function uniform(/** @type {bigint} */ start, /** @type {number} */ counter, /** @type {number} */ lane) {
  const inner = mix((mix(start) + BigInt(counter) * 0x9e3779b97f4a7c15n) & WORD);
  const bits = mix((inner + BigInt(lane) * 0xd1b54a32d192ed03n) & WORD);
  return (Number(bits >> 11n) + 0.5) / 9007199254740992;
}

/** A standard normal number in one of three lanes. */
export function normal(/** @type {bigint} */ start, /** @type {number} */ counter, /** @type {number} */ lane) {
  return Math.sqrt(-2 * Math.log(uniform(start, counter, lane))) * Math.cos(2 * Math.PI * uniform(start, counter, lane + 3));
}

const [share, corner] = [new Float64Array(3), new Int32Array(6)];

export class Wind {
  /** @param {Flow} flow @param {Int8Array} [table] of the turbulence */
  constructor({ times, flows, linear, modulations, turbulence }, table) {
    Object.assign(this, { times, flows, linear, turbulence, table });
    /** How far the air has come [m]. */
    this.carried = [0, 0, 0];
    this.modulations = modulations.map((part) => ({ ...part, start: BigInt(part.start ?? 0) & WORD, at: -1, drawn: [0, 0, 0] }));
    /** How strong sway and gusts are, as a share of those in the file. */
    this.gusts = 1;
    /** A steady flow in place of that in the file [m/s]. @type {number[] | null} */
    this.steady = null;
  }

  /** The flow without sway and gusts [m/s]. */
  mean(/** @type {number} */ time) {
    if (this.steady) return [...this.steady];
    const { times, flows } = this;
    const last = times.length - 1;
    let key = 0;
    while (key < last && times[key + 1] <= time) key++;
    if (!this.linear || key === last) return [...flows[key]];
    const share = Math.min(Math.max((time - times[key]) / Math.max(times[key + 1] - times[key], 1e-12), 0), 1);
    return flows[key].map((from, i) => from + share * (flows[key + 1][i] - from));
  }

  /** Air velocity [m/s], into `out`. */
  blow(/** @type {number} */ time, /** @type {Float64Array} */ out) {
    const v = this.mean(time);
    for (const part of this.modulations) {
      if (part.kind === "sway") {
        const [x, y, z] = v.map(Math.abs);
        const largest = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
        v[largest] *= 1 + this.gusts * part.amplitude * Math.sin((2 * Math.PI * time) / part.period + part.phase);
        continue;
      }
      const counter = Math.floor(time / part.interval + 1e-6);
      if (counter !== part.at) {
        part.at = counter;
        part.drawn = [0, 1, 2].map((lane) => (part.kind === "gaussian" ? normal : uniform)(part.start, counter, lane));
      }
      for (let i = 0; i < 3; i++)
        if (part.kind === "gaussian") v[i] += this.gusts * part.std * part.drawn[i];
        else v[i] *= 1 + this.gusts * part.delta * (2 * part.drawn[0] - 1);
    }
    out.set(v);
  }

  /** Lets the flow carry the air on. */
  carry(/** @type {number} */ time, /** @type {number} */ dt) {
    this.mean(time).forEach((flow, i) => (this.carried[i] += dt * flow));
  }

  /** Adds the turbulence at a place [m] to an air velocity; see CarriedField in gaussian_swaying/wind/tables.py. */
  stir(/** @type {number} */ time, /** @type {Float64Array} */ place, /** @type {Float64Array} */ out) {
    const { cells, axes, side, offset, scale } = this.turbulence;
    for (let i = 0; i < 3; i++) {
      let at = offset[i];
      for (let m = 0; m < 3; m++) at += (axes[i][m] * (place[m] - this.carried[m])) / side;
      const low = Math.floor(at);
      share[i] = at - low;
      corner[i] = low - cells[i] * Math.floor(low / cells[i]);
      corner[3 + i] = (corner[i] + 1) % cells[i];
    }
    const strength = this.gusts * scale * Math.hypot(...this.mean(time));
    for (let c = 0; c < 8; c++) {
      let [weight, row] = [strength, 0];
      for (let i = 0; i < 3; i++) {
        const upper = (c >> i) & 1;
        weight *= upper ? share[i] : 1 - share[i];
        row = row * cells[i] + corner[3 * upper + i];
      }
      for (let i = 0; i < 3; i++) for (let m = 0; m < 3; m++) out[m] += weight * axes[i][m] * this.table[3 * row + i];
    }
  }
}
