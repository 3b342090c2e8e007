// A .sway film in a scene of your own, with three.js and Spark: scene.add(new SwayingSplat("flag.sway")). See docs/bundle.md.
import * as THREE from "three";
import { readFilm } from "./bundle.js";
import { Splat } from "./gaussians.js";

/** In units of the object's size, with z up and the centre at rest in the origin. Draw it with `new SparkRenderer({ covSplats: true, ... })`. */
export class SwayingSplat extends THREE.Group {
  /** @param {string} url of a .sway file */
  constructor(url) {
    super();
    this.head = null;
    this.shown = -1;
    const begin = (head, stencils, frames) => {
      Object.assign(this, { head, frames, splat: new Splat(head, stencils) });
      this.splat.follow();
      this.add(this.splat.group);
    };
    /** Resolves when all has come; rejects where the file cannot be read. */
    this.complete = readFilm(url, begin, (kind, bytes) => this.splat.add(kind, bytes));
    this.complete.catch(() => {}); // for those who do not wait
  }

  /** Length [s]. */
  get duration() {
    return this.frames?.duration ?? 0;
  }

  /** Shows the motion at a time [s], which starts anew after the end. */
  set time(seconds) {
    const frame = this.frames?.at(seconds) ?? -1;
    if (frame >= 0 && frame !== this.shown) this.splat.move((data) => this.frames.write(data, frame));
    this.shown = frame;
  }

  dispose() {
    this.splat?.dispose();
  }
}
