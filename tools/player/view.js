// What one sees: the canvas, the camera that mouse and fingers move, and the parts of a file of Gaussians as they come.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Drawing } from "./gaussians.js";

const COARSE = 1 / 4; // of the window's pixels along each side, until all Gaussians have come
const PIXELS = [1, 0.75, 0.5, 0.35]; // the same, where drawing is slow
const FEW = 20; // pictures a second
const WINDOW = 1500; // ms, over which they are counted
const CALM = 300; // ms without motion, after which the picture is sharp

// How far the moving Gaussians reach to the left and right of the first view, as a tangent.
function reach(camera, layer) {
  const eye = new THREE.Vector3(...camera.eye);
  const axis = new THREE.Vector3(...camera.target).sub(eye).normalize();
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

export class View {
  // `takeOther(kind, bytes, count)` gets the parts of the file that are no Gaussians; `draws` is false without WebGL2.
  constructor(canvas, { takeOther = (_kind, _bytes, _count) => {}, draws = true } = {}) {
    Object.assign(this, { canvas, takeOther });
    this.left = 3; // pictures that have to be drawn
    this.drawn = 0;
    this.first = null; // when the first picture was there [s after the page was asked for]
    this.fence = null;
    this.whole = true;
    this.drawing = draws ? new Drawing(canvas, (pictures) => this.wake(pictures)) : null;
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.01, 200);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enableDamping: true, minDistance: 0.1, maxDistance: 20 });
    this.controls.addEventListener("change", () => {
      this.stirred = performance.now();
      this.wake(3);
    });
    this.stirred = 0; // when the view or the scene moved last [ms]
    this.sharp = false;
    this.lately = { since: 0, pictures: 0, size: 0 };
    addEventListener("resize", () => this.resize());
  }

  wake(pictures) {
    this.left = Math.max(this.left, pictures);
  }

  // Look from the camera of a head; `wanted` is the tangent that a narrow window still shows to each side.
  aim(camera, wanted = Infinity) {
    this.aimed = { ...camera, wanted };
    this.camera.position.set(...camera.eye);
    this.controls.target.set(...camera.target);
    this.controls.update();
    this.resize();
  }

  // Read what the first picture of a file needs.
  async open(head, stencils, read) {
    Object.assign(this, { head, read });
    this.whole = head.parts.length === head.start;
    this.drawing.show(head, stencils);
    for (let index = 0; index < head.start; index++) await this.take(index);
  }

  // Look from where the file says, with room to swing.
  aimAsWritten() {
    const { camera } = this.head;
    const distance = new THREE.Vector3(...camera.eye).distanceTo(new THREE.Vector3(...camera.target));
    this.aim(camera, reach(camera, this.drawing.splat.layers.moving) + 0.3 / distance);
  }

  async take(index) {
    const [kind, first, last] = this.head.parts[index];
    const bytes = await this.read(`part-${index}`);
    if (kind === "moving" || kind === "still") this.drawing.splat.add(kind, bytes);
    else this.takeOther(kind, bytes, last - first);
  }

  resize() {
    if (!this.aimed) return;
    const { camera, whole, drawing, aimed } = this;
    const [width, height] = [window.innerWidth, window.innerHeight];
    if (drawing) {
      drawing.rough(!whole);
      drawing.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2) * (!whole ? COARSE : this.sharp ? 1 : PIXELS[this.lately.size]));
      drawing.renderer.setSize(width, height);
    }
    const upright = Math.tan((aimed.fov * Math.PI) / 360);
    const across = Math.min(upright * aimed.aspect, aimed.wanted); // what a narrow window still shows
    camera.aspect = width / height;
    camera.fov = (2 * Math.atan(Math.max(across / camera.aspect, upright)) * 180) / Math.PI;
    camera.updateProjectionMatrix();
    this.wake(3);
  }

  // Move the nodes, as Drawing does.
  move(fill) {
    this.stirred = performance.now();
    this.drawing.splat.move(fill);
  }

  // Draw from now on; `tick(now)` is called before each picture.
  begin(tick) {
    if (this.drawing?.spark) this.drawing.begin(this.camera);
    const loop = (now) => {
      requestAnimationFrame(loop);
      tick(now);
      this.controls.update();
      if (!this.drawing?.spark) return;
      this.adapt(now);
      if (!this.drawing.ready) this.wake(1);
      if (this.left > 0) {
        this.left--;
        this.drawing.render(this.camera);
        this.drawn++;
        this.lately.pictures++;
      }
      this.timeFirst();
    };
    requestAnimationFrame(loop);
  }

  // Fewer pixels where drawing is slow, while something moves.
  adapt(now) {
    const { lately } = this;
    const sharp = now - this.stirred > CALM;
    if (sharp !== this.sharp) {
      this.sharp = sharp;
      if (lately.size > 0) this.resize();
    }
    if (this.left === 0) Object.assign(lately, { since: now, pictures: 0 }); // nothing to draw says nothing
    if (now - lately.since < WINDOW) return;
    this.rate = (1000 * lately.pictures) / (now - lately.since);
    Object.assign(lately, { since: now, pictures: 0 });
    if (!this.whole || document.hidden || this.rate > FEW || lately.size === PIXELS.length - 1) return;
    lately.size++;
    this.resize();
  }

  // When the graphics card had finished the first picture with Gaussians.
  timeFirst() {
    const gl = this.drawing.renderer.getContext();
    if (this.first !== null || !this.drawing.ready) return;
    if (this.fence === null) {
      this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
      gl.flush();
    } else if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) === gl.SIGNALED) this.first = performance.now() / 1000;
  }

  // Resolves with the first picture, or at once in a hidden page.
  async begun() {
    while (this.first === null && !document.hidden) await new Promise((resolve) => setTimeout(resolve, 4));
  }

  // The rest of the file after the first picture, with time for others in between.
  async takeRest() {
    await this.begun();
    this.drawing.splat.follow();
    const { head } = this;
    try {
      for (let index = head.start; index < head.parts.length; index++) {
        await this.take(index);
        await new Promise((resolve) => setTimeout(resolve));
      }
    } finally {
      this.whole = true;
      this.resize();
    }
  }

  // Resolves once nothing is left to draw and all is sorted.
  async settled() {
    const rest = () => this.whole && this.left === 0 && this.drawing.sorted;
    for (let calm = 0; calm < 3; calm = rest() ? calm + 1 : 0)
      await new Promise((resolve) => requestAnimationFrame(resolve));
  }

  // See Drawing.positions.
  async positions() {
    await this.settled();
    return this.drawing.positions();
  }
}
