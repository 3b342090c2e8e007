// The controls of a page, made from descriptions: name, label, kind, ends, unit and value of each. See gaussian_swaying/player/panel.py.
import { Timeline } from "./timeline.js";

const HOLD = 800; // ms in which a control that was just used keeps its value, whatever the server says
const STEPS = 200; // of a slider
const STEP = 0.5; // m/s of an arrow key on the dial
const SVG = "http://www.w3.org/2000/svg";

export const element = (/** @type {string} */ name) => /** @type {any} */ (document.getElementById(name));

/** Makes an element. @param {string} tag @param {any} fields @param {(Node | string)[]} inside @returns {any} */
export function make(tag, fields = {}, ...inside) {
  const made = Object.assign(document.createElement(tag), fields);
  made.append(...inside);
  return made;
}

/** A button with an id, a text, a label for those who do not see it, and what it does. */
export function button(id, text, label, act) {
  const made = make("button", { id, type: "button", textContent: text, title: label });
  made.setAttribute("aria-label", label);
  made.addEventListener("click", act);
  return made;
}

/** The button that plays and pauses, which the space bar presses as well, and what shows its state. @returns {[any, (on: boolean) => void]} */
export function playButton(act) {
  const made = button("play", "❚❚", "Pause", act);
  addEventListener("keydown", (event) => {
    if (event.key !== " " || /** @type {Element} */ (event.target).closest?.("button, input:not([type=range]), select, summary")) return;
    event.preventDefault();
    act();
  });
  return [made, (on) => (made.textContent = on ? "❚❚" : "▶") && made.setAttribute("aria-label", on ? "Pause" : "Play")];
}

/** A number with three digits. @param {number} value */
const short = (value) => String(Number(value.toPrecision(3)));

/** The wind seen from above: an arrow on a round dial, turned with the view. Dragging it sets direction and speed. */
class Dial {
  constructor(control, changed) {
    Object.assign(this, { most: control.high, changed, flow: [0, 0, 0], turn: 0 });
    this.element = make("div", { id: "dial", tabIndex: 0, title: "Wind, seen from above" });
    this.element.setAttribute("role", "application");
    const svg = document.createElementNS(SVG, "svg");
    svg.setAttribute("viewBox", "-50 -50 100 100");
    svg.innerHTML = '<circle r="48" class="rim"/><circle r="24" class="ring"/><path class="arrow" d=""/><circle r="7" class="knob"/>';
    this.element.append(svg);
    [this.arrow, this.knob] = [".arrow", ".knob"].map((part) => svg.querySelector(part));
    const at = (event) => this.element.hasPointerCapture(event.pointerId) && this.point(event);
    this.element.addEventListener("pointerdown", (event) => {
      this.element.setPointerCapture(event.pointerId);
      at(event);
    });
    this.element.addEventListener("pointermove", at);
    this.element.addEventListener("keydown", (event) => this.press(event));
  }

  point(event) {
    const { left, top, width } = this.element.getBoundingClientRect();
    const half = width / 2;
    const [x, y] = [(event.clientX - left - half) / (0.96 * half), (half - (event.clientY - top)) / (0.96 * half)];
    const size = Math.hypot(x, y);
    const scale = (this.most * Math.min(size, 1)) / (size || 1);
    this.give(this.turned([x * scale, y * scale], this.turn));
  }

  press(event) {
    const step = { ArrowUp: [0, STEP], ArrowDown: [0, -STEP], ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0] }[event.key];
    if (!step) return;
    event.preventDefault();
    const [x, y] = this.turned(step, this.turn);
    this.give([this.flow[0] + x, this.flow[1] + y]);
  }

  turned([x, y], angle) {
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    return [c * x - s * y, s * x + c * y];
  }

  give([x, y]) {
    this.show([x, y, this.flow[2]], this.turn);
    this.changed(this.flow);
  }

  /** Show a flow [m/s] in a view that is turned about up [rad]. */
  show(flow, turn) {
    const size = Math.hypot(flow[0], flow[1]);
    const scale = size > this.most ? this.most / size : 1;
    this.flow = [flow[0] * scale, flow[1] * scale, flow[2]];
    this.turn = turn;
    const [x, y] = this.turned(this.flow, -turn).map((part) => (48 * part) / this.most);
    this.knob.setAttribute("cx", x.toFixed(2));
    this.knob.setAttribute("cy", (-y).toFixed(2));
    this.arrow.setAttribute("d", `M0 0L${x.toFixed(2)} ${(-y).toFixed(2)}`);
    const speed = Math.hypot(...this.flow).toFixed(1);
    this.element.setAttribute("aria-label", `Wind of ${speed} m/s`);
    this.element.dataset.speed = `${speed} m/s`;
  }
}

/** A field for a number that calls back when someone has typed one, not when it is left with the number it was given meanwhile. */
function numberField({ low, high }, changed) {
  const field = make("input", { type: "number", min: low, max: high, step: "any" });
  let typed = false;
  field.addEventListener("input", () => (typed = true));
  field.addEventListener("change", () => typed && Number.isFinite(field.valueAsNumber) && changed(field.valueAsNumber));
  const show = (now) => {
    field.value = short(now);
    typed = false;
  };
  return { field, show };
}

/** What each kind of control has: its elements, how it shows a value, and what it calls when it is used. */
const KINDS = {
  range(control, changed) {
    const { low, high, log, unit } = control;
    const [place, value] = log ? [Math.log10, (at) => 10 ** at] : [Number, Number];
    const [first, last] = [place(low), place(high)];
    const slider = make("input", { type: "range", min: first, max: last, step: log ? (last - first) / STEPS : "any" });
    const { field, show: fill } = numberField(control, changed);
    const show = (now) => {
      slider.value = String(place(Math.min(Math.max(now, low), high)));
      fill(now);
      slider.setAttribute("aria-valuetext", `${short(now)} ${unit}`);
    };
    slider.addEventListener("input", () => {
      const now = Number(short(value(Number(slider.value))));
      show(now);
      changed(now);
    });
    return { parts: [make("label", {}, make("span", { textContent: unit ? `${control.label} [${unit}]` : control.label }), field), slider], show, named: [slider, field] };
  },
  number(control, changed) {
    const { field, show } = numberField(control, changed);
    const text = control.unit ? `${control.label} [${control.unit}]` : control.label;
    return { parts: [make("label", {}, make("span", { textContent: text }), field)], show, named: [field] };
  },
  choice(control, changed) {
    const list = make("select", {}, ...control.options.map((value) => make("option", { value, textContent: value || "…" })));
    list.addEventListener("change", () => changed(list.value));
    return { parts: [make("label", {}, make("span", { textContent: control.label }), list)], show: (now) => (list.value = now), named: [list] };
  },
  toggle(control, changed) {
    const box = make("input", { type: "checkbox" });
    box.addEventListener("change", () => changed(box.checked));
    return { parts: [make("label", {}, make("span", { textContent: control.label }), box)], show: (now) => (box.checked = now), named: [box] };
  },
  button(control, changed) {
    const made = Object.assign(button("", control.label, control.label, () => changed(null)), { title: control.hint });
    return { parts: [made], show() {}, named: [] };
  },
};

export class Panel {
  /** @param {(name: string, value: any) => void} changed called when a control is used */
  constructor(changed) {
    this.changed = changed;
    this.controls = new Map();
    this.shape = "";
    this.dial = this.timeline = null;
    this.turn = 0;
  }

  /** Show groups of controls: made anew if they are others than before, else with their values. */
  show(groups) {
    const shape = JSON.stringify(groups, (key, value) => (key === "value" ? undefined : value));
    if (shape !== this.shape) this.build(groups);
    this.shape = shape;
    for (const { controls } of groups) for (const { name, value } of controls) this.put(name, value);
  }

  build(groups) {
    const open = new Map([...element("controls").querySelectorAll("details")].map((part) => [part.dataset.name, part.open]));
    this.controls.clear();
    this.timeline = null;
    element("controls").replaceChildren();
    for (const { name, controls, shut } of groups) {
      const part = make("details", { open: open.get(name) ?? !shut }, make("summary", { textContent: name }));
      part.dataset.name = name;
      for (const control of controls) this.add(control, part);
      if (part.children.length > 1) element("controls").append(part);
    }
  }

  add(control, part) {
    const changed = (value) => {
      Object.assign(known, { value, used: performance.now() });
      this.changed(control.name, value);
    };
    const known = { ...control, used: -HOLD, show: (_value) => {} };
    this.controls.set(control.name, known);
    if (control.kind === "dial") {
      this.dial = new Dial(control, changed);
      element("side").replaceChildren(this.dial.element);
      known.show = (flow) => this.dial.show(flow, this.turn);
      return;
    }
    if (control.kind === "timeline") {
      this.timeline = new Timeline(control, changed);
      known.show = (value) => this.timeline.show(value);
      return;
    }
    const { parts, show, named } = KINDS[control.kind](control, changed);
    known.show = show;
    for (const input of named) {
      input.setAttribute("aria-label", control.label);
      input.name = control.name;
      if (control.hint) input.title = control.hint;
    }
    part.append(make("div", { className: "row" }, ...parts));
  }

  /** Show the value of a control; if it was used a moment ago, a moment later. */
  put(name, value) {
    const known = this.controls.get(name);
    if (value === undefined || known === undefined) return;
    clearTimeout(known.later);
    const left = HOLD - (performance.now() - known.used);
    if (left > 0) {
      known.later = setTimeout(() => known === this.controls.get(name) && this.put(name, value), left);
      return;
    }
    known.value = value;
    known.show(value);
  }

  /** Use a control, as if by hand; a number comes between its ends. */
  set(name, value) {
    const known = this.controls.get(name);
    if (known === undefined) return;
    known.value = known.kind === "range" ? Math.min(Math.max(value, known.low), known.high) : value;
    known.used = performance.now();
    known.show(known.value);
    this.changed(name, known.value);
  }

  /** The view is turned about up [rad]. */
  face(turn) {
    if (Math.abs(turn - this.turn) < 1e-3) return;
    this.turn = turn;
    this.dial?.show(this.dial.flow, turn);
  }
}
