// The timeline of the wind: curves over time through keys that are added, dragged and removed. See gaussian_swaying/player/panel.py.
import { element, make } from "./panel.js";

const SVG = "http://www.w3.org/2000/svg";
const [HIGH, GAP, LEFT, RIGHT, AXIS] = [44, 8, 98, 12, 18]; // pixels: of a track, between two, beside them, below
const SHORTEST = 10; // s
const RADIUS = 6; // pixels, of a key
const APART = 0.01; // s between two keys of a track, at least
const PATIENCE = 3000; // ms in which a change is taken, or refused
const MOVES = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }; // s, and hundredths of a track
const HINT = "Double click adds a key, dragging moves it, right click or Delete removes it. Reset plays from the start.";

/** @param {string} tag @param {Record<string, any>} given @returns {any} */
function draw(tag, given, text = "") {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(given)) made.setAttribute(name, value);
  made.textContent = text;
  return made;
}

/** An angle above -180 and up to 180. @param {number} angle */
const half = (angle) => 180 - ((((180 - angle) % 360) + 360) % 360);

export class Timeline {
  /** @param {any} control @param {(value: any) => void} changed called with all keys when one is another */
  constructor(control, changed) {
    Object.assign(this, { tracks: control.tracks, changed, value: null, held: null, chosen: null, clock: null });
    this.svg = draw("svg", { role: "group", "aria-label": "Wind over time" });
    this.hint = make("small", { textContent: HINT });
    element("timeline").replaceChildren(this.hint, this.svg);
    for (const [name, act] of Object.entries({ dblclick: this.add, pointerdown: this.hold, pointermove: this.drag, pointerup: this.drop, contextmenu: this.remove, keydown: this.press }))
      this.svg.addEventListener(name, (event) => act.call(this, event));
    new ResizeObserver(() => this.value && this.draw()).observe(this.svg);
  }

  /** Show keys: of each track pairs of time [s] and value, and the value of a track without. */
  show(value) {
    const text = JSON.stringify(value);
    this.told = value;
    if (JSON.stringify(value.keys) === this.sent) this.sent = null;
    if (this.held || this.sent || text === this.text) return; // another picture would end a double click
    Object.assign(this, { value, text });
    const last = Math.max(0, ...Object.values(value.keys).flat().map(([time]) => time));
    this.length = Math.max(SHORTEST, Math.ceil(1.25 * last));
    this.draw();
  }

  // ---- places

  x(time) {
    return LEFT + (time / this.length) * (this.svg.clientWidth - LEFT - RIGHT);
  }

  y(index, value) {
    const { low, high } = this.tracks[index];
    return GAP + index * (HIGH + GAP) + HIGH * (1 - (value - low) / (high - low));
  }

  // The track, time and value at a pointer, rounded.
  at({ clientX, clientY }, index = null) {
    const { left, top } = this.svg.getBoundingClientRect();
    const found = index ?? Math.floor((clientY - top - GAP / 2) / (HIGH + GAP));
    const time = ((clientX - left - LEFT) / (this.svg.clientWidth - LEFT - RIGHT)) * this.length;
    return { index: found, ...this.rounded(found, Math.min(time, this.length), 1 - (clientY - top - GAP - found * (HIGH + GAP)) / HIGH) };
  }

  rounded(index, time, share) {
    const { low, high, digits } = this.tracks[index] ?? this.tracks[0];
    const value = low + Math.min(Math.max(share, 0), 1) * (high - low);
    return { time: Number(Math.max(time, 0).toFixed(2)), value: Number(value.toFixed(digits)) };
  }

  // ---- what is done to keys

  keys(index) {
    return this.value.keys[this.tracks[index].name];
  }

  // The index of the track and of the key that an event is about; null if it is about none.
  key({ target }) {
    return target.dataset.key ? target.dataset.key.split(",").map(Number) : null;
  }

  add(event) {
    const { index, time, value } = this.at(event);
    if (this.key(event) || !this.tracks[index]) return;
    const keys = this.keys(index);
    const place = keys.filter(([other]) => other < time).length;
    if (keys.some(([other]) => Math.abs(this.x(other) - this.x(time)) < RADIUS)) return;
    keys.splice(place, 0, [time, value]);
    this.chosen = [index, place];
    this.give();
  }

  hold(event) {
    this.held = event.button === 0 ? this.key(event) : null;
    if (!this.held) return;
    this.chosen = this.held;
    this.moved = false;
    this.svg.setPointerCapture(event.pointerId);
    this.draw();
    event.preventDefault();
  }

  drag(event) {
    if (this.held) this.move(this.held, this.at(event, this.held[0]));
  }

  drop() {
    const moved = this.held && this.moved;
    this.held = null;
    if (moved) this.give();
  }

  remove(event) {
    event.preventDefault();
    const found = this.key(event);
    if (!found) return;
    this.keys(found[0]).splice(found[1], 1);
    this.chosen = null;
    this.give();
  }

  press(event) {
    const [found, way] = [this.key(event), MOVES[event.key]];
    if (found && ["Delete", "Backspace"].includes(event.key)) this.remove(event);
    if (!found || !way) return;
    event.preventDefault();
    const [time, value] = this.keys(found[0])[found[1]];
    const { low, high } = this.tracks[found[0]];
    this.move(found, this.rounded(found[0], time + way[0], (value - low) / (high - low) + way[1] / 100));
    this.give();
  }

  // Move a key, no further than to its neighbours.
  move([index, place], { time, value }) {
    const keys = this.keys(index);
    const [low, high] = [(keys[place - 1]?.[0] ?? -APART) + APART, (keys[place + 1]?.[0] ?? Infinity) - APART];
    keys[place] = [Number(Math.min(Math.max(time, low), high).toFixed(2)), value];
    this.moved = true;
    this.draw();
  }

  // Tell all keys; what the server says before it has taken them is older.
  give() {
    const told = this.value;
    this.sent = null;
    this.show(told);
    this.sent = JSON.stringify(told.keys);
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => {
      this.sent = null;
      this.show(this.told);
    }, PATIENCE);
    this.changed(told);
  }

  // ---- the picture

  words(index, [time, value]) {
    const { label, unit } = this.tracks[index];
    return `${label} ${value} ${unit} at ${time} s`;
  }

  // The curve of a track; a turn that leaves its track at one end comes back at the other.
  curve(index, given) {
    const { name, turns } = this.tracks[index];
    const keys = given.length ? given.map(([time, value]) => [time, turns ? half(value) : value]) : [[0, this.value.usual[name]]];
    const ends = [[0, keys[0][1]], ...keys, [this.length, keys[keys.length - 1][1]]];
    const parts = ends.slice(1).flatMap(([time, value], k) => {
      const [from, before] = ends[k];
      const to = turns ? before + half(value - before) : value;
      return (turns ? [-360, 0, 360] : [0]).map((round) => {
        const [start, end] = [this.y(index, before + round), this.y(index, to + round)];
        return `M${this.x(from)} ${start}` + (this.value.step ? `H${this.x(time)}V${end}` : `L${this.x(time)} ${end}`);
      });
    });
    return parts.join("");
  }

  draw() {
    const { svg, tracks } = this;
    const [width, height] = [svg.clientWidth, GAP + tracks.length * (HIGH + GAP)];
    svg.style.height = `${height + AXIS}px`;
    const made = [];
    tracks.forEach(({ name, label, unit, low, high, turns }, index) => {
      const [top, keys] = [this.y(index, high), this.keys(index)];
      const clip = draw("clipPath", { id: `track-${name}` });
      clip.append(draw("rect", { x: LEFT, y: top, width: Math.max(width - LEFT - RIGHT, 0), height: HIGH }));
      made.push(clip, draw("rect", { class: "track", x: LEFT, y: top, width: Math.max(width - LEFT - RIGHT, 0), height: HIGH, rx: 6 }));
      made.push(draw("text", { x: 0, y: top + 18 }, label), draw("text", { x: 0, y: top + 34, class: "soft" }, unit));
      for (const [value, down] of [[high, 10], [low, 0]]) made.push(draw("text", { x: LEFT - 5, y: this.y(index, value) + down, class: "soft end" }, String(value)));
      made.push(draw("path", { class: keys.length ? "curve" : "curve usual", d: this.curve(index, keys), "clip-path": `url(#track-${name})` }));
      keys.forEach((key, place) => {
        const at = { cx: this.x(key[0]), cy: this.y(index, turns ? half(key[1]) : Math.min(key[1], high)), r: RADIUS, "data-key": `${index},${place}` };
        const knob = draw("circle", { ...at, tabindex: 0, role: "button", "aria-label": this.words(index, key) });
        knob.append(draw("title", {}, this.words(index, key)));
        made.push(knob);
      });
    });
    const step = [1, 2, 5, 10, 20, 60, 300, 1800].find((size) => this.length / size <= 12) ?? 7200;
    for (let time = 0; time <= this.length; time += step) made.push(draw("text", { x: this.x(time), y: height + 12, class: "soft middle" }, time ? String(time) : "0 s"));
    this.line = draw("line", { class: "now", y1: GAP, y2: height - GAP });
    svg.replaceChildren(...made, this.line);
    const key = this.chosen && this.keys(this.chosen[0])?.[this.chosen[1]];
    this.hint.textContent = key ? this.words(this.chosen[0], key) : HINT;
    if (key) svg.querySelector(`[data-key="${this.chosen}"]`).focus();
    this.tick(this.clock);
  }

  /** The time that is shown [s]. @param {number | null} time */
  tick(time) {
    this.clock = time;
    const there = time !== null && time <= this.length;
    this.line?.setAttribute("visibility", there ? "visible" : "hidden");
    if (there) for (const name of ["x1", "x2"]) this.line?.setAttribute(name, String(this.x(time)));
  }
}
