// What one sees of a file with Gaussians: the canvas, the camera that mouse and fingers move, and the parts of the file as they come.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Drawing } from "./gaussians.js";

const COARSE = 1 / 4; // of the window's pixels along each side, until all Gaussians have come

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

export class View {
  // `takeOther(kind, bytes, count)` gets the parts of the file that are no Gaussians.
  constructor(canvas, head, stencils, read, takeOther = () => {}) {
    Object.assign(this, { canvas, head, read, takeOther });
    this.left = 3; // pictures that have to be drawn
    this.drawn = 0;
    this.first = null; // when the first picture was there [s after the page was asked for]
    this.fence = null;
    this.whole = head.parts.length === head.start;
    this.scale = 1; // of the window's pixels along each side
    this.drawing = new Drawing(canvas, (pictures) => this.wake(pictures));
    this.drawing.show(head, stencils);
  }

  wake(pictures) {
    this.left = Math.max(this.left, pictures);
  }

  async take(index) {
    const [kind, first, last] = this.head.parts[index];
    const bytes = await this.read(`part-${index}`);
    if (kind === "moving" || kind === "still") this.drawing.add(kind, bytes);
    else this.takeOther(kind, bytes, last - first);
  }

  // Read what the first picture needs, and set up the camera.
  async open() {
    const { head, canvas, drawing } = this;
    for (let index = 0; index < head.start; index++) await this.take(index);
    const camera = new THREE.PerspectiveCamera(head.camera.fov, 1, 0.01, 200);
    camera.up.set(0, 0, 1);
    camera.position.set(...head.camera.eye);
    const controls = new OrbitControls(camera, canvas);
    controls.target.set(...head.camera.target);
    controls.enableDamping = true;
    controls.minDistance = 0.1;
    controls.maxDistance = 20;
    controls.addEventListener("change", () => this.wake(3));
    controls.update();
    Object.assign(this, { camera, controls });
    this.wanted = reach(head, drawing.splat.layers.moving) + 0.3 / camera.position.distanceTo(controls.target); // and room to swing
    window.addEventListener("resize", () => this.resize());
    this.resize();
  }

  resize() {
    const { camera, head, whole, drawing } = this;
    const [width, height] = [window.innerWidth, window.innerHeight];
    drawing.rough(!whole);
    drawing.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2) * (whole ? this.scale : COARSE));
    drawing.renderer.setSize(width, height);
    const upright = Math.tan((head.camera.fov * Math.PI) / 360);
    const across = Math.min(upright * head.camera.aspect, this.wanted); // what a narrow window still shows
    camera.aspect = width / height;
    camera.fov = (2 * Math.atan(Math.max(across / camera.aspect, upright)) * 180) / Math.PI;
    camera.updateProjectionMatrix();
    this.wake(3);
  }

  // Draw from now on; `tick(now)` is called before each picture. Returns a promise that all of the file has come.
  begin(tick) {
    this.drawing.begin(this.camera);
    this.drawing.renderer.setAnimationLoop((now) => {
      tick(now);
      this.controls.update();
      if (!this.drawing.ready) this.wake(1);
      if (this.left > 0) {
        this.left--;
        this.drawing.render(this.camera);
        this.drawn++;
      }
      this.timeFirst();
    });
    this.complete = this.takeRest();
    return this.complete;
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

  // The rest of the file after the first picture, with time for others in between.
  async takeRest() {
    while (this.first === null && !document.hidden) await new Promise((resolve) => setTimeout(resolve, 4));
    this.drawing.follow();
    try {
      for (let index = this.head.start; index < this.head.parts.length; index++) {
        await this.take(index);
        await new Promise((resolve) => setTimeout(resolve));
      }
    } finally {
      this.whole = true;
      this.resize();
    }
  }

  // Resolves once all Gaussians have come and are sorted, and nothing is left to draw.
  async settled() {
    await this.complete;
    const rest = () => this.left === 0 && this.drawing.sorted;
    for (let calm = 0; calm < 3; calm = rest() ? calm + 1 : 0)
      await new Promise((resolve) => requestAnimationFrame(resolve));
  }

  // See Drawing.positions.
  async positions() {
    await this.settled();
    return this.drawing.positions();
  }
}
