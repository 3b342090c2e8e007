// The wind over time: the flow and what it carries along; gusts are the package's kernel, see gaussian_swaying/wind/field.py.

/**
 * @typedef {{column: number, offset: number[], axes: number[][], cells: (number | null)[], scale: number, grows: boolean}} Carried
 * @typedef {{times: number[], flows: number[][], gust_times: number[], gusts: number[], linear: boolean, carried: Carried[], past: number[]}} Flow
 */

/** Rows of numbers that are given at some times, at another one. @param {number[]} times @param {number[][]} rows @param {boolean} linear @param {number} time */
function keyed(times, rows, linear, time) {
  const last = times.length - 1;
  let key = 0;
  while (key < last && times[key + 1] <= time) key++;
  if (!linear || key === last) return rows[key];
  const share = Math.min(Math.max((time - times[key]) / Math.max(times[key + 1] - times[key], 1e-12), 0), 1);
  return rows[key].map((from, i) => from + share * (rows[key + 1][i] - from));
}

export class Wind {
  /** @param {Flow} flow @param {any} kernels @param {Record<string, any>} tables of the kernels */
  constructor(flow, kernels, { times, air, gusts, winds }) {
    Object.assign(this, { flow, kernels, times, air, strengths: gusts, winds });
    /** How strong sway and gusts are, as a share of those in the file. */
    this.gusts = 1;
    /** A steady flow in place of that in the file [m/s]. @type {number[] | null} */
    this.steady = null;
    this.reset();
  }

  /** Back to time zero. */
  reset() {
    /** How far the air has come [m], and when. */
    this.come = [0, 0, 0, 0];
  }

  /** The flow without sway and gusts [m/s]. */
  mean(/** @type {number} */ time) {
    return this.steady ?? keyed(this.flow.times, this.flow.flows, this.flow.linear, time);
  }

  /** The factor of the gusts. */
  strength(/** @type {number} */ time) {
    return this.gusts * keyed(this.flow.gust_times, this.flow.gusts.map((value) => [value]), this.flow.linear, time)[0];
  }

  /** Air velocities [m/s], three numbers at each of some times [s]. */
  blow(/** @type {number[]} */ times) {
    times.forEach((time, k) => {
      this.times[k] = time;
      this.air.set(this.mean(time), 3 * k);
      this.strengths[k] = this.strength(time);
    });
    this.kernels.blow();
    return this.air;
  }

  /** Writes the rows of substeps that begin at some times [s], `width` numbers each. */
  write(/** @type {number[]} */ times, /** @type {number} */ width) {
    const { winds, come } = this;
    const air = this.blow(times);
    times.forEach((time, k) => {
      winds.set(air.subarray(3 * k, 3 * k + 3), width * k);
      const gap = time - come[3];
      const flow = this.mean(come[3] + gap / 2);
      for (let i = 0; i < 3; i++) come[i] += gap * flow[i];
      come[3] = time;
      const now = this.mean(time);
      const speed = Math.hypot(...now);
      for (const column of this.flow.past) winds.set(now, width * k + column);
      for (const { column, offset, axes, cells, scale, grows } of this.flow.carried) {
        const place = offset.map((at, i) => at - axes[i][0] * come[0] - axes[i][1] * come[1] - axes[i][2] * come[2]);
        const wrapped = place.map((at, i) => (cells[i] ? at - cells[i] * Math.floor(at / cells[i]) : at));
        winds.set([...wrapped, this.strength(time) * scale * (grows ? speed : 1)], width * k + column);
      }
    });
  }
}
