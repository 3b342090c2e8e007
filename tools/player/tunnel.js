// What the live page and a page that simulates share: the bar, the panel, the pull, the link, and states in step with the clock.
import * as THREE from "three";
import { button, element, Panel, playButton } from "./panel.js";
import { Playback } from "./playback.js";

const SLOW = 0.25; // simulated seconds per second in slow motion
const SPEEDS = [0.05, 1];
const PICKED = 12; // pixels from the object at which a finger still takes hold of it
const FASTEST = 50; // m/s of a wind in a link

const numbers = (/** @type {string} */ text) => text.split(",").map((part) => (part.trim() === "" ? NaN : Number(part)));

export class Tunnel {
  /**
   * @param {any} view @param {(message: any) => void} say tells the solver, or the server, something
   * @param {(name: string, value: any) => void} set does what a control does
   * @param {HTMLElement[]} further buttons of the bar
   */
  constructor(view, say, set, further = []) {
    Object.assign(this, { view, say });
    this.playback = new Playback();
    this.motion = /** @type {number | null} */ (null); // counts the starts from rest
    this.playing = true;
    this.speed = 1;
    this.metre = 1; // in units of the object's size
    this.stale = false; // whether a state has come that is not drawn yet
    this.pull = /** @type {any} */ (null);
    this.count = 0; // of pulls
    this.changed = new Map(); // what was set here, for the link
    this.usual = new Map(); // what it was before
    this.panel = new Panel((name, value) => {
      this.changed.set(name, value);
      set(name, value);
    });
    const [play, show] = playButton(() => this.setPlaying(!this.playing));
    this.showPlaying = (on) => show((this.playing = on));
    this.slow = button("slow", "Slow", "Slow motion", () => this.setSpeed(this.speed < 1 ? 1 : SLOW));
    const reset = button("reset", "Reset", "Back to rest", () => this.reset());
    const more = button("more", "☰", "Controls", () => this.open(element("panel").hidden));
    element("bar").append(play, this.slow, reset, ...further, button("link", "Link", "Copy a link with these settings", () => this.copy()), more);
    this.open(innerWidth > 900);
    this.listen();
    this.follow();
  }

  open(on) {
    element("panel").hidden = !on;
    element("more").setAttribute("aria-expanded", String(on));
  }

  // ---- what runs

  run() {
    this.say({ kind: "run", on: this.playing && !document.hidden, speed: this.speed });
  }

  setPlaying(on) {
    this.showPlaying(on);
    this.run();
  }

  setSpeed(speed) {
    this.speed = Math.min(Math.max(speed, SPEEDS[0]), SPEEDS[1]);
    this.slow.setAttribute("aria-pressed", String(this.speed < 1));
    this.run();
  }

  reset() {
    this.say({ kind: "reset" });
  }

  listen() {
    addEventListener("hashchange", () => this.apply(location.hash, true));
    addEventListener("message", ({ data }) => {
      // what <gaussian-swaying> says when its attributes change
      if (typeof data?.gaussianSwaying === "string") this.apply(data.gaussianSwaying, true);
    });
  }

  // ---- the link: #wind=4,0,0&gusts=0.5&speed=0.25&view=x,y,z,x,y,z, with the names of controls

  link() {
    const { camera, controls } = this.view;
    const one = (part) => (typeof part === "number" ? String(Number(part.toPrecision(5))) : part);
    const text = (value) => [value].flat().map(one).join(",");
    const place = [...camera.position.toArray(), ...controls.target.toArray()].map((part) => Number(part.toFixed(3)));
    const given = [...this.changed].filter(([, value]) => value !== null && typeof value !== "boolean");
    if (this.speed !== 1) given.push(["speed", this.speed]);
    return `${location.href.split("#")[0]}#${[...given, ["view", place]].map(([name, value]) => `${name}=${text(value)}`).join("&")}`;
  }

  async copy() {
    const link = this.link();
    history.replaceState(null, "", link);
    const copied = await navigator.clipboard?.writeText(link).then(() => true, () => false);
    element("link").textContent = copied ? "Copied" : "In the address";
    setTimeout(() => (element("link").textContent = "Link"), 2000);
  }

  /** Set what a link says, as far as it can be; with `whole`, what it does not say is as it was at first, but for the view. */
  apply(text, whole = false) {
    const given = new URLSearchParams(text.replace(/^[#?]/, ""));
    const view = numbers(given.get("view") ?? "");
    if (view.length === 6 && view.every(Number.isFinite) && Math.hypot(view[0] - view[3], view[1] - view[4], view[2] - view[5]) > 0) {
      this.view.camera.position.fromArray(view);
      this.view.controls.target.fromArray(view, 3);
      this.view.controls.update();
    }
    const speed = Number(given.get("speed") || NaN);
    if (Number.isFinite(speed)) this.setSpeed(speed);
    else if (whole) this.setSpeed(1);
    if (whole)
      for (const name of [...this.changed.keys()].filter((known) => !given.has(known))) {
        this.panel.set(name, this.usual.get(name));
        this.changed.delete(name);
      }
    for (const [name, value] of given) {
      const control = this.panel.controls.get(name);
      const parts = numbers(value);
      if (control?.kind === "choice" && control.options.includes(value)) this.panel.set(name, value);
      else if (["range", "number"].includes(control?.kind) && parts.length === 1 && Number.isFinite(parts[0])) this.panel.set(name, parts[0]);
      else if (control?.kind === "dial" && parts.length === 3 && parts.every(Number.isFinite) && Math.hypot(...parts) <= FASTEST) this.panel.set(name, parts);
    }
  }

  /** Show groups of controls; the first values of each are what it is usually. */
  show(groups) {
    this.panel.show(groups);
    for (const [name, { value }] of this.panel.controls) if (!this.usual.has(name)) this.usual.set(name, value);
  }

  // ---- pulling: the first finger that meets the object takes hold of it; all others move the camera

  follow() {
    const { canvas, camera, controls } = this.view;
    const caster = new THREE.Raycaster();
    const pointers = new Map();
    const metres = (/** @type {THREE.Vector3} */ place) => place.toArray().map((part) => part / this.metre);
    const pick = ({ pointerId, pointerType, clientX, clientY, button, buttons, isPrimary }) =>
      ({ pointerId, pointerType, clientX, clientY, pageX: clientX, pageY: clientY, button, buttons, isPrimary });

    const rayAt = (event) => {
      const { left, top, width, height } = canvas.getBoundingClientRect();
      const at = new THREE.Vector2(((event.clientX - left) / width) * 2 - 1, 1 - ((event.clientY - top) / height) * 2);
      caster.setFromCamera(at, camera);
      return caster.ray;
    };
    const pass = (event) => {
      controls.enabled = true;
      canvas.dispatchEvent(new PointerEvent("pointerdown", { ...pick(event), bubbles: true }));
    };
    const letGo = () => {
      if (this.pull?.held) this.say({ kind: "release" });
      this.pull = null;
      controls.enabled = true;
    };
    const aim = (event) => {
      const target = rayAt(event).intersectPlane(this.pull.plane, new THREE.Vector3());
      if (target) this.say({ kind: "aim", target: metres(target) });
    };

    // The answer to a grab: the place that was taken hold of [m], or null.
    this.grabbed = ({ token, place }) => {
      if (this.pull?.token !== token) return place && this.say({ kind: "release" });
      const { event } = this.pull;
      if (!place) {
        this.pull = null;
        return pass(pointers.get(event.pointerId) ?? event);
      }
      const at = new THREE.Vector3(...place).multiplyScalar(this.metre);
      this.pull.held = true;
      this.pull.plane = new THREE.Plane().setFromNormalAndCoplanarPoint(camera.getWorldDirection(new THREE.Vector3()), at);
      canvas.style.cursor = "grabbing";
      aim(pointers.get(event.pointerId) ?? event);
    };

    canvas.addEventListener(
      "pointerdown",
      (event) => {
        if (!event.isTrusted) return;
        pointers.set(event.pointerId, event);
        if (this.pull) {
          const { event: first } = this.pull;
          letGo();
          return pass(pointers.get(first.pointerId) ?? first);
        }
        if (event.button !== 0 || event.ctrlKey || event.shiftKey || pointers.size > 1 || !this.playing) return;
        event.stopImmediatePropagation();
        const { origin, direction } = rayAt(event);
        this.pull = { event, token: ++this.count, held: false };
        const wide = (PICKED * 2 * Math.tan((camera.fov * Math.PI) / 360)) / canvas.clientHeight;
        this.say({ kind: "grab", eye: metres(origin), ray: direction.toArray(), wide, token: this.count });
      },
      { capture: true },
    );
    canvas.addEventListener("pointermove", (event) => {
      if (pointers.has(event.pointerId)) pointers.set(event.pointerId, event);
      if (this.pull?.held && event.pointerId === this.pull.event.pointerId) aim(event);
    });
    for (const name of ["pointerup", "pointercancel"])
      addEventListener(name, (event) => {
        const { pointerId } = /** @type {PointerEvent} */ (event);
        pointers.delete(pointerId);
        if (this.pull?.event.pointerId !== pointerId) return;
        letGo();
        canvas.style.cursor = "";
      });
  }

  // ---- states

  /** A state: its time [s], the displacement of all nodes [m], four numbers each, and the motion that it belongs to. */
  take(state) {
    if (state.motion !== this.motion) this.playback.clear();
    this.motion = state.motion;
    this.stale = true;
    this.playback.add(state, performance.now() / 1000, state.ended);
  }

  tick(now) {
    const { playback, view } = this;
    const before = playback.shown;
    playback.advance(now / 1000);
    if (playback.newest !== null && (this.stale || playback.shown !== before)) {
      this.stale = false;
      view.move((data) => playback.write(data));
    }
    const { camera, controls } = view;
    this.panel.timeline?.tick(playback.shown);
    this.panel.face(Math.atan2(camera.position.y - controls.target.y, camera.position.x - controls.target.x) + Math.PI / 2);
  }

  // See Drawing.positions, of the newest state.
  positions() {
    this.playback.shown = this.playback.newest;
    this.stale = true;
    this.view.wake(3);
    return this.view.positions();
  }
}
