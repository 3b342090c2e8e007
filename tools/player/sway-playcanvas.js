// A .sway film in a scene of PlayCanvas: entity.script.create(SwayingSplat, { properties: { url: "flag.sway" } }). See docs/bundle.md.
import * as pc from "playcanvas";
import { fill, lightOf, limitOf, readFilm, rowsOf, TEXELS, texels, WIDTH } from "./bundle.js";
import { FUNCTIONS, MOVING, REST } from "./film.glsl.js";

const DRAWN = ["dataCenter", "dataColor", "dataScale", "dataRotation"]; // what the engine draws

/** In units of the object's size, with z up and the centre at rest in the origin. Its formulas are GLSL, so the engine has to draw with WebGL2. */
export class SwayingSplat extends pc.Script {
  static scriptName = "swayingSplat";
  /** Address of a .sway file. */
  url = "";
  /** The time that is shown [s], which starts anew after the end; it goes on while `playing`. */
  time = 0;
  playing = true;
  shown = -1;

  initialize() {
    /** Resolves when all has come; rejects where the file cannot be read, or the device cannot draw it. */
    this.complete = this.read();
    this.complete.catch(() => {}); // for those who do not wait
    this.on("destroy", () => this.dispose());
  }

  async read() {
    const device = this.app.graphicsDevice;
    if (device.isWebGPU || !device.textureFloatRenderable) throw new Error("SwayingSplat needs a device of WebGL2 that draws to textures of floats");
    const data = /** @type {Record<string, any>} */ ({});
    const loaded = { moving: 0, still: 0 };
    let head, frames;
    const begin = (found, stencils, come) => {
      [head, frames] = [found, come];
      for (const name in TEXELS.moving) data[name] = texels(head.count);
      Object.assign(data, { rows: rowsOf(stencils), moved: texels(head.nodes, Float32Array) });
      loaded.still = head.moving;
    };
    await readFilm(this.url, begin, (kind, bytes) => (loaded[kind] += fill(kind, bytes, loaded[kind], (name) => data[name])));
    this.open(device, head, data);
    this.frames = frames; // from now on it is drawn
  }

  open(device, head, data) {
    const { light, kind } = lightOf(head);
    const numbers = { cell: `float(${head.cell})`, metre: `float(${head.metre})`, corner: `vec3(${head.corner})`, limit: `float(${limitOf(head)})`, light: `vec3(${light})`, kind: `vec4(${kind})` };
    const inputs = { ...numbers, index: "int(splat.index)", grown: "1.0" };
    for (const name in data) inputs[name] = `film_${name}`;
    const samplers = Object.keys(data).map((name) => `uniform highp ${name === "moved" ? "sampler2D" : "usampler2D"} film_${name};`);
    const processGLSL = `${samplers.join("\n")}${FUNCTIONS}
      void process() {
        ${REST(inputs)}
        if (${inputs.index} < ${head.moving}) { ${MOVING(inputs)} }
        vec4 rotation;
        vec3 scale;
        filmAxes(A, rotation, scale);
        writeDataCenter(vec4(center, 1.0));
        writeDataColor(vec4(color, rgba.a));
        writeDataScale(vec4(scale, 0.0));
        writeDataRotation(rotation);
      }`;
    const source = new pc.GSplatContainer(device, head.count, new pc.GSplatFormat(device, [], { readGLSL: "\n" }));
    this.container = new pc.GSplatContainer(device, head.count, pc.GSplatFormat.createDefaultFormat(device));
    this.container.aabb = new pc.BoundingBox(new pc.Vec3(), new pc.Vec3(1, 1, 1));
    this.processor = new pc.GSplatProcessor(device, { resource: source }, { resource: this.container, streams: DRAWN }, { processGLSL });
    this.textures = Object.entries(data).map(([name, numbers]) => {
      const format = name === "moved" ? pc.PIXELFORMAT_RGBA32F : pc.PIXELFORMAT_RGBA32U;
      const made = pc.Texture.createDataTexture2D(device, name, WIDTH, numbers.length / (4 * WIDTH), format, [numbers]);
      this.processor.setParameter(`film_${name}`, made);
      return made;
    });
    this.moved = this.textures.at(-1);
  }

  /** Length [s]. */
  get duration() {
    return this.frames?.duration ?? 0;
  }

  update(dt) {
    if (!this.frames) return;
    if (this.playing) this.time += dt;
    const frame = this.frames.at(this.time);
    if (frame !== this.shown) {
      this.shown = frame;
      this.frames.write(this.moved.lock(), frame);
      this.moved.unlock();
      this.processor.process();
      if (!this.entity.gsplat) this.entity.addComponent("gsplat", { resource: this.container });
      this.entity.gsplat.workBufferUpdate = pc.WORKBUFFER_UPDATE_ONCE;
    }
    if (this.sorted !== frame && !this.sorting) this.sort(frame);
  }

  /** Lets the engine sort by where the Gaussians are now. */
  async sort(frame) {
    this.sorting = true;
    const { centers, textureDimensions } = this.container;
    const places = await this.container.getTexture("dataCenter").read(0, 0, textureDimensions.x, textureDimensions.y);
    for (let i = 0, k = 0; k < centers.length; i += 4) for (let j = 0; j < 3; j++) centers[k++] = places[i + j];
    this.container.update();
    Object.assign(this, { sorting: false, sorted: frame });
  }

  dispose() {
    this.processor?.destroy();
    this.textures?.forEach((made) => made.destroy());
    this.entity.removeComponent("gsplat");
    this.container?.destroy();
  }
}
