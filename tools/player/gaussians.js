// Gaussians on a canvas that follow the nodes of a grid, as films and the live page draw them. See docs/web.md.
import { dyno, SparkRenderer, SplatGenerator } from "@sparkjsdev/spark";
import * as THREE from "three";
import { fill, lightOf, limitOf, rowsOf, TEXELS, texels, WIDTH } from "./bundle.js";
import { FUNCTIONS, MOVING, REST } from "./film.glsl.js";
import { makeSorter } from "./sorter.js";

// Four numbers for each Gaussian, or node.
function texture(data) {
  const whole = data instanceof Uint32Array;
  const [format, type] = whole ? [THREE.RGBAIntegerFormat, THREE.UnsignedIntType] : [THREE.RGBAFormat, THREE.FloatType];
  const made = new THREE.DataTexture(data, WIDTH, data.length / (4 * WIDTH), format, type);
  if (whole) made.internalFormat = "RGBA32UI";
  made.needsUpdate = true;
  return made;
}

// ---- the Gaussians in the shader graph of Spark

const COVSPLAT = (i, o) => `
  ${o.covsplat}.center = center;
  ${o.covsplat}.flags = GSPLAT_FLAG_ACTIVE;
  ${o.covsplat}.rgba = vec4(color, rgba.a);
  ${o.covsplat}.index = ${i.index};
  ${o.covsplat}.xxyyzz = vec3(A[0][0], A[1][1], A[2][2]);
  ${o.covsplat}.xyxzyz = vec3(A[0][1], A[0][2], A[1][2]);
`;

// The Gaussians of one kind: all those that move, or all others. They come in parts, the first ones spread over the whole
// scene. Until all are there, each is larger, so that they cover as much as all of them.
class Layer {
  constructor(kind, count, shared) {
    this.kind = kind;
    this.count = count;
    this.loaded = 0;
    this.textures = {};
    this.inputs = { ...shared, grown: new dyno.DynoFloat({ value: 1 }) };
    for (const name in TEXELS[kind]) {
      this.textures[name] = texture(texels(count));
      this.inputs[name] = new dyno.DynoUsampler2D({ value: this.textures[name] });
    }
    this.group = new THREE.Group();
    this.draw("still");
  }

  // Draw them as "moving", or as "still", which has a shorter shader.
  draw(as) {
    const { grown, rest, shape } = this.inputs;
    const inputs = as === "still" ? { grown, rest, shape } : this.inputs;
    const inTypes = { index: "int" };
    for (const name in inputs) inTypes[name] = inputs[name].type;
    const covGenerator = dyno.dynoBlock({ index: "int" }, { covsplat: dyno.CovSplat }, ({ index }) => {
      const step = new dyno.Dyno({
        inTypes,
        outTypes: { covsplat: dyno.CovSplat },
        globals: () => [dyno.defineGsplat, dyno.defineCovSplat, FUNCTIONS],
        inputs: { index, ...inputs },
        statements: ({ inputs, outputs }) => `${REST(inputs)}${as === "still" ? "" : MOVING(inputs)}${COVSPLAT(inputs, outputs)}`.split("\n"),
      });
      return { covsplat: step.outputs.covsplat };
    });
    this.generator = new SplatGenerator({ numSplats: this.loaded, covGenerator });
    this.group.clear();
    this.group.add(this.generator);
  }

  // Add the next Gaussians, see pack_splats in page.py.
  add(bytes) {
    const count = fill(this.kind, bytes, this.loaded, (name) => this.textures[name].image.data);
    for (const made of Object.values(this.textures)) {
      for (let row = Math.floor(this.loaded / WIDTH); row * WIDTH < this.loaded + count; row++)
        made.addUpdateRange(4 * WIDTH * row, 4 * WIDTH);
      made.needsUpdate = true;
    }
    this.loaded += count;
    this.generator.numSplats = this.loaded;
    this.inputs.grown.value = Math.sqrt(this.count / this.loaded);
    this.generator.updateVersion();
  }

  // Red, green and blue of Gaussian i, as bytes.
  recolour(i, colour) {
    const { rest } = this.textures;
    new Uint8Array(rest.image.data.buffer).set(colour, 16 * i + 12);
    rest.addUpdateRange(4 * WIDTH * Math.floor(i / WIDTH), 4 * WIDTH);
    rest.needsUpdate = true;
  }

  dispose() {
    for (const name in this.textures) this.textures[name].dispose();
  }
}

// All Gaussians of a film or a scene, in units of the object's size with z up; `group` goes into a scene that Spark draws.
export class Splat {
  constructor(head, stencils) {
    this.count = head.count;
    this.moved = texture(texels(head.nodes, Float32Array));
    this.rows = texture(rowsOf(stencils));
    this.inputs = {
      rows: new dyno.DynoUsampler2D({ value: this.rows }),
      moved: new dyno.DynoSampler2D({ value: this.moved }),
      cell: new dyno.DynoFloat({ value: head.cell }),
      metre: new dyno.DynoFloat({ value: head.metre }),
      corner: new dyno.DynoVec3({ value: new THREE.Vector3(...head.corner) }),
      limit: new dyno.DynoFloat({ value: limitOf(head) }),
      light: new dyno.DynoVec3({ value: new THREE.Vector3() }),
      kind: new dyno.DynoVec4({ value: new THREE.Vector4() }),
    };
    this.layers = {
      moving: new Layer("moving", head.moving, this.inputs),
      still: new Layer("still", head.count - head.moving, {}),
    };
    this.group = new THREE.Group();
    this.group.add(this.layers.moving.group, this.layers.still.group);
    this.light(head);
  }

  // Add the next Gaussians that are "moving", or "still".
  add(kind, bytes) {
    if (bytes.length > 0) this.layers[kind].add(bytes);
  }

  // From now on they follow the nodes; until then all are at rest, so that the first picture needs no long shader.
  follow() {
    this.layers.moving.draw("moving");
    this.changed();
  }

  // Light, as in the head.
  light(head) {
    const { light, kind } = lightOf(head);
    this.inputs.light.value.set(...light);
    this.inputs.kind.value.set(...kind);
    this.changed();
  }

  // Move the nodes: `fill` writes their displacements, four numbers each.
  move(fill) {
    fill(this.moved.image.data);
    this.moved.needsUpdate = true;
    this.changed();
  }

  // Give some Gaussians other colours: their places, those that move first, and three bytes each.
  recolour(places, colours) {
    const { moving, still } = this.layers;
    places.forEach((place, k) => {
      const [layer, i] = place < moving.count ? [moving, place] : [still, place - moving.count];
      layer.recolour(i, colours.subarray(3 * k, 3 * k + 3));
    });
    still.generator.updateVersion();
    this.changed();
  }

  changed() {
    this.layers.moving.generator.updateVersion();
  }

  dispose() {
    for (const made of [this.rows, this.moved, this.layers.moving, this.layers.still]) made.dispose();
  }
}

// ---- the canvas

export class Drawing {
  // `wake(pictures)` is called when so many pictures have to be drawn.
  constructor(canvas, wake) {
    this.wake = wake;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
    this.renderer.debug.checkShaderErrors = false; // asking for them waits
    this.scene = new THREE.Scene();
    this.spark = this.splat = null;
  }

  // Draw other Gaussians from now on, once they are added. Throws an Error if they are too many for this browser.
  show(head, stencils) {
    const height = Math.ceil(Math.max(head.count, head.nodes, stencils.length / 3) / WIDTH);
    if (height > this.renderer.capabilities.maxTextureSize)
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
    this.splat = new Splat(head, stencils);
    this.scene.add(this.spark, this.splat.group);
    this.light(head);
  }

  // As those of Splat; Spark draws what it computed for the picture before.
  add(kind, bytes) {
    this.splat.add(kind, bytes);
    this.wake(3);
  }

  follow() {
    this.splat.follow();
    this.wake(3);
  }

  move(fill) {
    this.splat.move(fill);
    this.wake(3);
  }

  recolour(places, colours) {
    this.splat.recolour(places, colours);
    this.wake(3);
  }

  // Light and background, as in the head.
  light(head) {
    this.splat.light(head);
    this.renderer.setClearColor(new THREE.Color().setRGB(...head.background, THREE.SRGBColorSpace));
    this.wake(3);
  }

  // Compute and sort what has come, while the shaders of the picture are compiled; the next picture shows it.
  begin(camera) {
    camera.updateMatrixWorld();
    this.spark.update({ scene: this.scene, camera });
    this.render(camera);
  }

  // Leave out the faint rims of Gaussians, which cost most, or not.
  rough(on) {
    if (this.spark) this.spark.maxStdDev = on ? Math.sqrt(6) : 3;
  }

  // Give up the Gaussians that are drawn.
  clear() {
    if (this.spark === null) return;
    this.scene.clear();
    this.spark.readbackDepth = () => new Promise(() => {}); // a sort that has begun, or waits for its turn, ends here
    this.spark.dispose();
    this.splat.dispose();
    this.spark = null;
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

  // See positionsOf.
  positions() {
    return positionsOf(this.renderer, this.spark, this.splat.count);
  }
}

// Centres of the Gaussians as the GPU computed them for the picture, those that move first, in units of the object's size.
export function positionsOf(renderer, spark, count) {
  const gl = renderer.getContext();
  const { target, mapping } = spark.display;
  const layer = target.width * target.height;
  const made = renderer.properties.get(target.textures[0]).__webglTexture;
  const all = new Float32Array(3 * layer * target.depth);
  const buffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, buffer);
  for (let k = 0; k < target.depth; k++) {
    gl.framebufferTextureLayer(gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, made, 0, k);
    const words = new Uint32Array(4 * layer);
    gl.readPixels(0, 0, target.width, target.height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
    const values = new Float32Array(words.buffer);
    for (let i = 0; i < layer; i++) all.set(values.subarray(4 * i, 4 * i + 3), 3 * (k * layer + i));
  }
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, null);
  gl.deleteFramebuffer(buffer);
  renderer.resetState();
  const out = new Float32Array(3 * count);
  let at = 0;
  for (const { base, count: own } of mapping) {
    out.set(all.subarray(3 * base, 3 * (base + own)), at);
    at += 3 * own;
  }
  return out;
}
