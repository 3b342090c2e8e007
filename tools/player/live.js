// The live page: draws the states of a simulation that runs on a server, and steers it. See docs/web.md.
import { Brush } from "./brush.js";
import { blocks, readHead, writeNodes } from "./bundle.js";
import { button, element, make } from "./panel.js";
import { Tunnel } from "./tunnel.js";
import { View } from "./view.js";

const SLOW = 3; // pictures a second; a browser that draws fewer gets pictures from the server
const PATIENCE = 4000; // ms, until that is decided
const NARROW = 1100; // pixels, as in player.html
const AGAIN = 1000; // ms until a connection that broke is opened again

// ---- messages, see gaussian_swaying/player/server.py

function unpack(data) {
  const bytes = new Uint8Array(data);
  const size = new DataView(data).getUint32(0, true);
  return { ...JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + size))), rest: bytes.slice(4 + size) };
}

// The displacement of all nodes, four numbers each.
function readState({ nodes, rest, step }) {
  const near = new Int16Array(rest.buffer, 0, 3 * nodes);
  const moved = new Float32Array(4 * nodes);
  const far = rest.slice(near.byteLength).buffer;
  writeNodes(moved, near, { rows: new Int32Array(far), values: new Float32Array(far) }, step);
  return moved;
}

class Live {
  constructor() {
    const canvas = element("canvas");
    const tested = document.createElement("canvas").getContext("webgl2");
    tested?.getExtension("WEBGL_lose_context")?.loseContext();
    this.failed = tested ? null : "this browser has no WebGL2"; // why this browser does not draw
    Object.assign(this, { slow: SLOW, patience: PATIENCE });
    this.view = new View(canvas, { draws: tested !== null });
    const action = (kind, text, label) => button(kind, text, label, () => this.say({ kind }));
    const further = [action("step", "Step", "Advance by one step"), action("undo", "Undo", "Take the last change back")];
    further.push(button("curves", "Timeline", "Speed, direction and gusts over time", () => this.openTimeline(element("timeline").hidden)));
    this.tunnel = new Tunnel(this.view, (message) => this.say(message), (name, value) => this.set(name, value), further);
    this.brush = new Brush(this.view, (message) => this.say(message));
    this.own = { show: "color", server: false, part: "held", radius: 20, through: false, how: "what is connected" };
    this.on = false; // whether it draws
    this.figures = this.painting = this.panel = null;
    this.count = 0; // messages with bytes that were taken in
    this.lens = "";
    this.since = null; // when it began to draw slowly
    this.file = make("input", { type: "file", hidden: true });
    this.file.addEventListener("change", () => this.file.files[0] && this.load(this.file.files[0]));
    document.body.append(this.file);
    addEventListener("keydown", (event) => {
      if (event.key === "z" && (event.ctrlKey || event.metaKey)) this.say({ kind: "undo" });
    });
    document.addEventListener("visibilitychange", () => this.tellShown());
    this.connect();
    this.view.begin((now) => this.tick(now));
  }

  // ---- the server

  connect() {
    const socket = new WebSocket(`${location.origin.replace("http", "ws")}/socket`);
    socket.binaryType = "arraybuffer";
    Object.assign(this, { socket, count: 0, lens: "" });
    let queue = Promise.resolve();
    socket.onopen = () => this.tellShown();
    socket.onmessage = ({ data }) => {
      queue = queue.then(() => this.take(typeof data === "string" ? JSON.parse(data) : unpack(data))).catch((error) => this.fail(error.message));
      if (typeof data !== "string") queue.then(() => socket === this.socket && this.say({ kind: "ack", count: ++this.count, rate: this.on ? this.view.rate ?? 0 : 0 }));
    };
    socket.onclose = () => {
      this.tell("The program does not answer: it may have ended.");
      setTimeout(() => this.connect(), AGAIN);
    };
  }

  say(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  tellShown() {
    this.say({ kind: "shown", show: this.own.show, server: this.own.server || this.failed !== null, hidden: document.hidden });
  }

  // Let the server draw from now on.
  fail(why) {
    console.info(`The server draws: ${why}.`);
    this.failed = why;
    this.on = false;
    this.tellShown();
  }

  async take(message) {
    const { drawing, canvas } = this.view;
    const { kind } = message;
    if (kind === "figures") this.showFigures(message);
    else if (kind === "panel") this.showPanel((this.panel = message));
    else if (kind === "painting") this.showPanel(this.panel, (this.painting = message));
    else if (kind === "grabbed") this.tunnel.grabbed(message);
    else if (kind === "look") drawing.light(message);
    else if (kind === "colours") drawing.splat.recolour(new Uint32Array(message.rest.buffer, 0, message.count), message.rest.subarray(4 * message.count));
    else if (kind === "scene") await this.open();
    else if (kind === "picture") {
      const [width, height] = [innerWidth, innerHeight].map((side) => Math.round(side * devicePixelRatio));
      const size = { resizeWidth: width, resizeHeight: height, resizeQuality: "high" };
      const picture = await createImageBitmap(new Blob([message.rest], { type: "image/jpeg" }), size);
      const shown = element("picture");
      Object.assign(shown, { width: picture.width, height: picture.height, hidden: false });
      shown.getContext("2d").drawImage(picture, 0, 0);
      this.on = false;
      canvas.style.opacity = "0";
      element("message").hidden = true;
    } else if (kind === "state" && !this.failed && message.nodes === this.view.head?.nodes) {
      this.tunnel.take({ ...message, moved: readState(message) });
      this.on = true;
      canvas.style.opacity = "1";
      element("picture").hidden = element("message").hidden = true;
    }
  }

  async open() {
    const next = await blocks("scene.sway");
    const [head, stencils] = await readHead(next);
    this.tunnel.playback.clear();
    await this.view.open(head, stencils, next);
    for (let index = head.start; index < head.parts.length; index++) await this.view.take(index);
    this.view.whole = true;
    this.view.drawing.splat.follow();
    this.view.resize();
  }

  // ---- what it shows

  tell(sentence) {
    element("note").textContent = sentence;
    element("note").hidden = !sentence;
  }

  openTimeline(on) {
    element("timeline").hidden = !on;
    if (on && innerWidth <= NARROW) this.tunnel.open(false); // there is room for one
    element("curves").setAttribute("aria-expanded", String(on));
  }

  showFigures(figures) {
    this.figures = figures;
    const { loading, notice, problem, broken, paused, speed, rate, pictures, stretch } = figures;
    const remedy = broken ? " Press Reset to start again, or Undo." : "";
    this.tell([problem && problem + remedy, notice].filter(Boolean).join(" "));
    element("loading").hidden = !loading;
    if (loading) [element("loading").value, element("figures").textContent] = [loading.share, `${loading.what} …`];
    if (paused === undefined) return;
    this.tunnel.showPlaying(!paused);
    this.tunnel.speed = speed;
    this.tunnel.slow.setAttribute("aria-pressed", String(speed < 1));
    element("undo").disabled = figures.undo === 0;
    const lines = [`${pictures} pictures a second, ${paused ? "paused" : `${rate.toPrecision(2)} × real time`}`];
    if (!loading) element("figures").textContent = lines.join(", ");
    element("figures").title = `t = ${figures.time.toFixed(2)} s; ${figures.substeps} substeps in a step of ${figures.step.toPrecision(3)} s; stretch ${stretch[0].toFixed(2)} to ${stretch[1].toFixed(2)}`;
  }

  showPanel(panel) {
    if (!panel) return;
    const { own, painting } = this;
    this.tunnel.metre = panel.metre;
    const camera = JSON.stringify(panel.camera);
    if (camera !== this.camera) this.view.aim(panel.camera); // another object
    this.camera = camera;
    const toggle = (name, label, value, hint = "") => ({ kind: "toggle", name, label, value, hint });
    const act = (name, label, hint = "") => ({ kind: "button", name, label, hint });
    const groups = [...panel.groups];
    if (painting) {
      const names = painting.parts.map(({ name }) => name);
      if (!names.includes(own.part)) own.part = names.find((name) => name.startsWith("held")) ?? names[0];
      const paint = [toggle("paint", "Paint", painting.on, "The object rests meanwhile; Shift turns the view")];
      if (painting.on)
        paint.push(
          { kind: "choice", name: "part", label: "Paint as", options: names, value: own.part },
          { kind: "range", name: "radius", label: "Radius", unit: "pixels", low: 2, high: 200, log: true, value: own.radius },
          toggle("through", "Hidden, too", own.through, "The brush reaches through the object"),
          { kind: "choice", name: "how", label: "Double click", options: panel.together, value: own.how },
        );
      if (painting.undo) paint.push(act("take_back", "Undo the stroke"));
      if (painting.apply) paint.push(act("apply", "Apply the parts", "The simulation takes them, from rest"));
      if (painting.save) paint.push(act("parts.npz", "Save the parts", "A file for scene.parts"));
      groups.push({ name: "Paint parts", controls: paint, shut: true });
    }
    const files = [
      act("restore", "Reset to the configuration", "Wind, material, pins, grid and light as they were at first"),
      act("record", this.recorder ? "Stop recording" : "Record a video", "Of what this window shows"),
      act("live.yaml", "Save the configuration", "For gaussian-swaying sim --config"),
      act("load", panel.elsewhere ? "Load a splat" : "Load a splat or a configuration"),
    ];
    groups.push({ name: "Files", controls: files, shut: true });
    this.tunnel.show(groups);
    element("curves").disabled = !this.tunnel.panel.timeline;
    if (!this.tunnel.panel.timeline) this.openTimeline(false);
    this.brush.set({ on: painting?.on ?? false, ...own });
    this.showLegend();
    if (this.hash !== undefined) return;
    this.hash = location.hash; // once the controls are there
    this.tunnel.apply(this.hash);
  }

  showLegend() {
    const scale = this.panel.legends[this.own.show];
    const rows = (this.painting?.on ? this.painting.parts : []).map(({ name, tint, count }) => {
      const square = make("i");
      square.style.background = tint ? `rgb(${tint})` : "none";
      return make("div", {}, square, `${name}: ${count.toLocaleString("en")}`);
    });
    if (scale) {
      const bar = make("b");
      bar.style.background = `linear-gradient(to right, ${scale.colours.map((colour) => `rgb(${colour})`)})`;
      const [middle, high] = [0.5 * scale.high, scale.high].map((value) => value.toPrecision(3));
      rows.push(make("div", { textContent: `${scale.name} [${scale.unit}]` }), bar, make("div", { className: "ends", innerHTML: `<span>0</span><span>${middle}</span><span>${high} and more</span>` }));
    }
    element("legend").replaceChildren(...rows);
    element("legend").hidden = rows.length === 0;
  }

  // ---- what the controls do

  set(name, value) {
    if (name in this.own) {
      this.own[name] = value;
      this.tunnel.changed.delete(name);
      this.brush.set({ on: this.painting?.on ?? false, ...this.own });
      this.showLegend();
      this.tellShown();
    } else if (name === "paint") this.say({ kind: "paint", on: value });
    else if (["take_back", "apply", "restore"].includes(name)) this.say({ kind: name });
    else if (name === "record") this.record();
    else if (name === "load") this.file.click();
    else if (["parts.npz", "live.yaml"].includes(name)) this.download(name);
    else this.say({ kind: "set", name, value });
    if (value === null || ["paint", "wind.schedule"].includes(name)) this.tunnel.changed.delete(name);
  }

  download(name) {
    make("a", { href: `save/${name}`, download: name }).click();
  }

  // Begin a video of the canvas that is shown, or end it and save it.
  record() {
    if (this.recorder) return this.recorder.stop();
    const parts = [];
    const recorder = (this.recorder = new MediaRecorder((this.on ? this.view.canvas : element("picture")).captureStream()));
    recorder.ondataavailable = ({ data }) => parts.push(data);
    recorder.onstop = () => {
      this.recorder = null;
      this.showPanel(this.panel);
      make("a", { href: URL.createObjectURL(new Blob(parts)), download: "wind.webm" }).click();
    };
    recorder.start();
    this.showPanel(this.panel);
  }

  async load(file) {
    this.file.value = "";
    const answer = await fetch(`load?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
    if (!answer.ok) this.tell(await answer.text());
  }

  // ---- pictures

  tick(now) {
    const { view, tunnel } = this;
    if (this.on) tunnel.tick(now);
    const { camera } = view;
    const size = [innerWidth, innerHeight];
    const lens = JSON.stringify([camera.matrixWorld.elements, camera.fov, size]);
    if (this.panel && lens !== this.lens && this.socket.readyState === WebSocket.OPEN && now - (this.looked ?? 0) > 30) {
      camera.updateMatrixWorld();
      this.say({ kind: "view", matrix: camera.matrixWorld.elements, fov: camera.fov, near: camera.near, size });
      Object.assign(this, { lens, looked: now });
    }
    const slow = this.on && !document.hidden && view.lately.pictures > 0 && view.rate !== undefined && view.rate < this.slow;
    if (!slow) this.since = null;
    else if (now - (this.since ??= now) > this.patience) this.fail("this browser draws slowly, mostly for lack of a graphics card");
  }
}

export function live() {
  window.wind = new Live();
}
