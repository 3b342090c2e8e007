// A film of Gaussians: splats once, the displacement of grid nodes per frame. See docs/web.md.
import { dyno, SparkRenderer, SplatGenerator } from "@sparkjsdev/spark";
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { FUNCTIONS, STATEMENTS } from "./film.glsl.js";
import { makeSorter } from "./sorter.js";

const WIDTH = 2048; // of the textures with a texel for each Gaussian or node

// ---- the parts of the file, see gaussian_swaying/viewer/film/page.py

function reader(bytes) {
  let at = 0;
  return (Kind, count) => {
    const size = Kind.BYTES_PER_ELEMENT;
    const out = new Uint8Array(count * size);
    for (let plane = 0; plane < size; plane++)
      for (let i = 0; i < count; i++) out[i * size + plane] = bytes[at++];
    return new Kind(out.buffer);
  };
}

function readFrames(bytes, frames, row) {
  const all = reader(bytes)(Uint16Array, frames * row);
  for (let i = row; i < all.length; i++) all[i] += all[i - row]; // differences to the frame before
  return all;
}

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

function readSplats(bytes, count) {
  const next = reader(bytes);
  return {
    position: next(Float32Array, 3 * count),
    place: next(Float32Array, 3 * count),
    scale: next(Uint16Array, 3 * count),
    turn: next(Int16Array, 4 * count),
    facing: next(Int16Array, 4 * count),
    color: next(Uint8Array, 4 * count),
  };
}

// ---- textures

function texture(Kind, count, type, fill) {
  const height = Math.max(1, Math.ceil(count / WIDTH));
  const data = new Kind(WIDTH * height * 4);
  for (let i = 0; i < count; i++) fill(data, 4 * i, i);
  const made = new THREE.DataTexture(data, WIDTH, height, THREE.RGBAFormat, type);
  made.needsUpdate = true;
  return made;
}

// Row of each node of the grid in the list of recorded nodes.
function rowsTexture(nodes, [nx, ny, nz]) {
  const data = new Uint32Array(nx * ny * nz);
  nodes.forEach((node, row) => (data[node] = row));
  const made = new THREE.DataArrayTexture(data, nz, ny, nx);
  made.format = THREE.RedIntegerFormat;
  made.type = THREE.UnsignedIntType;
  made.internalFormat = "R32UI";
  made.needsUpdate = true;
  return made;
}

// The covariance of Gaussian i, row by row: xx xy xz yy yz zz.
function covariance(splats, i) {
  const [w, x, y, z] = [0, 1, 2, 3].map((k) => splats.turn[4 * i + k] / 32767);
  const s = [0, 1, 2].map((k) => Math.exp(2 * THREE.DataUtils.fromHalfFloat(splats.scale[3 * i + k])));
  const n = 1 / (w * w + x * x + y * y + z * z);
  const R = [
    [1 - 2 * n * (y * y + z * z), 2 * n * (x * y - w * z), 2 * n * (x * z + w * y)],
    [2 * n * (x * y + w * z), 1 - 2 * n * (x * x + z * z), 2 * n * (y * z - w * x)],
    [2 * n * (x * z - w * y), 2 * n * (y * z + w * x), 1 - 2 * n * (x * x + y * y)],
  ];
  const term = (a, b) => R[a][0] * R[b][0] * s[0] + R[a][1] * R[b][1] * s[1] + R[a][2] * R[b][2] * s[2];
  return [term(0, 0), term(0, 1), term(0, 2), term(1, 1), term(1, 2), term(2, 2)];
}

// ---- the Gaussians in the shader graph of Spark

function makeGaussians(head, splats, nodes) {
  const { count } = head;
  const shapes = Array.from({ length: count }, (_, i) => covariance(splats, i));
  const float = THREE.FloatType;
  const moved = texture(Float32Array, nodes.length + 2, float, () => {});
  const own = {
    rest: texture(Float32Array, count, float, (out, at, i) => {
      out.set(splats.position.subarray(3 * i, 3 * i + 3), at);
      out[at + 3] = splats.color[4 * i + 3] / 255;
    }),
    place: texture(Float32Array, count, float, (out, at, i) => out.set(splats.place.subarray(3 * i, 3 * i + 3), at)),
    shapeA: texture(Float32Array, count, float, (out, at, i) => out.set(shapes[i].slice(0, 4), at)),
    shapeB: texture(Float32Array, count, float, (out, at, i) => out.set(shapes[i].slice(4), at)),
    facing: texture(Float32Array, count, float, (out, at, i) => {
      for (let k = 0; k < 4; k++) out[at + k] = splats.facing[4 * i + k] / 32767;
    }),
    color: texture(Uint8Array, count, THREE.UnsignedByteType, (out, at, i) =>
      out.set(splats.color.subarray(4 * i, 4 * i + 4), at),
    ),
    moved,
  };
  const shader = head.shader ?? { light: [0, 0, 1], two_sided: false, ambient: 0, relative: false };
  const kind = [shader.two_sided, shader.ambient, shader.relative, head.shader !== null].map(Number);
  const inputs = {
    rows: new dyno.DynoUsampler2DArray({ value: rowsTexture(nodes, head.resolution) }),
    cell: new dyno.DynoFloat({ value: head.cell }),
    metre: new dyno.DynoFloat({ value: head.metre }),
    corner: new dyno.DynoVec3({ value: new THREE.Vector3(...head.corner) }),
    limit: new dyno.DynoFloat({ value: head.max_stretch === null ? 1e30 : head.max_stretch ** 2 - 1 }),
    light: new dyno.DynoVec3({ value: new THREE.Vector3(...shader.light) }),
    kind: new dyno.DynoVec4({ value: new THREE.Vector4(...kind) }),
  };
  for (const name in own) inputs[name] = new dyno.DynoSampler2D({ value: own[name] });
  const inTypes = { index: "int", rows: "usampler2DArray", cell: "float", metre: "float", corner: "vec3", limit: "float" };
  Object.assign(inTypes, { light: "vec3", kind: "vec4" });
  for (const name in own) inTypes[name] = "sampler2D";
  const covGenerator = dyno.dynoBlock({ index: "int" }, { covsplat: dyno.CovSplat }, ({ index }) => {
    const step = new dyno.Dyno({
      inTypes,
      outTypes: { covsplat: dyno.CovSplat },
      globals: () => [dyno.defineGsplat, dyno.defineCovSplat, FUNCTIONS],
      inputs: { index, ...inputs },
      statements: STATEMENTS,
    });
    return { covsplat: step.outputs.covsplat };
  });
  return { gaussians: new SplatGenerator({ numSplats: count, covGenerator }), moved };
}

// How far the moving Gaussians reach to the left and right of the first view, as a tangent.
function reach(head, splats) {
  const eye = new THREE.Vector3(...head.camera.eye);
  const axis = new THREE.Vector3(...head.camera.target).sub(eye).normalize();
  const right = new THREE.Vector3().crossVectors(axis, new THREE.Vector3(0, 0, 1)).normalize();
  const ray = new THREE.Vector3();
  let most = 0;
  for (let i = 0; i < 3 * head.count; i += 3) {
    ray.fromArray(splats.position, i).sub(eye);
    const depth = ray.dot(axis);
    if (splats.place[i] >= 0 && depth > 0) most = Math.max(most, Math.abs(ray.dot(right)) / depth);
  }
  return most;
}

// ---- the page

export async function play(read) {
  const head = JSON.parse(new TextDecoder().decode(await read("head")));
  const splats = readSplats(await read("splats"), head.count);
  const nodes = reader(await read("nodes"))(Uint32Array, head.nodes);
  const frames = readFrames(await read("frames"), head.frames, 3 * head.nodes);
  const far = readFar(await read("far"), head.frames);
  const halves = Float32Array.from({ length: 65536 }, (_, bits) => THREE.DataUtils.fromHalfFloat(bits));
  const element = (name) => document.getElementById(name);

  const canvas = element("canvas");
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
  renderer.setClearColor(new THREE.Color().setRGB(...head.background, THREE.SRGBColorSpace));
  const scene = new THREE.Scene();
  const spark = new SparkRenderer({
    renderer,
    accumExtSplats: true,
    covSplats: true,
    preBlurAmount: 0.3, // as our renderers: added to the projected covariance, without changing the opacity
    blurAmount: 0.0,
    maxStdDev: 3.0,
    sortRadial: false,
    enableLod: false,
    onDirty: () => wake(1),
  });
  spark.sortWorker = makeSorter();
  const { gaussians, moved } = makeGaussians(head, splats, nodes);
  scene.add(spark, gaussians);

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

  const state = { frame: -1, time: 0, playing: true, last: null, left: 3, drawn: 0 };
  const slider = element("time");
  const button = element("play");
  const loop = element("loop");
  slider.max = String(head.frames - 1);

  const wanted = reach(head, splats) + 0.3 / camera.position.distanceTo(controls.target); // and room to swing

  function wake(pictures) {
    state.left = Math.max(state.left, pictures);
  }

  function show(frame) {
    if (frame === state.frame) return;
    const row = 3 * head.nodes;
    const from = frames.subarray(frame * row, (frame + 1) * row);
    const data = moved.image.data;
    for (let i = 0, at = 0; i < row; i += 3, at += 4) {
      data[at] = halves[from[i]];
      data[at + 1] = halves[from[i + 1]];
      data[at + 2] = halves[from[i + 2]];
    }
    const { rows, values } = far[frame];
    for (let i = 0; i < rows.length; i += 4) data.set(values.subarray(i + 1, i + 4), 4 * rows[i]);
    moved.needsUpdate = true;
    gaussians.updateVersion();
    state.frame = frame;
    slider.value = String(frame);
    const seconds = (count) => (count * head.frame_dt).toFixed(2);
    element("clock").textContent = `${seconds(frame)} / ${seconds(head.frames - 1)} s`;
    wake(3); // Spark draws what it computed for the picture before
  }

  function seek(frame) {
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
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
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
    if (state.playing && spark.activeSplats > 0) {
      const end = head.frames * head.frame_dt;
      state.time += state.last === null ? 0 : Math.min(now - state.last, 250) / 1000;
      state.last = now;
      if (state.time >= end && loop.getAttribute("aria-pressed") !== "true") {
        seek(head.frames - 1);
        setPlaying(false);
      } else {
        state.time %= end;
        show(Math.min(Math.floor(state.time / head.frame_dt), head.frames - 1));
      }
    }
    controls.update();
    if (spark.activeSplats === 0) wake(1);
    if (state.left > 0) {
      state.left--;
      renderer.render(scene, camera);
      state.drawn++;
    }
  }

  resize();
  show(0);
  setPlaying(true);
  renderer.setAnimationLoop(tick);

  // Centres of the Gaussians as the GPU computed them for the picture, in units of the object's size.
  async function positions() {
    await settled();
    const gl = renderer.getContext();
    const { target } = spark.display;
    const layer = target.width * target.height;
    const made = renderer.properties.get(target.textures[0]).__webglTexture;
    const out = new Float32Array(3 * head.count);
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, buffer);
    for (let base = 0; base < head.count; base += layer) {
      gl.framebufferTextureLayer(gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, made, 0, base / layer);
      const height = Math.ceil(Math.min(layer, head.count - base) / target.width);
      const words = new Uint32Array(4 * target.width * height);
      gl.readPixels(0, 0, target.width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
      const values = new Float32Array(words.buffer);
      for (let i = 0; i < Math.min(layer, head.count - base); i++)
        out.set(values.subarray(4 * i, 4 * i + 3), 3 * (base + i));
    }
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, null);
    gl.deleteFramebuffer(buffer);
    renderer.resetState();
    return out;
  }

  // Indices of depths in the order in which they would be drawn.
  async function order(depths) {
    const readback = new Uint32Array(Float32Array.from(depths).buffer);
    const call = { numSplats: depths.length, readback, ordering: new Uint32Array(depths.length) };
    const { activeSplats, ordering } = await spark.sortWorker.call("sortSplats32", call);
    return ordering.subarray(0, activeSplats);
  }

  // Resolves once the Gaussians are sorted and nothing is left to draw.
  async function settled() {
    const rest = () => spark.activeSplats > 0 && state.left === 0 && !spark.sorting && !spark.sortDirty;
    for (let calm = 0; calm < 3; calm = rest() ? calm + 1 : 0)
      await new Promise((resolve) => requestAnimationFrame(resolve));
  }

  window.film = {
    head,
    frame: () => state.frame,
    drawn: () => state.drawn,
    pause: () => setPlaying(false),
    play: () => setPlaying(true),
    seek: async (frame) => {
      setPlaying(false);
      seek(frame);
      await settled();
    },
    positions,
    order,
  };
}

window.playFilm = play;
