// Paints parts in the live page: what the mouse does goes to the server, which finds the Gaussians. See docs/parts.md.

const EVERY = 30; // ms between two messages of a stroke
const MOST = 60; // corners of a path in a message
const AGAIN = 1000; // ms until a connection that broke is opened again

export class Brush {
  // `stage` has `above`: the canvas of viser and its camera.
  constructor(stage) {
    this.stage = stage;
    this.on = false;
    this.radius = 20; // pixels
    this.path = null; // of the stroke that is being made, as far as it was not sent
    this.pointer = null;
    this.ring = document.createElement("div");
    Object.assign(this.ring.style, { position: "fixed", zIndex: 1, pointerEvents: "none", borderRadius: "50%" });
    Object.assign(this.ring.style, { boxSizing: "border-box", border: "2px solid white" });
    Object.assign(this.ring.style, { boxShadow: "0 0 2px black, inset 0 0 2px black", display: "none" });
    const listen = (name, act) => addEventListener(name, (event) => this.on && act(event), { capture: true });
    listen("pointerdown", (event) => this.begin(event));
    listen("pointermove", (event) => this.move(event));
    listen("pointerup", (event) => event.pointerId === this.pointer && this.end());
    listen("pointercancel", (event) => event.pointerId === this.pointer && this.end());
    listen("blur", (event) => event.target === window && this.end()); // not that of a control
    listen("dblclick", (event) => this.take(event));
  }

  // Open the connection; called with the key of this browser.
  join(key) {
    this.key = key;
    this.socket?.close();
    const socket = new WebSocket(`${location.origin.replace("http", "ws")}/brush?key=${key}`);
    this.socket = socket;
    socket.onmessage = ({ data }) => this.set(JSON.parse(data));
    socket.onclose = () => {
      if (socket !== this.socket) return;
      this.set({ on: false });
      setTimeout(() => socket === this.socket && this.join(key), AGAIN);
    };
  }

  set({ on, radius }) {
    if (!on) this.end();
    this.on = on;
    this.radius = radius ?? this.radius;
    if (on) document.body.append(this.ring);
    this.ring.style.display = "none"; // until the mouse moves
  }

  // ---- strokes

  // With Shift, or with another button, viser turns the view.
  paints(event) {
    return event.button === 0 && !event.shiftKey && event.target === this.stage.above?.canvas;
  }

  begin(event) {
    if (this.pointer !== null || !this.paints(event)) return;
    event.stopImmediatePropagation();
    this.pointer = event.pointerId;
    this.path = [this.place(event)];
    this.first = true;
    this.send();
  }

  move(event) {
    const { ring, radius } = this;
    const over = event.target === this.stage.above?.canvas;
    ring.style.display = over || this.pointer !== null ? "block" : "none";
    ring.style.left = `${event.clientX - radius}px`;
    ring.style.top = `${event.clientY - radius}px`;
    ring.style.width = ring.style.height = `${2 * radius}px`;
    if (event.pointerId !== this.pointer) return;
    event.stopImmediatePropagation();
    this.path.push(this.place(event));
    if (this.path.length >= MOST) this.send();
    else this.later ??= setTimeout(() => this.send(), EVERY);
  }

  end() {
    if (this.pointer === null) return;
    if (this.path.length > 1) this.send();
    clearTimeout(this.later);
    this.pointer = this.path = this.later = null;
  }

  // A double click: the server takes what hangs together there.
  take(event) {
    if (!this.paints(event)) return;
    event.stopImmediatePropagation();
    this.tell("part", true, [this.place(event)]);
  }

  place({ clientX, clientY }) {
    const { left, top } = this.stage.above.canvas.getBoundingClientRect();
    return [clientX - left, clientY - top];
  }

  send() {
    clearTimeout(this.later);
    this.later = null;
    if (this.path === null) return;
    this.tell("stroke", this.first, this.path);
    this.first = false;
    this.path = this.path.slice(-1); // the next piece goes on from here
  }

  tell(kind, first, path) {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    const { canvas, camera } = this.stage.above;
    const size = [canvas.clientWidth, canvas.clientHeight];
    const { fov, near, matrixWorld } = camera;
    this.socket.send(JSON.stringify({ kind, first, path, size, fov, near, matrix: [...matrixWorld.elements] }));
  }
}
