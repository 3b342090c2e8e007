// The solver in compute shaders, where the browser has WebGPU. It computes frame by frame: the state at the start of each is uploaded, and
// that at its end read back, so that another solver can go on where this one stops.
import { QUICK, STRONGEST } from "./body.js";
import { LOOKS, Solver } from "./solver.js";
import substep from "./substep.wgsl";
import touch from "./touch.wgsl";

const GROUP = 64; // points or nodes that are worked on together
const BATCH = 64; // substeps that are sent at once
const STRIDE = 256; // bytes between the numbers of two substeps
const MOST_GROUPS = 65535;
const SOFTWARE = /swiftshader|llvmpipe|lavapipe|basic render|warp/i;

/** Buffers by their number in the shader; the second says whether it writes to them. @type {Record<string, [number, boolean]>} */
const BUFFERS = {
  points: [0, false], cellNodes: [1, false], vectors: [2, false], held: [3, false], displacement: [4, true], velocity: [5, true],
  stresses: [6, true], cellStart: [7, false], sums: [8, true], nodes: [9, false], entries: [10, false],
  rows: [12, false], rates: [13, true], affected: [14, false], push: [15, false], speeds: [16, true], fastest: [17, true],
  places: [18, false], reach: [19, false], obstacles: [20, false], readers: [21, false], touches: [22, true], impulses: [23, true],
  loads: [24, true],
};

/** What each pass reads and writes: at most eight buffers, which every device has. */
const PASSES = {
  particles: "points cellNodes vectors held displacement velocity stresses",
  spread: "points stresses cellStart sums",
  accelerate: "displacement velocity sums nodes entries",
  meet: "displacement velocity places reach obstacles touches impulses",
  weigh: "nodes reach readers impulses loads",
  resolve: "velocity nodes reach readers touches impulses loads",
  finish: "displacement velocity nodes",
  rate: "velocity rows rates",
  hold: "displacement velocity rates affected push",
  look: "points cellNodes displacement velocity speeds fastest",
};

const SUBSTEP = "particles spread accelerate meet weigh resolve finish rate hold".split(" ");

const OBSTACLE_KINDS = ["half_space", "capsule", "box"];
const MOST = 32; // obstacles

/** @typedef {import("./kernels.js").KernelSolver} KernelSolver */

/** Says that WebGPU cannot be used, or no longer; its message follows "as". */
export class NoWebGPU extends Error {}

/** For each number below `count`, where its places in a list begin among all places. */
function grouped(/** @type {ArrayLike<number>} */ list, /** @type {number} */ count) {
  const ends = new Uint32Array(count + 1);
  for (let k = 0; k < list.length; k++) ends[list[k] + 1]++;
  for (let k = 0; k < count; k++) ends[k + 1] += ends[k];
  const next = ends.slice();
  const entries = new Uint32Array(list.length);
  for (let k = 0; k < list.length; k++) entries[next[list[k]]++] = k;
  return { ends, entries };
}

/** Nodes and weights, in turn. */
function shares(/** @type {ArrayLike<number>} */ nodes, /** @type {ArrayLike<number>} */ weights) {
  const both = new Float32Array(2 * nodes.length);
  const whole = new Uint32Array(both.buffer);
  for (let k = 0; k < nodes.length; k++) (whole[2 * k] = nodes[k]), (both[2 * k + 1] = weights[k]);
  return both;
}

/** Why a scene is not simulated in compute shaders; null if it is. @returns {string | null} */
export function uncovered({ head, arrays }) {
  if (head.bending > 0) return "the sheet bends by itself";
  if (head.obstacles.length > MOST) return `the scene has more than ${MOST} obstacles`;
  if (9 * (arrays.cellStart.length - 1) > GROUP * MOST_GROUPS) return "the scene has too many points";
  return null;
}

/**
 * @param {{head: any, arrays: Record<string, any>}} block @param {KernelSolver} processor @param {boolean} byHand also on an adapter
 *   that is software
 * @returns {Promise<GpuSolver>} Rejects with NoWebGPU.
 */
export async function openGpu(block, processor, byHand) {
  const why = uncovered(block);
  if (why) throw new NoWebGPU(why);
  const gpu = globalThis.navigator?.gpu;
  const adapter = await gpu?.requestAdapter();
  if (!adapter) throw new NoWebGPU("this browser does not offer it");
  const info = adapter.info ?? {};
  const names = `${info.vendor} ${info.architecture} ${info.device} ${info.description}`;
  if (!byHand && (info.isFallbackAdapter || adapter.isFallbackAdapter || SOFTWARE.test(names))) throw new NoWebGPU("it would run on the processor");
  let device;
  try {
    device = await adapter.requestDevice();
    device.pushErrorScope("out-of-memory");
    device.pushErrorScope("validation");
    const solver = new GpuSolver(block, processor, device);
    await solver.compile();
    const errors = [await device.popErrorScope(), await device.popErrorScope()];
    for (const error of errors) if (error) throw error;
    return solver;
  } catch (error) {
    device?.destroy();
    throw new NoWebGPU(`its device failed: ${/** @type {Error} */ (error).message}`);
  }
}

export class GpuSolver extends Solver {
  /**
   * @param {{head: any, arrays: Record<string, any>}} block @param {KernelSolver} processor knows where points are
   * @param {any} device GPUDevice
   */
  constructor(block, processor, device) {
    super(block);
    this.processor = processor;
    this.device = device;
    /** Why the device cannot go on. @type {string | null} */
    this.broken = null;
    device.lost.then(({ message }) => (this.broken ??= message || "its device was lost"));
    device.onuncapturederror = ({ error }) => (this.broken ??= error.message);
    const { nodes, points, cells } = this;
    const samples = this.a.sampleHalf.length;
    this.counts = {
      particles: points, spread: 9 * cells, accelerate: nodes - 1, meet: samples, weigh: samples && nodes - 1, resolve: samples && 1,
      finish: samples && nodes - 1, rate: this.head.rows, hold: this.a.affected.length, look: points,
    };
    /** @type {any} what the last pull uploaded */
    this.uploaded = null;
    this.fill();
  }

  /** Makes the buffers, with all that is constant. */
  fill() {
    const { a, head, nodes, points, cells, device } = this;
    const record = { points: new Float32Array(20 * points), nodes: new Float32Array(5 * nodes) };
    const whole = { points: new Uint32Array(record.points.buffer), nodes: new Uint32Array(record.nodes.buffer) };
    const vectors = Float32Array.from({ length: (4 * a.vectors.length) / 3 }, (_, k) => (k % 4 < 3 ? a.vectors[3 * (k >> 2) + (k % 4)] : 0));
    let cell = 0;
    for (let p = 0; p < points; p++) {
      const at = 20 * p;
      const [xx, xy, xz, yy, yz, zz] = a.tensor.subarray(6 * p, 6 * p + 6);
      const own = a.firstVector.subarray(p, p + 2);
      record.points.set(a.fraction.subarray(3 * p, 3 * p + 3), at);
      record.points.set([a.volume[p], a.mass[p], a.mu[p], a.lam[p]], at + 4);
      record.points[at + 9] = own[1] > own[0] ? a.area[p] : 0;
      record.points.set([xx, xy, xz, xx + yy + zz, yy, yz, zz], at + 12);
      while (p >= a.cellStart[cell + 1]) cell++;
      whole.points[at + 3] = cell;
      whole.points[at + 8] = a.law[p];
      whole.points.set(own, at + 10);
    }
    const { ends, entries } = grouped(a.cellNodes, nodes);
    for (let k = 0; k < nodes; k++) {
      record.nodes.set([a.inverseMass[k], a.nodeDamping[k] ?? 0], 5 * k);
      whole.nodes.set([a.held[k] ?? 0, ends[k], ends[k + 1]], 5 * k + 2);
    }
    const obstacles = new Float32Array(20 * head.obstacles.length);
    head.obstacles.forEach(({ center, kind, numbers: n, friction, gap }, k) => {
      obstacles.set(center, 20 * k);
      new Uint32Array(obstacles.buffer)[20 * k + 3] = OBSTACLE_KINDS.indexOf(kind);
      if (kind === "box") obstacles.set([...n.slice(0, 3), 0, ...n.slice(3, 6), friction, ...n.slice(6, 9), gap, ...n.slice(9, 12)], 20 * k + 4);
      else obstacles.set([...n, ...Array(8 - n.length).fill(0)].slice(0, 7).concat(friction, 0, 0, 0, gap), 20 * k + 4);
    });
    const places = Float32Array.from({ length: 4 * a.sampleHalf.length }, (_, k) => (k % 4 < 3 ? a.samplePlace[3 * (k >> 2) + (k % 4)] : a.sampleHalf[k >> 2]));
    const named = grouped(a.sampleNode, nodes);
    const readers = Uint32Array.from([...named.ends.map((end) => end + nodes + 1), ...named.entries]);
    const usage = globalThis.GPUBufferUsage;
    /** @type {Record<string, any>} */
    this.buffers = {};
    /** @param {string} name @param {ArrayBufferView | number} content or its size [bytes] */
    const make = (name, content, use = usage.STORAGE | usage.COPY_DST | usage.COPY_SRC) => {
      const bytes = typeof content === "number" ? content : content.byteLength;
      this.buffers[name] = device.createBuffer({ size: Math.max(96, 16 * Math.ceil(bytes / 16)), usage: use });
      if (typeof content !== "number") device.queue.writeBuffer(this.buffers[name], 0, content);
    };
    make("points", record.points);
    make("cellNodes", Uint32Array.from(a.cellNodes));
    make("vectors", vectors);
    make("held", 16 * points);
    make("displacement", 16 * nodes);
    make("velocity", 16 * nodes);
    make("stresses", 64 * points);
    make("cellStart", Uint32Array.from(a.cellStart));
    make("sums", 27 * 16 * cells);
    make("nodes", record.nodes);
    make("entries", entries);
    make("rows", shares(a.rowNode, a.rowWeight));
    make("rates", 16 * head.rows);
    make("affected", Uint32Array.from(a.affected));
    make("push", Float32Array.from(a.push));
    make("places", places);
    make("reach", shares(a.sampleNode, a.sampleWeight));
    make("obstacles", obstacles);
    make("readers", readers);
    make("touches", 64 * head.obstacles.length * places.length / 4);
    make("impulses", 4 * places.length);
    make("loads", 4 * nodes);
    make("speeds", 4 * points);
    make("fastest", 8 * (LOOKS + 1));
    make("now", STRIDE * (BATCH + 1), usage.UNIFORM | usage.COPY_DST);
    this.sizes = { displacement: 16 * nodes, velocity: 16 * nodes, speeds: 4 * points, fastest: 8 * (LOOKS + 1) };
    make("found", Object.values(this.sizes).reduce((sum, size) => sum + size, 0), usage.MAP_READ | usage.COPY_DST);
  }

  /** Makes the pipelines. */
  async compile() {
    const { device, head, aero, counts } = this;
    const module = device.createShaderModule({ code: substep + touch });
    for (const { type, lineNum, message } of (await module.getCompilationInfo()).messages)
      if (type === "error") throw new Error(`${message} in line ${lineNum} of its shader`);
    const constants = {
      POINTS: this.points, SPREAD: counts.spread, NODES: counts.accelerate, ROWS: counts.rate, AFFECTED: counts.hold,
      OBSTACLES: counts.meet && head.obstacles.length, SAMPLES: counts.meet, ITERATIONS: head.iterations,
      DX: head.dx, INVERSE: 1 / head.dx, GRAVITY_X: head.gravity[0], GRAVITY_Y: head.gravity[1],
      GRAVITY_Z: head.gravity[2], DAMPING: head.damping, VISCOUS: head.viscous, WINDY: Number(!this.idle),
      DRAG: aero.drag, FRICTION: aero.friction, LIFT: aero.lift, AIR: aero.airDensity, AERO_LAW: aero.law,
      IMPLICIT: Number(aero.implicit), MOST_AREA: Math.min(aero.maxAreaRatio, 1e30), QUICK, STRONGEST,
    };
    const visibility = globalThis.GPUShaderStage.COMPUTE;
    const layoutOf = (entries) => device.createBindGroupLayout({ entries: entries.map((entry) => ({ visibility, ...entry })) });
    const changing = layoutOf([{ binding: 0, buffer: { type: "uniform", hasDynamicOffset: true } }]);
    this.changing = device.createBindGroup({ layout: changing, entries: [{ binding: 0, resource: { buffer: this.buffers.now, size: STRIDE } }] });
    /** @type {Record<string, any>} */
    this.passes = {};
    await Promise.all(
      Object.keys(PASSES).map(async (name) => {
        if (counts[name] === 0) return;
        const used = PASSES[name].split(" ");
        const type = (written) => ({ type: written ? "storage" : "read-only-storage" });
        const own = layoutOf(used.map((buffer) => ({ binding: BUFFERS[buffer][0], buffer: type(BUFFERS[buffer][1]) })));
        const group = device.createBindGroup({
          layout: own,
          entries: used.map((buffer) => ({ binding: BUFFERS[buffer][0], resource: { buffer: this.buffers[buffer] } })),
        });
        const layout = device.createPipelineLayout({ bindGroupLayouts: [own, changing] });
        const compute = { module, entryPoint: name, constants };
        const pipeline = await device.createComputePipelineAsync({ layout, compute });
        this.passes[name] = { pipeline, group, groups: Math.ceil(counts[name] / GROUP) };
      }),
    );
  }

  /** See Solver; resolves with the substeps, and rejects with NoWebGPU if the device fails. */
  // @ts-ignore: the others do it at once
  async advance() {
    const [time, substep] = [this.time, this.substep];
    try {
      if (this.seen.time !== time) await this.roll(0, 0);
      const frame = this.frame();
      let told = frame.next();
      while (!told.done) told = frame.next(await this.roll(this.head.frameDt / told.value, told.value));
      return told.value;
    } catch (error) {
      [this.time, this.substep] = [time, substep]; // those of the displacements
      throw error;
    }
  }

  /** Places of all points [m]. */
  positions(to) {
    this.processor.displacement.set(this.displacement);
    this.processor.positions(to);
  }

  /** The last measurement is there; the stress is the stiffness times that in the file, and so is the square of the wave. */
  look() {
    this.seen.wave *= Math.sqrt(this.stiffness / this.seen.stiffness);
    this.seen.stiffness = this.stiffness;
  }

  /** See Solver. */
  // @ts-ignore: the others do it at once
  async roll(dt, steps) {
    const { device, buffers, pull, head } = this;
    const { queue } = device;
    queue.writeBuffer(buffers.displacement, 0, this.displacement);
    queue.writeBuffer(buffers.velocity, 0, this.velocity);
    if (pull !== null && pull !== this.uploaded) {
      this.uploaded = pull;
      const held = Float32Array.from({ length: 4 * this.points }, (_, k) => {
        const [p, m] = [k >> 2, k & 3];
        return m === 3 ? pull.held[p] : pull.offset[3 * p + m] - this.a.rest[3 * p + m];
      });
      queue.writeBuffer(buffers.held, 0, held);
    }
    const every = Math.max(1, Math.ceil(steps / LOOKS));
    const numbers = new Float32Array((STRIDE / 4) * (BATCH + 1));
    const whole = new Uint32Array(numbers.buffer);
    let slot = 0;
    for (let from = 0; from <= steps; from += BATCH) {
      const encoder = device.createCommandEncoder();
      if (from === 0) encoder.clearBuffer(buffers.fastest);
      const pass = encoder.beginComputePass();
      let bound = -1; // where the numbers of the substep are
      const run = (/** @type {string} */ name, /** @type {number} */ at) => {
        if (!(name in this.passes)) return;
        const { pipeline, group, groups } = this.passes[name];
        pass.setPipeline(pipeline);
        pass.setBindGroup(0, group);
        if (at !== bound) pass.setBindGroup(1, this.changing, [(bound = at)]);
        pass.dispatchWorkgroups(groups);
      };
      for (let k = from; k < Math.min(from + BATCH, steps + 1); k++) {
        const at = (STRIDE / 4) * (k - from);
        const looked = k === steps || (k > 0 && k % every === 0);
        whole[at + 11] = slot;
        if (looked) {
          slot++;
          run("look", 4 * at);
        }
        if (k === steps) break;
        const kick = this.kick(dt);
        if (!this.idle) this.wind.blow(this.time, this.blown);
        numbers.set([...this.blown, kick, ...(pull?.target ?? [0, 0, 0]), dt, this.stiffness], at);
        whole[at + 9] = pull === null ? 0 : 1;
        const acts = ({ start, end }) => this.time + 1e-9 >= start && (end === null || this.time + 1e-9 < end);
        whole[at + 10] = head.obstacles.reduce((bits, one, p) => bits | (acts(one) ? 1 << p : 0), 0);
        for (const name of SUBSTEP) run(name, 4 * at);
        this.time += dt;
        this.substep = dt;
      }
      pass.end();
      if (from + BATCH > steps) {
        let to = 0;
        for (const name in this.sizes) {
          encoder.copyBufferToBuffer(buffers[name], 0, buffers.found, to, this.sizes[name]);
          to += this.sizes[name];
        }
      }
      queue.writeBuffer(buffers.now, 0, numbers);
      queue.submit([encoder.finish()]);
    }
    const found = await this.found();
    this.displacement.set(found.displacement);
    this.velocity.set(found.velocity);
    this.speed.set(found.speeds);
    let farthest = 0;
    for (let k = 0; k < slot; k++) {
      const wave = Math.sqrt(this.stiffness * found.fastest[2 * k]);
      const viscous = head.viscous * Math.max(found.fastest[2 * k + 1], 1);
      this.seen = { time: this.time, stiffness: this.stiffness, wave, viscous };
      farthest = Math.max(farthest, this.far(dt));
    }
    return this.displacement.every(Number.isFinite) ? farthest : NaN;
  }

  /** Reads back what `sizes` names. */
  async found() {
    const { found } = this.buffers;
    try {
      if (this.broken === null) await found.mapAsync(globalThis.GPUMapMode.READ);
    } catch (error) {
      this.broken ??= /** @type {Error} */ (error).message;
    }
    if (this.broken !== null) throw new NoWebGPU(this.broken);
    const bytes = found.getMappedRange();
    /** @type {Record<string, Float32Array>} */
    const parts = {};
    let from = 0;
    for (const name in this.sizes) {
      parts[name] = new Float32Array(bytes.slice(from, from + this.sizes[name]));
      from += this.sizes[name];
    }
    found.unmap();
    return parts;
  }
}
