// The live page: draws the states of a running simulation on a canvas below that of viser. See docs/live.md.
import * as THREE from "three";
import { Brush } from "./brush.js";
import { Drawing, writeNodes } from "./gaussians.js";
import { Playback } from "./playback.js";

const SLOW = 3; // pictures a second; a browser that draws fewer gets pictures from the server
const PATIENCE = 4; // s, until that is decided
const SIZES = [1, 0.75, 0.5, 0.35]; // parts of the window's pixels along each side, where the graphics card is slow
const AGAIN = 1000; // ms until a connection that broke is opened again

// ---- messages, see gaussian_swaying/viewer/states.py

function unpack(data) {
  const bytes = new Uint8Array(data);
  const size = new DataView(data).getUint32(0, true);
  return [JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + size))), bytes.slice(4 + size)];
}

// The displacement of all nodes, four numbers each.
function readState(head, rest) {
  const near = new Int16Array(rest.buffer, 0, 3 * head.nodes);
  const moved = new Float32Array(4 * head.nodes);
  const far = rest.slice(near.byteLength).buffer;
  writeNodes(moved, near, { rows: new Int32Array(far), values: new Float32Array(far) }, head.step);
  return { time: head.time, moved };
}

// ---- the canvas

class Stage {
  constructor() {
    this.playback = new Playback();
    this.canvas = document.createElement("canvas");
    Object.assign(this.canvas.style, { position: "absolute", inset: 0, width: "100%", height: "100%" });
    Object.assign(this.canvas.style, { zIndex: -1, pointerEvents: "none" });
    this.canvas.id = "wind";
    this.camera = new THREE.PerspectiveCamera();
    this.above = null; // viser's canvas, and its camera
    this.world = null; // from viser's world to that of the Gaussians
    this.drawing = null;
    this.socket = null;
    this.brush = new Brush(this);
    this.failed = null; // why this browser does not draw
    Object.assign(this, { slow: SLOW, patience: PATIENCE });
    this.scene = this.motion = null;
    this.on = false;
    this.left = 0; // pictures that have to be drawn
    this.drawn = []; // when, of the last seconds [s]
    this.count = 0; // pictures that were drawn
    this.size = 0; // index in SIZES
    this.asked = false; // whether the last tick drew
    this.lately = { time: 0, pictures: 0 }; // time that pictures took [s], for the size
    this.long = { time: 0, pictures: 0 }; // the same, until the server is asked to draw
  }

  // ---- the server

  // Ask for the states; called by the server, with the key of this browser.
  join(key) {
    if (key !== this.key) this.brush.join(key);
    this.key = key;
    this.socket?.close();
    if (this.failed) return;
    const socket = new WebSocket(`${location.origin.replace("http", "ws")}/states?key=${key}`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    let count = 0;
    socket.onmessage = ({ data }) => {
      try {
        this.take(...unpack(data));
      } catch (error) {
        return this.fail(error.message);
      }
      const answer = new DataView(new ArrayBuffer(8));
      answer.setUint32(0, ++count, true);
      answer.setFloat32(4, this.rate(), true);
      socket.send(answer.buffer);
    };
    socket.onclose = () => {
      if (socket !== this.socket) return;
      this.hide();
      setTimeout(() => socket === this.socket && !this.failed && this.key === key && this.join(key), AGAIN);
    };
  }

  // Let the server draw from now on.
  fail(why) {
    console.info(`The server draws: ${why}.`);
    this.failed = why;
    this.hide();
    this.drawing?.clear();
    this.socket?.close();
  }

  hide() {
    this.on = false;
    this.canvas.style.visibility = "hidden";
    this.playback.clear();
    this.scene = null;
  }

  take(head, rest) {
    if (head.kind === "off") return this.hide();
    if (head.kind === "look") return this.drawing.light(head);
    if (head.kind === "colours") {
      const changed = new Uint32Array(rest.buffer, 0, head.count);
      return this.drawing.recolour(changed.map((i) => this.place[i]), rest.subarray(changed.byteLength));
    }
    if (head.kind === "scene") {
      this.drawing ??= new Drawing(this.canvas, (pictures) => (this.left = Math.max(this.left, pictures)));
      const last = head.moving + head.still;
      const [order, stencils] = [new Uint32Array(head.head.count), new Uint32Array(27 * head.head.stencils)];
      new Uint8Array(order.buffer).set(rest.subarray(last, last + order.byteLength));
      new Uint8Array(stencils.buffer).set(rest.subarray(last + order.byteLength));
      this.place = new Uint32Array(order.length); // of each Gaussian of the splat among those that are drawn
      order.forEach((i, k) => (this.place[i] = k));
      this.drawing.show(head.head, stencils);
      this.drawing.add("moving", rest.subarray(0, head.moving));
      this.drawing.add("still", rest.subarray(head.moving, last));
      this.drawing.follow();
      this.world = new THREE.Matrix4().fromArray(head.world);
      this.scene = head.head;
      this.playback.clear();
      return;
    }
    if (head.motion !== this.motion) this.playback.clear();
    this.motion = head.motion;
    this.playback.add(readState(head, rest), performance.now() / 1000, head.ended);
    this.stale = true;
    this.on = true;
    this.canvas.style.visibility = "visible";
  }

  // ---- pictures

  // Called when viser has drawn.
  follow(renderer, camera) {
    const above = renderer.domElement;
    if (!above.isConnected || above === this.canvas) return;
    if (this.canvas.parentElement !== above.parentElement) {
      above.parentElement.prepend(this.canvas);
      above.toBlob = (...given) => this.together(above).toBlob(...given); // viser's button that saves the picture
    }
    this.above = { canvas: above, camera };
    if (this.on) this.look();
  }

  // Take over viser's camera.
  look() {
    const { camera: seen } = this.above;
    const { camera } = this;
    const before = camera.matrixWorld.clone();
    const lens = [camera.fov, camera.aspect, camera.near];
    const size = new THREE.Vector3();
    new THREE.Matrix4().multiplyMatrices(this.world, seen.matrixWorld).decompose(camera.position, camera.quaternion, size);
    Object.assign(camera, { fov: seen.fov, aspect: seen.aspect, near: seen.near * size.x, far: 1000 });
    camera.updateMatrixWorld();
    if (before.equals(camera.matrixWorld) && [camera.fov, camera.aspect, camera.near].every((x, i) => x === lens[i])) return;
    camera.updateProjectionMatrix();
    this.drawing.wake(2); // it is sorted for the picture after
  }

  resize(scale) {
    const { clientWidth: width, clientHeight: height } = this.above.canvas;
    const ratio = Math.min(window.devicePixelRatio, 2) * scale;
    const wanted = [Math.max(1, Math.floor(width * ratio)), Math.max(1, Math.floor(height * ratio))];
    if (this.canvas.width === wanted[0] && this.canvas.height === wanted[1]) return;
    this.drawing.renderer.setSize(...wanted, false);
    this.drawing.wake(1);
  }

  tick(milliseconds) {
    const { playback, drawing } = this;
    if (!this.on || !this.above || playback.newest === null) return; // another scene has no state yet
    const now = milliseconds / 1000;
    const before = playback.shown;
    playback.advance(now);
    if (this.stale || playback.shown !== before) {
      this.stale = false;
      drawing.move((data) => playback.write(data));
      this.moving = now;
    }
    const still = now - (this.moving ?? 0) > 0.3;
    this.resize(still ? 1 : SIZES[this.size]);
    this.look();
    if (!drawing.ready) drawing.wake(1);
    this.adapt(now, still);
    if (this.left === 0) return;
    this.left--;
    drawing.render(this.camera);
    this.count++;
    this.drawn.push(now);
    while (now - this.drawn[0] > 2) this.drawn.shift();
  }

  // Fewer pixels if pictures take long; after all, those of the server.
  adapt(now, still) {
    const took = now - (this.drawn[this.drawn.length - 1] ?? now); // since the last picture
    const busy = this.left > 0 && this.asked && !still && !document.hidden;
    this.asked = this.left > 0;
    if (!busy || took === 0) return;
    for (const sum of [this.lately, this.long]) {
      sum.time += took;
      sum.pictures++;
    }
    if (this.lately.time > 1) {
      if (this.lately.pictures / this.lately.time < 20 && this.size < SIZES.length - 1) this.size++;
      this.lately = { time: 0, pictures: 0 };
    }
    if (this.long.time > this.patience) {
      const slow = this.long.pictures / this.long.time < this.slow;
      if (slow) this.fail("this browser draws slowly, mostly for lack of a graphics card");
      this.long = { time: 0, pictures: 0 };
    }
  }

  // Pictures a second.
  rate() {
    const now = performance.now() / 1000;
    return this.drawn.filter((at) => now - at < 2).length / 2;
  }

  // What is seen: our picture below that of viser.
  together(above) {
    const both = document.createElement("canvas");
    [both.width, both.height] = [above.width, above.height];
    const pen = both.getContext("2d");
    if (this.on) {
      this.drawing.render(this.camera);
      pen.drawImage(this.canvas, 0, 0, both.width, both.height);
    }
    pen.drawImage(above, 0, 0);
    return both;
  }

  // Centres of the Gaussians as they are drawn, in units of the object's size; for tests.
  positions() {
    return this.drawing.positions();
  }
}

// Without WebGL2, viser shows neither pictures nor controls.
function tellWhatLacks(stage) {
  stage.failed = "this browser has no WebGL2";
  const message = document.createElement("p");
  message.textContent =
    "This page needs WebGL2, which this browser lacks or has switched off: switch on hardware acceleration in its " +
    "settings, or open the page in another browser. Without a graphics card, start Chromium with --enable-unsafe-swiftshader.";
  Object.assign(message.style, { position: "fixed", inset: "40% 0 auto", zIndex: 1000, margin: "auto", maxWidth: "36em" });
  Object.assign(message.style, { padding: "1em", font: "16px/1.5 system-ui, sans-serif", color: "#222", background: "#fff" });
  addEventListener("DOMContentLoaded", () => document.body.append(message));
}

// Called before viser's program starts, to see its pictures and its camera: three.js announces each of its renderers.
export function watch() {
  const stage = new Stage();
  window.wind = stage;
  const tested = document.createElement("canvas").getContext("webgl2");
  if (!tested) return tellWhatLacks(stage);
  tested.getExtension("WEBGL_lose_context")?.loseContext();
  window.__THREE_DEVTOOLS__ ??= new EventTarget();
  window.__THREE_DEVTOOLS__.addEventListener("observe", ({ detail: renderer }) => {
    if (!renderer.isWebGLRenderer || renderer.domElement === stage.canvas) return;
    const draw = renderer.render;
    renderer.render = function (scene, camera, ...rest) {
      draw.call(this, scene, camera, ...rest);
      if (camera.isPerspectiveCamera && this.getRenderTarget() === null) stage.follow(this, camera);
    };
  });
  const tick = (now) => {
    requestAnimationFrame(tick);
    stage.tick(now);
  };
  requestAnimationFrame(tick);
}
