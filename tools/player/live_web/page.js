// The page in which the visitor turns the wind: draws what the solver in the worker computes. See docs/web.md.
import { readHead } from "../bundle.js";
import { element } from "../panel.js";
import { Tunnel } from "../tunnel.js";
import { View } from "../view.js";

const BEHIND = 0.95; // of the wanted speed, with the longest substeps: below it the page says so

/** Starts a worker of a program. @param {Uint8Array} program */
function startWorker(program) {
  const url = URL.createObjectURL(new Blob([program], { type: "text/javascript" }));
  const worker = new Worker(url);
  URL.revokeObjectURL(url);
  return worker;
}

/**
 * Plays the page. @param {(name: string) => Promise<Uint8Array>} read gives a part of the file once it is there
 * @param {(sentence: string) => void} tell shows a sentence
 */
export async function sway(read, tell) {
  const [head, stencils] = await readHead(read);
  const view = new View(element("canvas"));
  const worker = startWorker(await read("worker"));
  const state = { failed: null, rate: null, message: "", solver: "", why: null };
  const say = (/** @type {any} */ message, /** @type {Transferable[]} */ given = []) => worker.postMessage(message, given);
  const answers = []; // promises of tests, see `advance`
  let wish = ""; // webgpu, worker or auto: where the link wants it to be computed

  const start = new Promise((resolve, reject) => {
    const first = (/** @type {MessageEvent} */ event) => {
      if (event.data.kind !== "failed") return resolve(null);
      event.stopImmediatePropagation();
      worker.terminate();
      reject(new Error(event.data.why));
    };
    worker.addEventListener("message", first, { once: true });
    worker.onerror = () => reject(new Error("the solver did not start"));
  });
  start.catch(() => {}); // awaited at the end

  const tunnel = new Tunnel(view, say, (name) => {
    const value = (/** @type {string} */ one) => tunnel.panel.controls.get(one).value;
    if (name === "stiffness") say({ kind: "stiffness", factor: value(name) });
    else say({ kind: "wind", flow: tunnel.changed.get("wind") ?? null, gusts: value("gusts") });
  });
  tunnel.metre = head.metre;
  const { setPlaying, reset, apply } = tunnel;
  tunnel.apply = (text, whole) => {
    apply.call(tunnel, text, whole);
    const found = new URLSearchParams(text.replace(/^[#?]/, "")).get("solver") ?? "auto";
    if (found !== "auto") tunnel.changed.set("solver", found);
    if (found !== wish) say({ kind: "solver", which: (wish = found) });
  };
  tunnel.setPlaying = (on) => (on && state.failed ? null : setPlaying.call(tunnel, on));
  tunnel.reset = () => {
    reset.call(tunnel);
    if (state.failed) {
      state.failed = null;
      tunnel.setPlaying(true);
    }
    explain();
  };

  worker.onmessage = ({ data }) => {
    if (data.kind === "state") {
      state.rate = data.rate;
      tunnel.take(data);
    } else if (data.kind === "grabbed") tunnel.grabbed(data);
    else if (data.kind === "done") answers.shift()?.(data);
    else if (data.kind === "solver") [state.solver, state.why] = [data.name, data.why];
    else if (data.kind === "failed") {
      tunnel.setPlaying(false);
      state.failed = data.why;
    }
    explain();
  };

  function explain() {
    const late = tunnel.playing && state.rate !== null && state.rate < BEHIND * tunnel.speed;
    let sentence = late ? `This device is too slow for real time: the motion runs at ${state.rate.toFixed(2)} of it.` : "";
    if (!sentence && state.why && wish === "webgpu") sentence = `WebGPU is not used, as ${state.why}: the processor computes the motion.`;
    if (state.failed) sentence = `The motion has stopped, as ${state.failed}: press Reset.`;
    if (sentence === state.message) return;
    state.message = sentence;
    tell(sentence);
  }

  const block = await read("solver");
  say({ kind: "load", bytes: block }, [block.buffer]);
  await view.open(head, stencils, read);
  view.aimAsWritten();
  tunnel.show(head.panel);
  document.addEventListener("visibilitychange", () => tunnel.run()); // a hidden page costs nothing
  view.begin((now) => tunnel.tick(now));
  const complete = view.takeRest();
  const begin = () => {
    tunnel.apply(location.hash);
    tunnel.run();
    explain();
  };
  complete.then(begin, (error) => {
    console.info(error.message);
    state.message = error.message;
    tell(error.message);
    begin();
  });

  window.windPage = {
    head,
    tunnel,
    view,
    complete,
    value: (name) => tunnel.panel.controls.get(name).value,
    link: () => tunnel.link(),
    first: () => view.first,
    time: () => tunnel.playback.newest,
    rate: () => state.rate,
    solver: () => state.solver, // webgpu, webassembly or javascript
    why: () => state.why, // it is not WebGPU
    // As if the graphics card were lost.
    lose: () => say({ kind: "lose" }),
    playing: () => tunnel.playing,
    pulled: () => tunnel.pull?.held ?? false,
    pause: () => tunnel.setPlaying(false),
    reset: () => tunnel.reset(),
    // Advance by some frames at once, without the clock; resolves with how long that took.
    advance: (count, hurried = false) =>
      new Promise((resolve) => {
        answers.push(resolve);
        say({ kind: "frames", count, hurried });
      }),
    positions: () => tunnel.positions(),
  };
  await start;
}
