// Runs the solver beside the page, in step with the clock. What it understands is in `does`, what it says in `post`.
import { readBlock } from "./block.js";
import { ModalSolver } from "./modal.js";
import { Solver } from "./solver.js";
import { NoWebGPU, openGpu } from "./webgpu.js";

const BEHIND = 0.25; // s that it may be late before it stops trying to catch up
const WINDOW = 2000; // ms, over which the speed is measured
const FULL = 0.7; // share of it after which WebGPU and the processor are compared
const LEAST = 4; // frames that it is measured from
const LATE = 0.95; // of the wanted speed: below it substeps become longer
const EASY = 0.4; // share of the time in which it computes: below it they are those of the package again
const BREATH = 4; // ms between frames, in which it hears what the page says

/** @type {any} */
let solver;
/** @type {{head: any, arrays: Record<string, any>}} */
let block;
let wanted = ""; // "auto", "webgpu" or "worker": where the motion is computed
/** Speed with WebGPU where it was too slow, so that the processor is tried. @type {number | null} */
let slow = null;
let settled = false; // whether both were tried
let chain = Promise.resolve(); // one thing after the other, as frames on a graphics card take their time
let on = false;
let speed = 1; // simulated seconds per second that are wanted
let motion = 0; // counts the starts from rest
/** @type {{now: number, time: number} | null} */
let anchor = null;
/** @type {[number, number, number][]} */
let past = []; // when, the simulated time, and how long it took [ms], of the last frames
/** @type {ReturnType<typeof setTimeout> | undefined} */
let next;

const post = (/** @type {any} */ message, /** @type {Transferable[]} */ moved = []) => self.postMessage(message, moved);

const queue = (/** @type {() => any} */ task) => (chain = chain.then(task).catch(({ message }) => post({ kind: "failed", why: message })));

/** Says what computes, and why it is not WebGPU, once that is known. @param {string | null} why */
function tell(why = null) {
  const name = solver.gpu ? "webgpu" : solver instanceof Solver ? "webassembly" : "javascript";
  post({ kind: "solver", name, why });
}

/** The motion goes on in a graphics card, or with null in the processor. @param {any} gpu @param {string | null} why */
function takeOver(gpu, why = null) {
  solver.gpu?.device.destroy();
  solver.gpu = gpu;
  past = [];
  tell(why);
}

/** Computes as is wanted, as far as possible; until WebGPU is there, the processor does. */
async function choose() {
  if (wanted === "worker") {
    if (solver.gpu) takeOver(null);
    return;
  }
  if (solver.gpu) return;
  if (solver instanceof ModalSolver) return tell("the object sways by modes");
  try {
    const found = await openGpu(block, wanted === "webgpu");
    queue(() => {
      if (wanted === "worker" || solver.gpu) return found.device.destroy();
      takeOver(found);
      found.device.lost.then(() => queue(() => solver.gpu === found && takeOver(null, found.broken)));
    });
  } catch (error) {
    tell(/** @type {Error} */ (error).message);
  }
}

/** Advances by a frame; where the graphics card fails, the processor goes on. */
async function forward() {
  try {
    return await solver.advance();
  } catch (error) {
    if (!(error instanceof NoWebGPU)) throw error;
    takeOver(null, error.message);
    return solver.advance();
  }
}

function show() {
  const moved = solver.drawn();
  const rate = solver.hurried || solver.head.substep !== null ? measured()?.rate ?? null : null;
  post({ kind: "state", motion, time: solver.time, moved, rate, ended: !on }, [moved.buffer]);
}

/** Simulated seconds per second, the share of the time in which it computes, and how long that was [ms]; null at first. */
function measured() {
  if (past.length < LEAST) return null;
  const [first, last] = [past[0], past[past.length - 1]];
  const wall = last[0] - first[0];
  return { wall, rate: (last[1] - first[1]) / (wall / 1000), busy: past.slice(1).reduce((sum, frame) => sum + frame[2], 0) / wall };
}

/** Takes longer substeps where it is late; where even those of WebGPU are, the faster one of WebGPU and the processor. */
function hurry() {
  const found = measured();
  if (!found) return;
  const late = found.rate < LATE * speed;
  const hurried = late || (solver.hurried && found.busy > EASY);
  if (hurried !== solver.hurried) {
    solver.hurried = hurried;
    past = [];
  } else if (late && !settled && wanted === "auto" && found.wall > FULL * WINDOW) {
    if (solver.gpu) {
      slow = found.rate;
      takeOver(null, "it is too slow here");
    } else if (slow !== null) {
      settled = true;
      if (found.rate < slow) choose();
    }
  }
}

async function pace() {
  clearTimeout(next);
  if (!on || !solver) return;
  const now = performance.now();
  anchor ??= { now, time: solver.time };
  const due = anchor.time + ((now - anchor.now) / 1000) * speed;
  if (due - solver.time > BEHIND * speed) anchor = { now, time: solver.time };
  if (solver.time > due) {
    next = setTimeout(queue, Math.max(BREATH, ((solver.time - due) / speed) * 1000), pace);
    return;
  }
  const began = performance.now();
  try {
    await forward();
  } catch (error) {
    on = false;
    post({ kind: "failed", why: /** @type {Error} */ (error).message });
    return;
  }
  const after = performance.now();
  past.push([after, solver.time, after - began]);
  while (past.length > LEAST && after - past[0][0] > WINDOW) past.shift();
  hurry();
  show();
  next = setTimeout(queue, BREATH, pace);
}

function restart() {
  anchor = null;
  past = [];
  return pace();
}

/** @type {Record<string, (given: any) => void>} */
const does = {
  load(given) {
    block = readBlock(given.bytes);
    solver = block.head.modes ? new ModalSolver(block) : new Solver(block);
    show();
    tell();
  },
  // said when the first pictures are drawn, which WebGPU would delay
  solver({ which }) {
    if (which === wanted) return;
    wanted = which;
    choose();
  },
  run(given) {
    on = given.on;
    speed = given.speed;
    return restart();
  },
  wind({ flow, gusts }) {
    solver.wind.steady = flow;
    solver.wind.gusts = gusts;
  },
  stiffness({ factor }) {
    solver.stiffness = factor;
  },
  grab({ eye, ray, wide, token }) {
    post({ kind: "grabbed", token, place: solver.grab(eye, ray, wide) });
  },
  aim({ target }) {
    solver.pull?.target.set(target);
  },
  release() {
    solver.pull = null;
  },
  reset() {
    solver.reset();
    motion++;
    show();
    return restart();
  },
  // for tests and measurements
  async frames({ count, hurried }) {
    solver.hurried = !!hurried;
    const began = performance.now();
    let substeps = 0;
    for (let k = 0; k < count; k++) substeps += await forward();
    show();
    post({ kind: "done", gpu: !!solver.gpu, kernels: solver instanceof Solver && !solver.gpu, substeps, seconds: (performance.now() - began) / 1000, simulated: count * solver.head.frameDt });
  },
  lose() {
    solver.gpu?.device.destroy();
  },
};

self.onmessage = ({ data }) => queue(() => does[data.kind](data));
