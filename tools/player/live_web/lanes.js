// The solver with its passes over points and nodes in WebAssembly, four points at a time, in single precision as in the package.
import { NEO_HOOKEAN, unreflected } from "./laws.js";
import code from "./points.wasm"; // build.js makes both from points.ts
import fused from "./points.fused.wasm";
import { Solver } from "./solver.js";

const LANES = 4;
const RECORD = 16 * LANES; // numbers of four points: see the constructor

/** Area vectors of the patches of each point, three numbers each. @param {Solver} solver @returns {number[][]} */
export function areaVectors({ a, head, points }) {
  return Array.from({ length: points }, (_, p) => {
    if (head.grouped) return Array.from(a.vectors.subarray(3 * a.firstVector[p], 3 * a.firstVector[p + 1]));
    const area = a.patch[4 * p + 3];
    return area > 0 ? [0, 1, 2].map((m) => area * a.patch[4 * p + m]) : [];
  });
}

/** Six numbers of the sum of A N N^T of a point. @param {Solver} solver @param {number} p @returns {number[]} */
export function tensorOf({ a, head }, p) {
  if (head.grouped) return Array.from(a.tensor.subarray(6 * p, 6 * p + 6));
  const [x, y, z, area] = a.patch.subarray(4 * p, 4 * p + 4);
  return [x * x, x * y, x * z, y * y, y * z, z * z].map((square) => area * square);
}

export class LanesSolver extends Solver {
  /** @param {{head: any, arrays: Record<string, any>}} block Throws an Error where the browser has no such WebAssembly. */
  constructor(block) {
    super(block);
    const { head, arrays: a } = block;
    const env = { unreflected: (at) => this.unreflect(at), log: Math.log, cos: Math.cos, acos: Math.acos };
    const { exports } = new WebAssembly.Instance(new WebAssembly.Module(WebAssembly.validate(fused) ? fused : code), { env });
    this.code = /** @type {any} */ (exports);
    const starts = Int32Array.from({ length: this.cells + 1 });
    for (let c = 0; c < this.cells; c++) starts[c + 1] = starts[c] + Math.ceil((a.cellStart[c + 1] - a.cellStart[c]) / LANES);
    const chunks = starts[this.cells];
    /** Where each point lies among the lanes. */
    this.lane = new Int32Array(this.points);
    for (let p = 0; p < this.points; p++) {
      const c = this.cell[p];
      const within = p - a.cellStart[c];
      this.lane[p] = LANES * (starts[c] + Math.floor(within / LANES)) + (within % LANES);
    }
    const vectors = areaVectors(this);
    const rows = new Int32Array(chunks); // of area vectors, as many as the point with most of them has
    vectors.forEach((own, p) => {
      const chunk = Math.floor(this.lane[p] / LANES);
      rows[chunk] = Math.max(rows[chunk], own.length / 3);
    });
    const total = rows.reduce((sum, count) => sum + count, 0);
    const sizes = {
      starts: starts.length, nodes: 27 * this.cells, records: RECORD * chunks, vectors: 3 * LANES * total,
      displacement: 4 * this.nodes, velocity: 4 * this.nodes, force: 4 * this.nodes, speeds: LANES * chunks,
      inverses: this.nodes, decays: this.nodes, resistances: this.nodes,
      rowNode: a.rowNode.length, rowWeight: a.rowWeight.length, affected: a.affected.length, push: a.push.length, rates: 4 * head.rows,
      sampleNode: a.sampleNode.length, sampleWeight: a.sampleWeight.length, moved: 4 * a.sampleHalf.length,
    };
    let end = Math.ceil(this.code.free() / 16) * 16;
    /** First byte of each array. @type {Record<string, number>} */
    this.where = {};
    for (const name in sizes) {
      this.where[name] = end;
      end += 16 * Math.ceil(sizes[name] / 4);
    }
    const { memory } = this.code;
    memory.grow(Math.max(0, Math.ceil((end - memory.buffer.byteLength) / 65536)));
    const view = (Kind, name) => new Kind(memory.buffer, this.where[name], sizes[name]);
    view(Int32Array, "starts").set(starts);
    view(Int32Array, "nodes").set(a.cellNodes.map((node) => 16 * node)); // bytes
    this.displacement = view(Float32Array, "displacement");
    this.velocity = view(Float32Array, "velocity");
    this.force = view(Float32Array, "force");
    this.resistance = view(Float32Array, "resistances");
    this.lanes = view(Float32Array, "speeds");
    this.decays = view(Float32Array, "decays");
    this.kicked = NaN; // the time that `decays` are for [s]
    view(Float32Array, "inverses").set(a.inverseMass);
    this.moved = view(Float32Array, "moved");
    for (const name of ["rowWeight", "push", "sampleWeight"]) view(Float32Array, name).set(a[name]);
    for (const name of ["rowNode", "affected", "sampleNode"]) view(Int32Array, name).set(a[name].map((node) => 16 * node));
    this.before = { displacement: this.displacement.slice(), velocity: this.velocity.slice() };

    const [records, whole] = [view(Float32Array, "records"), view(Int32Array, "records")];
    const table = view(Float32Array, "vectors");
    let row = 0;
    for (let chunk = 0; chunk < chunks; chunk++) {
      whole[RECORD * chunk + 14 * LANES] = row;
      whole[RECORD * chunk + 14 * LANES + 1] = rows[chunk];
      row += rows[chunk];
    }
    vectors.forEach((own, p) => {
      const at = Math.floor(this.lane[p] / LANES) * RECORD + (this.lane[p] % LANES);
      const [volume, tensor] = [a.volume[p], tensorOf(this, p)];
      const numbers = [0, 1, 2].map((m) => a.fraction[3 * p + m]);
      numbers.push(volume, a.mu[p], a.lam[p], volume / a.mass[p], ...tensor, a.law[p] === NEO_HOOKEAN ? 1 : 0);
      numbers.forEach((number, k) => (records[at + LANES * k] = number));
      // lanes without a point lie at the last one, where F is not inverted if its own is not
      for (let lane = (this.lane[p] % LANES) + 1, k = 0; lane < LANES; lane++)
        for (k = 0; k < 3; k++) records[at + LANES * k + lane - (this.lane[p] % LANES)] = numbers[k];
      const chunk = RECORD * Math.floor(this.lane[p] / LANES) + 14 * LANES;
      whole[chunk + 2]++; // points of the four
      const first = 3 * LANES * whole[chunk];
      own.forEach((number, k) => (table[first + LANES * k + (this.lane[p] % LANES)] = number));
    });
    this.reset();
  }

  /** The nearest rotation of an inverted F, for points.ts. */
  unreflect(at) {
    const numbers = new Float32Array(this.code.memory.buffer, at, 9);
    unreflected(Float64Array.from(numbers), numbers);
  }

  /** See Solver. */
  particles(looked, pushed) {
    const { where, aero, blown, stiffness, idle } = this;
    const fastest = this.code.particles(
      this.cells, where.starts, where.nodes, where.records, where.vectors, where.displacement, where.velocity, where.force,
      where.speeds, 1 / this.head.dx, stiffness, blown[0], blown[1], blown[2], 0.5 * aero.airDensity, aero.drag, aero.friction,
      aero.lift, aero.law, Math.min(aero.maxAreaRatio, 1e30), !idle, looked, pushed,
    );
    if (!looked) return;
    this.seen = { time: this.time, stiffness, wave: Math.sqrt(fastest), viscous: 0 };
    for (let p = 0; p < this.points; p++) this.speed[p] = this.lanes[this.lane[p]];
  }

  accelerate(kick) {
    const { head, where, nodes, a } = this;
    if (kick !== this.kicked) {
      this.kicked = kick;
      for (let k = 0; k < nodes; k++) this.decays[k] = Math.exp(-kick * (head.damping + (a.nodeDamping[k] ?? 0)));
    }
    const { velocity, force, inverses, decays, resistances } = where;
    this.code.accelerate(nodes - 1, velocity, force, inverses, decays, resistances, this.dragged, kick, ...head.gravity);
  }

  hold() {
    const { where, head, a } = this;
    if (head.rows === 0) return;
    const { velocity, rowNode, rowWeight, affected, push, rates } = where;
    this.code.read(head.rows, rowNode, rowWeight, velocity, rates);
    this.code.hold(velocity, head.rows, a.affected.length, affected, push, rates);
  }

  samples() {
    const { sampleNode, sampleWeight, displacement, moved } = this.where;
    this.code.read(this.contact.count, sampleNode, sampleWeight, displacement, moved);
  }

  move(dt) {
    this.code.move(this.nodes, this.where.displacement, this.where.velocity, dt);
  }
}
