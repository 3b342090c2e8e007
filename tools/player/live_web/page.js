// The page in which the visitor turns the wind: draws what the solver in the worker computes. See docs/web.md.
import * as THREE from "three";
import { reader } from "../gaussians.js";
import { Playback } from "../playback.js";
import { View } from "../view.js";
import { Dial } from "./dial.js";
import { LIMITS, readSettings, USUAL, writeSettings } from "./settings.js";

const SLOW = 0.25; // simulated seconds per second in slow motion
const BEHIND = 0.95; // of the wanted speed, with the longest substeps: below it the page says so
const PICKED = 12; // pixels from the object at which a finger still takes hold of it
const PIXELS = [1, 0.75, 0.5, 0.35]; // of the window's along each side, where drawing is slow
const FEW = 20; // pictures a second

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
  const head = JSON.parse(new TextDecoder().decode(await read("head")));
  const stencils = reader(await read("stencils"))(Uint32Array, 27 * head.stencils);
  const element = (name) => document.getElementById(name);
  const canvas = /** @type {HTMLCanvasElement} */ (element("canvas"));
  const settings = readSettings(location.hash);
  const view = new View(canvas, head, stencils, read);
  const { drawing } = view;
  const worker = startWorker(await read("worker"));
  const playback = new Playback();
  const state = { playing: true, motion: 0, failed: null, rate: null, pull: null, stale: false, message: "", count: 0, solver: "", why: null };
  const say = (/** @type {any} */ message, /** @type {Transferable[]} */ given = []) => worker.postMessage(message, given);
  const answers = []; // promises of tests, see `advance`

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

  worker.onmessage = ({ data }) => {
    if (data.kind === "state") {
      if (data.motion !== state.motion) playback.clear();
      state.motion = data.motion;
      state.rate = data.rate;
      state.stale = true;
      playback.add(data, performance.now() / 1000, data.ended);
    } else if (data.kind === "grabbed") grabbed(data);
    else if (data.kind === "done") answers.shift()?.(data);
    else if (data.kind === "solver") [state.solver, state.why] = [data.name, data.why];
    else if (data.kind === "failed") {
      state.failed = data.why;
      setPlaying(false);
    }
    explain();
  };
  const block = await read("solver");
  say({ kind: "load", bytes: block }, [block.buffer]);
  await view.open();
  const { camera, controls } = view;
  if (settings.view) {
    camera.position.fromArray(settings.view);
    controls.target.fromArray(settings.view, 3);
    controls.update();
  }

  // ---- what the page says

  function explain() {
    const wanted = settings.speed;
    const late = state.playing && state.rate !== null && state.rate < BEHIND * wanted;
    let sentence = late ? `This device is too slow for real time: the motion runs at ${state.rate.toFixed(2)} of it.` : "";
    if (!sentence && state.why && settings.solver === "webgpu") sentence = `WebGPU is not used, as ${state.why}: the processor computes the motion.`;
    if (state.failed) sentence = `The motion has stopped, as ${state.failed}: press Reset.`;
    if (sentence === state.message) return;
    state.message = sentence;
    tell(sentence);
  }

  // ---- controls

  const [play, slow, gusts, stiffness] = ["play", "slow", "gusts", "stiffness"].map(element);
  [gusts.min, gusts.max] = LIMITS.gusts.map(String);
  [stiffness.min, stiffness.max] = LIMITS.stiffness.map((factor) => String(Math.log2(factor)));
  const rim = Math.max(10, 2 * Math.hypot(head.wind[0], head.wind[1]));
  const dial = new Dial(element("dial"), rim, ([x, y]) => {
    settings.wind = [x, y, settings.wind?.[2] ?? head.wind[2]];
    sendWind();
  });
  const azimuth = () => Math.atan2(camera.position.y - controls.target.y, camera.position.x - controls.target.x) + Math.PI / 2;

  function showWind() {
    const [x, y] = settings.wind ?? head.wind;
    dial.show([x, y], azimuth());
  }

  function sendWind() {
    say({ kind: "wind", flow: settings.wind, gusts: settings.gusts });
    showWind();
  }

  function run() {
    say({ kind: "run", on: state.playing && !document.hidden, speed: settings.speed });
  }

  function setPlaying(on) {
    if (on && state.failed) return;
    state.playing = on;
    play.textContent = on ? "❚❚" : "▶";
    play.setAttribute("aria-label", on ? "Pause" : "Play");
    run();
  }

  function showAll() {
    slow.setAttribute("aria-pressed", String(settings.speed < 1));
    gusts.value = String(settings.gusts);
    stiffness.value = String(Math.log2(settings.stiffness));
    showWind();
  }

  function sendAll() {
    sendWind();
    explain();
    say({ kind: "stiffness", factor: settings.stiffness });
    say({ kind: "solver", which: settings.solver });
    run();
    showAll();
  }

  function reset() {
    say({ kind: "reset" });
    if (state.failed) {
      state.failed = null;
      setPlaying(true);
    }
    explain();
  }

  function link() {
    const place = [...camera.position.toArray(), ...controls.target.toArray()];
    return `${location.href.split("#")[0]}#${writeSettings({ ...settings, view: place })}`;
  }

  play.addEventListener("click", () => setPlaying(!state.playing));
  slow.addEventListener("click", () => {
    settings.speed = settings.speed < 1 ? 1 : SLOW;
    showAll();
    run();
  });
  element("reset").addEventListener("click", reset);
  gusts.addEventListener("input", () => {
    settings.gusts = Number(gusts.value);
    sendWind();
  });
  stiffness.addEventListener("input", () => {
    settings.stiffness = 2 ** Number(stiffness.value);
    say({ kind: "stiffness", factor: settings.stiffness });
  });
  element("link").addEventListener("click", async () => {
    history.replaceState(null, "", link());
    const button = element("link");
    const copied = await navigator.clipboard?.writeText(link()).then(() => true, () => false);
    button.textContent = copied ? "Copied" : "In the address";
    setTimeout(() => (button.textContent = "Link"), 2000);
  });
  window.addEventListener("keydown", (event) => {
    if (event.key !== " " || /** @type {Element} */ (event.target).closest?.("button, input")) return;
    event.preventDefault();
    setPlaying(!state.playing);
  });
  window.addEventListener("hashchange", () => {
    Object.assign(settings, readSettings(location.hash));
    sendAll();
  });
  document.addEventListener("visibilitychange", run); // a hidden page costs nothing
  window.addEventListener("message", ({ data }) => {
    // what <gaussian-swaying> says when its attributes change
    if (typeof data?.gaussianSwaying !== "string") return;
    Object.assign(settings, { ...USUAL, ...readSettings(data.gaussianSwaying), view: settings.view });
    sendAll();
  });

  // ---- pulling: the first finger that meets the object takes hold of it; all others move the camera

  const caster = new THREE.Raycaster();
  const pointers = new Map();

  function rayAt(event) {
    const { left, top, width, height } = canvas.getBoundingClientRect();
    const at = new THREE.Vector2(((event.clientX - left) / width) * 2 - 1, 1 - ((event.clientY - top) / height) * 2);
    caster.setFromCamera(at, camera);
    return caster.ray;
  }

  const metres = (/** @type {THREE.Vector3} */ place) => place.toArray().map((part) => part / head.metre);

  function pass(event) {
    controls.enabled = true;
    canvas.dispatchEvent(new PointerEvent("pointerdown", { ...pick(event), bubbles: true }));
  }

  const pick = ({ pointerId, pointerType, clientX, clientY, button, buttons, isPrimary }) =>
    ({ pointerId, pointerType, clientX, clientY, pageX: clientX, pageY: clientY, button, buttons, isPrimary });

  function letGo() {
    if (state.pull?.held) say({ kind: "release" });
    state.pull = null;
    controls.enabled = true;
  }

  canvas.addEventListener(
    "pointerdown",
    (event) => {
      if (!event.isTrusted) return;
      pointers.set(event.pointerId, event);
      if (state.pull) {
        const { event: first } = state.pull;
        letGo();
        pass(pointers.get(first.pointerId) ?? first);
        return;
      }
      if (event.button !== 0 || event.ctrlKey || event.shiftKey || pointers.size > 1 || !state.playing) return;
      event.stopImmediatePropagation();
      const { origin, direction } = rayAt(event);
      state.pull = { event, token: ++state.count, held: false };
      const wide = (PICKED * 2 * Math.tan((camera.fov * Math.PI) / 360)) / canvas.clientHeight;
      say({ kind: "grab", eye: metres(origin), ray: direction.toArray(), wide, token: state.count });
    },
    { capture: true },
  );

  function grabbed({ token, place }) {
    if (state.pull?.token !== token) return place && say({ kind: "release" });
    if (!place) {
      const { event } = state.pull;
      state.pull = null;
      return pass(pointers.get(event.pointerId) ?? event);
    }
    const at = new THREE.Vector3(...place).multiplyScalar(head.metre);
    state.pull.held = true;
    state.pull.plane = new THREE.Plane().setFromNormalAndCoplanarPoint(camera.getWorldDirection(new THREE.Vector3()), at);
    canvas.style.cursor = "grabbing";
    aim(pointers.get(state.pull.event.pointerId) ?? state.pull.event);
  }

  function aim(event) {
    const target = rayAt(event).intersectPlane(state.pull.plane, new THREE.Vector3());
    if (target) say({ kind: "aim", target: metres(target) });
  }

  canvas.addEventListener("pointermove", (event) => {
    if (pointers.has(event.pointerId)) pointers.set(event.pointerId, event);
    if (state.pull?.held && event.pointerId === state.pull.event.pointerId) aim(event);
  });
  for (const name of ["pointerup", "pointercancel"])
    window.addEventListener(name, (event) => {
      pointers.delete(/** @type {PointerEvent} */ (event).pointerId);
      if (state.pull?.event.pointerId !== /** @type {PointerEvent} */ (event).pointerId) return;
      letGo();
      canvas.style.cursor = "";
    });

  // ---- pictures

  const lately = { since: 0, pictures: 0, size: 0 };

  function tick(now) {
    playback.advance(now / 1000);
    const before = state.shown;
    state.shown = playback.shown;
    if (playback.newest !== null && (state.stale || before !== state.shown)) {
      state.stale = false;
      drawing.move((data) => playback.write(data));
    }
    const turn = azimuth();
    if (Math.abs(turn - dial.turn) > 1e-3) dial.show(dial.flow, turn);
    adapt(now);
  }

  // Fewer pixels where drawing is slow.
  function adapt(now) {
    lately.pictures++;
    if (now - lately.since < 1500) return;
    const rate = (1000 * lately.pictures) / (now - lately.since);
    Object.assign(lately, { since: now, pictures: 0 });
    if (!view.whole || document.hidden || rate > FEW || lately.size === PIXELS.length - 1) return;
    view.scale = PIXELS[++lately.size];
    view.resize();
  }

  showAll();
  const complete = view.begin(tick);
  complete.then(sendAll, (error) => {
    console.info(error.message);
    state.message = error.message;
    tell(error.message);
    sendAll();
  });

  window.windPage = {
    head,
    settings,
    complete,
    link,
    drawn: () => view.drawn,
    first: () => view.first,
    time: () => playback.newest,
    rate: () => state.rate,
    solver: () => state.solver, // webgpu, webassembly or javascript
    why: () => state.why, // it is not WebGPU
    // As if the graphics card were lost.
    lose: () => say({ kind: "lose" }),
    playing: () => state.playing,
    pulled: () => state.pull?.held ?? false,
    pause: () => setPlaying(false),
    play: () => setPlaying(true),
    reset,
    // Advance by some frames at once, without the clock; resolves with how long that took.
    advance: (count, hurried = false) =>
      new Promise((resolve) => {
        answers.push(resolve);
        say({ kind: "frames", count, hurried });
      }),
    // Centres of the Gaussians as drawn for the newest state.
    positions: () => {
      playback.shown = playback.newest;
      state.stale = true;
      view.wake(3);
      return view.positions();
    },
  };
  await start;
}
