// A .sway film in a scene of your own, with three.js and Spark: scene.add(new SwayingSplat("flag.sway")). See docs/bundle.md.
import * as THREE from "three";
import { blocks, Frames } from "./bundle.js";
import { reader, Splat } from "./gaussians.js";

/** In units of the object's size, with z up and the centre at rest in the origin. Draw it with `new SparkRenderer({ covSplats: true, ... })`. */
export class SwayingSplat extends THREE.Group {
  /** @param {string} url of a .sway file */
  constructor(url) {
    super();
    this.head = null;
    this.shown = -1;
    /** Resolves when all has come; rejects where the file cannot be read. */
    this.complete = this.read(url);
    this.complete.catch(() => {}); // for those who do not wait
  }

  async read(url) {
    const file = blocks(url);
    const next = async () => {
      const { done, value } = await file.next();
      if (done) throw new Error(`${url} is cut short`);
      return value;
    };
    this.head = JSON.parse(new TextDecoder().decode(await next()));
    const stencils = reader(await next())(Uint32Array, 27 * this.head.stencils);
    this.splat = new Splat(this.head, stencils);
    this.frames = new Frames(this.head);
    this.splat.follow();
    this.add(this.splat.group);
    for (const [kind, first, last] of this.head.parts) {
      const bytes = await next();
      if (kind === "frames") this.frames.add(bytes, last - first);
      else this.splat.add(kind, bytes);
    }
  }

  /** Length [s]. */
  get duration() {
    return this.head === null ? 0 : this.head.frames * this.head.frame_dt;
  }

  /** Shows the motion at a time [s], which starts anew after the end. */
  set time(seconds) {
    const loaded = this.frames?.loaded ?? 0;
    if (loaded === 0) return;
    const frame = Math.min(Math.floor((seconds % this.duration) / this.head.frame_dt + 1e-6), loaded - 1);
    if (frame !== this.shown) this.splat.move((data) => this.frames.write(data, frame));
    this.shown = frame;
  }

  dispose() {
    this.splat?.dispose();
  }
}
