// Paints parts in the live page: what the mouse does goes to the server, which finds the Gaussians. See docs/parts.md.
import { make } from "./panel.js";

const EVERY = 30; // ms between two messages of a stroke
const MOST = 60; // corners of a path in a message

export class Brush {
  /** @param {any} view @param {(message: any) => void} say */
  constructor(view, say) {
    Object.assign(this, { view, say });
    this.own = { on: false, radius: 20 }; // what the panel says
    this.path = null; // of the stroke that is being made, as far as it was not sent
    this.pointer = null;
    this.ring = make("div", { id: "ring", hidden: true });
    document.body.append(this.ring);
    const listen = (name, act) => addEventListener(name, (event) => this.own.on && act(event), { capture: true });
    listen("pointerdown", (event) => this.begin(event));
    listen("pointermove", (event) => this.move(event));
    listen("pointerup", (event) => event.pointerId === this.pointer && this.end());
    listen("pointercancel", (event) => event.pointerId === this.pointer && this.end());
    listen("blur", (event) => event.target === window && this.end()); // not that of a control
    listen("dblclick", (event) => this.take(event));
  }

  set(own) {
    if (!own.on) this.end();
    this.own = own;
    this.ring.hidden ||= !own.on; // shown when the mouse moves
  }

  // With Shift, or with another button, the mouse turns the view.
  paints(event) {
    return event.button === 0 && !event.shiftKey && event.target === this.view.canvas;
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
    const { radius } = this.own;
    this.ring.hidden = event.target !== this.view.canvas && this.pointer === null;
    Object.assign(this.ring.style, { left: `${event.clientX - radius}px`, top: `${event.clientY - radius}px` });
    this.ring.style.width = this.ring.style.height = `${2 * radius}px`;
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
    this.tell([this.place(event)], this.own.how);
  }

  place({ clientX, clientY }) {
    return [clientX, clientY];
  }

  send() {
    clearTimeout(this.later);
    this.later = null;
    if (this.path === null) return;
    this.tell(this.path);
    this.first = false;
    this.path = this.path.slice(-1); // the next piece goes on from here
  }

  tell(path, how = null) {
    const { camera } = this.view;
    const { part, radius, through } = this.own;
    const look = { matrix: camera.matrixWorld.elements, fov: camera.fov, near: camera.near, size: [innerWidth, innerHeight] };
    this.say({ kind: "brush", path, how, first: this.first, part, radius, through, ...look });
  }
}
