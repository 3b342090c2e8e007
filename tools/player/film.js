// A film of Gaussians: splats once, the displacement of grid nodes per frame. See docs/web.md.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Drawing, halves, reader } from "./gaussians.js";

// ---- the parts of the file, see gaussian_swaying/viewer/film/page.py

// The few nodes of each frame that swing far: index and displacement.
function readFar(bytes, frames) {
  const counts = reader(bytes.subarray(0, 4 * frames))(Uint32Array, frames);
  const rows = reader(bytes.subarray(4 * frames))(Int32Array, (bytes.length - 4 * frames) / 4);
  const values = new Float32Array(rows.buffer);
  let at = 0;
  return Array.from(counts, (count) => {
    const begin = at;
    at += 4 * count;
    return { rows: rows.subarray(begin, at), values: values.subarray(begin, at) };
  });
}

// The displacements of a film, which come in parts of some frames.
class Frames {
  constructor({ frames, nodes }) {
    this.row = 3 * nodes;
    this.near = new Uint16Array(frames * this.row);
    this.far = [];
  }

  get loaded() {
    return this.far.length;
  }

  add(bytes, count) {
    const begin = this.loaded * this.row;
    const end = begin + count * this.row;
    const size = 2 * (end - begin);
    this.near.set(reader(bytes.subarray(0, size))(Uint16Array, end - begin), begin);
    for (let i = Math.max(begin, this.row); i < end; i++) this.near[i] += this.near[i - this.row]; // differences to the frame before
    this.far.push(...readFar(bytes.subarray(size), count));
  }
}

// How far the moving Gaussians reach to the left and right of the first view, as a tangent.
function reach(head, layer) {
  const eye = new THREE.Vector3(...head.camera.eye);
  const axis = new THREE.Vector3(...head.camera.target).sub(eye).normalize();
  const right = new THREE.Vector3().crossVectors(axis, new THREE.Vector3(0, 0, 1)).normalize();
  const ray = new THREE.Vector3();
  let most = 0;
  const places = new Float32Array(layer.textures.rest.image.data.buffer);
  for (let i = 0; i < 4 * layer.loaded; i += 4) {
    ray.fromArray(places, i).sub(eye);
    const depth = ray.dot(axis);
    if (depth > 0) most = Math.max(most, Math.abs(ray.dot(right)) / depth);
  }
  return most;
}

// ---- the page

const COARSE = 1 / 4; // of the window's pixels along each side, until all Gaussians have come

// `read(name)` gives a part of the file once it is there; `tell(sentence)` is called if the file ends too early.
export async function play(read, tell) {
  const head = JSON.parse(new TextDecoder().decode(await read("head")));
  const stencils = reader(await read("stencils"))(Uint32Array, 27 * head.stencils);
  const frames = new Frames(head);
  const element = (name) => document.getElementById(name);

  const state = { frame: -1, time: 0, playing: true, last: null, left: 3, drawn: 0, first: null, fence: null, whole: head.parts.length === head.start };
  const canvas = element("canvas");
  const drawing = new Drawing(canvas, (pictures) => wake(pictures));
  const { renderer } = drawing;
  drawing.show(head, stencils);

  async function take(index) {
    const [kind, first, last] = head.parts[index];
    const bytes = await read(`part-${index}`);
    if (kind === "frames") frames.add(bytes, last - first);
    else drawing.add(kind, bytes);
  }

  for (let index = 0; index < head.start; index++) await take(index);

  const camera = new THREE.PerspectiveCamera(head.camera.fov, 1, 0.01, 200);
  camera.up.set(0, 0, 1);
  camera.position.set(...head.camera.eye);
  const controls = new OrbitControls(camera, canvas);
  controls.target.set(...head.camera.target);
  controls.enableDamping = true;
  controls.minDistance = 0.1;
  controls.maxDistance = 20;
  controls.addEventListener("change", () => wake(3));
  controls.update();

  const slider = element("time");
  const button = element("play");
  const loop = element("loop");
  slider.max = String(head.frames - 1);

  const wanted = reach(head, drawing.layers.moving) + 0.3 / camera.position.distanceTo(controls.target); // and room to swing

  function wake(pictures) {
    state.left = Math.max(state.left, pictures);
  }

  function show(frame) {
    if (frame === state.frame) return;
    const { row } = frames;
    const from = frames.near.subarray(frame * row, (frame + 1) * row);
    const { rows, values } = frames.far[frame];
    drawing.move((data) => {
      for (let i = 0, at = 0; i < row; i += 3, at += 4) {
        data[at] = halves[from[i]];
        data[at + 1] = halves[from[i + 1]];
        data[at + 2] = halves[from[i + 2]];
      }
      for (let i = 0; i < rows.length; i += 4) data.set(values.subarray(i + 1, i + 4), 4 * rows[i]);
    });
    state.frame = frame;
    slider.value = String(frame);
    const seconds = (count) => (count * head.frame_dt).toFixed(2);
    element("clock").textContent = `${seconds(frame)} / ${seconds(head.frames - 1)} s`;
  }

  // Show a frame, or the last one that has come so far.
  function seek(wanted) {
    const frame = Math.min(wanted, frames.loaded - 1);
    state.time = frame * head.frame_dt;
    show(frame);
  }

  function setPlaying(on) {
    if (on && state.frame === head.frames - 1) seek(0);
    state.playing = on;
    state.last = null;
    button.textContent = on ? "❚❚" : "▶";
    button.setAttribute("aria-label", on ? "Pause" : "Play");
  }

  function resize() {
    const [width, height] = [window.innerWidth, window.innerHeight];
    drawing.rough(!state.whole);
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2) * (state.whole ? 1 : COARSE));
    renderer.setSize(width, height);
    const upright = Math.tan((head.camera.fov * Math.PI) / 360);
    const across = Math.min(upright * head.camera.aspect, wanted); // what a narrow window still shows
    camera.aspect = width / height;
    const half = Math.max(across / camera.aspect, upright);
    camera.fov = (2 * Math.atan(half) * 180) / Math.PI;
    camera.updateProjectionMatrix();
    wake(3);
  }

  slider.addEventListener("input", () => {
    setPlaying(false);
    seek(Number(slider.value));
  });
  button.addEventListener("click", () => setPlaying(!state.playing));
  loop.addEventListener("click", () =>
    loop.setAttribute("aria-pressed", String(loop.getAttribute("aria-pressed") !== "true")),
  );
  window.addEventListener("keydown", (event) => {
    if (event.key === " " && event.target !== button && event.target !== loop) {
      event.preventDefault();
      setPlaying(!state.playing);
    }
  });
  window.addEventListener("resize", resize);

  function tick(now) {
    if (state.playing && state.first !== null) {
      const end = head.frames * head.frame_dt;
      state.time += state.last === null ? 0 : Math.min(now - state.last, 250) / 1000;
      state.last = now;
      if (frames.loaded < head.frames) state.time = Math.min(state.time, (frames.loaded - 1) * head.frame_dt);
      if (state.time >= end && loop.getAttribute("aria-pressed") !== "true") {
        seek(head.frames - 1);
        setPlaying(false);
      } else {
        state.time %= end;
        show(Math.min(Math.floor(state.time / head.frame_dt + 1e-6), frames.loaded - 1));
      }
    }
    controls.update();
    if (!drawing.ready) wake(1);
    if (state.left > 0) {
      state.left--;
      drawing.render(camera);
      state.drawn++;
    }
    timeFirst();
  }

  // When the graphics card had finished the first picture with Gaussians [s after the page was asked for].
  function timeFirst() {
    const gl = renderer.getContext();
    if (state.first !== null || !drawing.ready) return;
    if (state.fence === null) {
      state.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
      gl.flush();
    } else if (gl.getSyncParameter(state.fence, gl.SYNC_STATUS) === gl.SIGNALED) state.first = performance.now() / 1000;
  }

  // The rest of the file after the first picture, with time for others in between.
  async function takeRest() {
    while (state.first === null && !document.hidden) await new Promise((resolve) => setTimeout(resolve, 4));
    drawing.follow();
    for (let index = head.start; index < head.parts.length; index++) {
      await take(index);
      await new Promise((resolve) => setTimeout(resolve));
    }
    state.whole = true;
    resize();
  }

  resize();
  show(0);
  drawing.begin(camera);
  setPlaying(true);
  renderer.setAnimationLoop(tick);
  const complete = takeRest();
  complete.catch((error) => {
    console.info(error.message);
    tell(error.message);
    state.whole = true;
    resize();
  });

  // See Drawing.positions.
  async function positions() {
    await settled();
    return drawing.positions();
  }

  // Indices of depths in the order in which they would be drawn.
  async function order(depths) {
    const readback = new Uint32Array(Float32Array.from(depths).buffer);
    const call = { numSplats: depths.length, readback, ordering: new Uint32Array(depths.length) };
    const { activeSplats, ordering } = await drawing.spark.sortWorker.call("sortSplats32", call);
    return ordering.subarray(0, activeSplats);
  }

  // Resolves once all Gaussians have come and are sorted, and nothing is left to draw.
  async function settled() {
    await complete;
    const rest = () => state.left === 0 && drawing.sorted;
    for (let calm = 0; calm < 3; calm = rest() ? calm + 1 : 0)
      await new Promise((resolve) => requestAnimationFrame(resolve));
  }

  window.film = {
    head,
    frame: () => state.frame,
    drawn: () => state.drawn,
    first: () => state.first,
    complete,
    pause: () => setPlaying(false),
    play: () => setPlaying(true),
    seek: async (frame) => {
      setPlaying(false);
      await complete;
      seek(frame);
      await settled();
    },
    positions,
    order,
  };
}
