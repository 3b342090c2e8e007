// Gaussians on a canvas that follow the nodes of a grid, as films and the live page draw them. See docs/web.md.
import { dyno, SparkRenderer, SplatGenerator } from "@sparkjsdev/spark";
import * as THREE from "three";
import { FUNCTIONS, STATEMENTS } from "./film.glsl.js";
import { makeSorter } from "./sorter.js";

const WIDTH = 2048; // of the textures with a texel for each Gaussian or node

// ---- the parts of the file, see gaussian_swaying/viewer/film/page.py

export function reader(bytes) {
  let at = 0;
  return (Kind, count) => {
    const size = Kind.BYTES_PER_ELEMENT;
    const out = new Uint8Array(count * size);
    for (let plane = 0; plane < size; plane++)
      for (let i = 0; i < count; i++) out[i * size + plane] = bytes[at++];
    return new Kind(out.buffer);
  };
}

// The numbers of float16, by their bits.
export const halves = Float32Array.from({ length: 65536 }, (_, bits) => THREE.DataUtils.fromHalfFloat(bits));

export function readSplats(bytes, count) {
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
  const rows = rowsTexture(nodes, head.resolution);
  const inputs = {
    rows: new dyno.DynoUsampler2DArray({ value: rows }),
    cell: new dyno.DynoFloat({ value: head.cell }),
    metre: new dyno.DynoFloat({ value: head.metre }),
    corner: new dyno.DynoVec3({ value: new THREE.Vector3(...head.corner) }),
    limit: new dyno.DynoFloat({ value: head.max_stretch === null ? 1e30 : head.max_stretch ** 2 - 1 }),
    light: new dyno.DynoVec3({ value: new THREE.Vector3() }),
    kind: new dyno.DynoVec4({ value: new THREE.Vector4() }),
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
  const textures = [rows, ...Object.values(own)];
  const { color } = own;
  return { gaussians: new SplatGenerator({ numSplats: count, covGenerator }), moved, color, inputs, textures };
}

// ---- the canvas

export class Drawing {
  // `wake(pictures)` is called when so many pictures have to be drawn.
  constructor(canvas, wake) {
    this.wake = wake;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
    this.scene = new THREE.Scene();
    this.spark = null;
  }

  // Draw these Gaussians from now on. Throws an Error if they are too many for this browser.
  show(head, splats, nodes) {
    const { maxTextureSize } = this.renderer.capabilities;
    const layers = this.renderer.getContext().getParameter(WebGL2RenderingContext.MAX_ARRAY_TEXTURE_LAYERS);
    const height = Math.ceil(Math.max(head.count, nodes.length + 2) / WIDTH);
    if (head.resolution[0] > layers || Math.max(height, ...head.resolution) > maxTextureSize)
      throw new Error("the scene is too large for the textures of this browser");
    this.clear();
    const { renderer } = this;
    this.spark = new SparkRenderer({
      renderer,
      accumExtSplats: true,
      covSplats: true,
      preBlurAmount: 0.3, // as our renderers: added to the projected covariance, without changing the opacity
      blurAmount: 0.0,
      maxStdDev: 3.0,
      sortRadial: false,
      enableLod: false,
      onDirty: () => this.wake(1),
    });
    this.spark.sortWorker = makeSorter();
    this.count = head.count;
    Object.assign(this, makeGaussians(head, splats, nodes));
    this.light(head);
    this.scene.add(this.spark, this.gaussians);
  }

  // Give up the Gaussians that are drawn.
  clear() {
    if (this.spark === null) return;
    this.scene.clear();
    this.spark.readbackDepth = () => new Promise(() => {}); // a sort that has begun, or waits for its turn, ends here
    this.spark.dispose();
    for (const made of this.textures) made.dispose();
    this.spark = null;
  }

  // Light and background, as in the head.
  light({ shader, background }) {
    const { light, two_sided, ambient, relative } = shader ?? { light: [0, 0, 1] };
    this.inputs.light.value.set(...light);
    this.inputs.kind.value.set(...[two_sided, ambient, relative, shader !== null].map((value) => Number(value ?? 0)));
    this.renderer.setClearColor(new THREE.Color().setRGB(...background, THREE.SRGBColorSpace));
    this.changed();
  }

  // Move the nodes: `fill` writes their displacements, four numbers each.
  move(fill) {
    fill(this.moved.image.data);
    this.moved.needsUpdate = true;
    this.changed();
  }

  // Give some Gaussians other colours: their indices, and three bytes each.
  recolour(indices, colours) {
    const { data } = this.color.image;
    indices.forEach((i, k) => data.set(colours.subarray(3 * k, 3 * k + 3), 4 * i));
    this.color.needsUpdate = true;
    this.changed();
  }

  changed() {
    this.gaussians.updateVersion();
    this.wake(3); // Spark draws what it computed for the picture before
  }

  get ready() {
    return this.spark !== null && this.spark.activeSplats > 0;
  }

  // True if nothing is being sorted.
  get sorted() {
    return this.ready && !this.spark.sorting && !this.spark.sortDirty;
  }

  render(camera) {
    this.renderer.render(this.scene, camera);
  }

  // Centres of the Gaussians as the GPU computed them for the picture, in units of the object's size.
  positions() {
    const { renderer, count } = this;
    const gl = renderer.getContext();
    const { target } = this.spark.display;
    const layer = target.width * target.height;
    const made = renderer.properties.get(target.textures[0]).__webglTexture;
    const out = new Float32Array(3 * count);
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, buffer);
    for (let base = 0; base < count; base += layer) {
      gl.framebufferTextureLayer(gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, made, 0, base / layer);
      const height = Math.ceil(Math.min(layer, count - base) / target.width);
      const words = new Uint32Array(4 * target.width * height);
      gl.readPixels(0, 0, target.width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
      const values = new Float32Array(words.buffer);
      for (let i = 0; i < Math.min(layer, count - base); i++)
        out.set(values.subarray(4 * i, 4 * i + 3), 3 * (base + i));
    }
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, null);
    gl.deleteFramebuffer(buffer);
    renderer.resetState();
    return out;
  }
}
