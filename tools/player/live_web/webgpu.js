// Substeps in compute shaders, where the browser has WebGPU: the package's own kernels, which gaussian_swaying/kernels/wgsl.py writes. The
// buffer is the memory of the kernels in WebAssembly. What differs is uploaded at the start of each frame, and the state read back at its end,
// so that the processor can go on at any time.
import { LOOKS, MOST } from "./solver.js";

const STRIDE = 256; // bytes between the numbers of two substeps
const MOST_GROUPS = 65535;
const SOFTWARE = /swiftshader|llvmpipe|lavapipe|basic render|warp/i;

/** @typedef {import("./solver.js").Solver} Solver */

/** Says that WebGPU cannot be used, or no longer; its message follows "as". */
export class NoWebGPU extends Error {}

/**
 * @param {{head: any, arrays: Record<string, any>}} block @param {boolean} byHand also on an adapter that is software
 * @returns {Promise<Gpu>} Rejects with NoWebGPU.
 */
export async function openGpu({ head, arrays }, byHand) {
  const { shaders, passes } = head.kernels;
  if (shaders) throw new NoWebGPU(shaders);
  if (Object.values(passes).flat().some(([, groups]) => groups > MOST_GROUPS)) throw new NoWebGPU("the scene has too many points");
  const gpu = globalThis.navigator?.gpu;
  const adapter = await gpu?.requestAdapter();
  if (!adapter) throw new NoWebGPU("this browser does not offer it");
  const info = adapter.info ?? {};
  const names = `${info.vendor} ${info.architecture} ${info.device} ${info.description}`;
  if (!byHand && (info.isFallbackAdapter || adapter.isFallbackAdapter || SOFTWARE.test(names))) throw new NoWebGPU("it would run on the processor");
  const size = 4 * Math.ceil(arrays.image.length / 4);
  const limits = Object.fromEntries(["maxBufferSize", "maxStorageBufferBindingSize"].map((name) => [name, Math.max(size, 2 ** 27)]));
  let device;
  try {
    device = await adapter.requestDevice({ requiredLimits: limits });
    device.pushErrorScope("out-of-memory");
    device.pushErrorScope("validation");
    const found = new Gpu(device, head.kernels, arrays.image, size);
    await found.compile(new TextDecoder().decode(arrays.shaders));
    const errors = [await device.popErrorScope(), await device.popErrorScope()];
    for (const error of errors) if (error) throw error;
    return found;
  } catch (error) {
    device?.destroy();
    throw new NoWebGPU(`its device failed: ${/** @type {Error} */ (error).message}`);
  }
}

export class Gpu {
  /** @param {any} device GPUDevice @param {any} kernels @param {Uint8Array} image @param {number} size of the memory [bytes] */
  constructor(device, { places, passes, start }, image, size) {
    this.device = device;
    this.passes = passes;
    /** Why the device cannot go on. @type {string | null} */
    this.broken = null;
    device.lost.then(({ message }) => (this.broken ??= message || "its device was lost"));
    device.onuncapturederror = ({ error }) => (this.broken ??= error.message);
    this.place = (/** @type {string} */ name) => [places[name][0] - start, places[name][1]];
    const usage = globalThis.GPUBufferUsage;
    const make = (bytes, use) => device.createBuffer({ size: bytes, usage: use | usage.COPY_DST });
    this.memory = make(size, usage.STORAGE | usage.COPY_SRC);
    this.peaks = make(8, usage.STORAGE | usage.COPY_SRC);
    this.counts = make(STRIDE * MOST, usage.UNIFORM);
    this.found = make(places.fields[1] + places.velocity[1] + 8 * (LOOKS + 1), usage.MAP_READ);
    const padded = new Uint8Array(size);
    padded.set(image);
    device.queue.writeBuffer(this.memory, 0, padded);
    device.queue.writeBuffer(this.counts, 0, Int32Array.from({ length: (STRIDE / 4) * MOST }, (_, k) => Math.floor((4 * k) / STRIDE)));
  }

  /** Makes the pipelines of the shaders `code`. */
  async compile(code) {
    const { device } = this;
    const module = device.createShaderModule({ code });
    for (const { type, lineNum, message } of (await module.getCompilationInfo()).messages)
      if (type === "error") throw new Error(`${message} in line ${lineNum} of its shaders`);
    const visibility = globalThis.GPUShaderStage.COMPUTE;
    const layouts = [
      [{ type: "storage" }, { type: "storage" }],
      [{ type: "uniform", hasDynamicOffset: true }],
    ].map((every) => device.createBindGroupLayout({ entries: every.map((buffer, binding) => ({ binding, visibility, buffer })) }));
    const group = (layout, ...buffers) =>
      device.createBindGroup({ layout, entries: buffers.map((resource, binding) => ({ binding, resource })) });
    this.shared = group(layouts[0], { buffer: this.memory }, { buffer: this.peaks });
    this.counted = group(layouts[1], { buffer: this.counts, size: 16 });
    const layout = device.createPipelineLayout({ bindGroupLayouts: layouts });
    const names = [...new Set(Object.values(this.passes).flatMap((every) => every.map(([name]) => name)))];
    const make = async (entryPoint) => [entryPoint, await device.createComputePipelineAsync({ layout, compute: { module, entryPoint } })];
    this.pipelines = Object.fromEntries(await Promise.all(names.map(make)));
  }

  /** Finishes a frame of a solver; what failed leaves it at the start. @returns {Promise<number>} substeps */
  async finish(frame, told, /** @type {Solver} */ solver) {
    const [time, substep] = [solver.time, solver.substep];
    try {
      while (!told.done) told = frame.next(await this.roll(solver, ...told.value));
      return told.value;
    } catch (error) {
      solver.tables.fields.set(solver.before);
      [solver.time, solver.substep] = [time, substep];
      throw error;
    }
  }

  /** As that of a Solver. */
  async roll(/** @type {Solver} */ solver, dt, steps) {
    const { device } = this;
    const upload = (...names) => {
      for (const name of names) if (name in solver.tables) device.queue.writeBuffer(this.memory, this.place(name)[0], solver.tables[name]);
    };
    upload("fields");
    const every = Math.max(1, Math.ceil(steps / LOOKS));
    const [size, more] = ["fields", "velocity"].map((name) => this.place(name)[1]);
    const kind = solver.pull ? "held" : "free";
    let looks = 0;
    for (let from = 0; from <= steps; from += MOST) {
      const count = Math.min(MOST, steps - from);
      solver.write(dt, count);
      solver.time += count * dt;
      upload("schedule", "winds", "values", "material", "curving");
      const encoder = device.createCommandEncoder();
      let pass;
      const run = (name, k) => {
        if (!pass) (pass = encoder.beginComputePass()).setBindGroup(0, this.shared);
        pass.setBindGroup(1, this.counted, [STRIDE * k]);
        for (const [kernel, groups] of this.passes[name]) {
          pass.setPipeline(this.pipelines[kernel]);
          pass.dispatchWorkgroups(groups);
        }
      };
      const end = () => (pass?.end(), (pass = undefined));
      const look = () => {
        end();
        encoder.clearBuffer(this.peaks);
        run("look", 0);
        end();
        encoder.copyBufferToBuffer(this.peaks, 0, this.found, size + more + 8 * looks++, 8);
      };
      for (let k = 0; k < count; k++) {
        if (from + k > 0 && (from + k) % every === 0) look();
        run(kind, k);
      }
      if (from + MOST > steps) {
        look();
        run("read", 0);
        end();
        encoder.copyBufferToBuffer(this.memory, this.place("fields")[0], this.found, 0, size);
        encoder.copyBufferToBuffer(this.memory, this.place("velocity")[0], this.found, size, more);
      }
      end();
      device.queue.submit([encoder.finish()]);
    }
    const found = await this.read();
    solver.tables.fields.set(found.subarray(0, size / 4));
    solver.tables.velocity.set(found.subarray(size / 4, (size + more) / 4));
    let farthest = 0;
    for (let k = 0; k < looks; k++) {
      solver.see(found.subarray((size + more) / 4 + 2 * k));
      farthest = Math.max(farthest, solver.far(dt));
    }
    return solver.tables.fields.every(Number.isFinite) ? farthest : NaN;
  }

  /** What was copied to `found`. */
  async read() {
    const { found } = this;
    try {
      if (this.broken === null) await found.mapAsync(globalThis.GPUMapMode.READ);
    } catch (error) {
      this.broken ??= /** @type {Error} */ (error).message;
    }
    if (this.broken !== null) throw new NoWebGPU(this.broken);
    const numbers = new Float32Array(found.getMappedRange().slice(0));
    found.unmap();
    return numbers;
  }
}
