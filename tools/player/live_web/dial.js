// An arrow on a round dial: the wind seen from above, turned with the view. Dragging it sets direction and speed.

const STEP = 0.5; // m/s of an arrow key
const SVG = "http://www.w3.org/2000/svg";

export class Dial {
  /**
   * @param {HTMLElement} element gets the dial @param {number} most speed at its rim [m/s]
   * @param {(flow: number[]) => void} changed called with the horizontal flow [m/s], x and y
   */
  constructor(element, most, changed) {
    Object.assign(this, { element, most, changed });
    this.flow = [0, 0];
    this.turn = 0; // of the view about up [rad]
    const svg = document.createElementNS(SVG, "svg");
    svg.setAttribute("viewBox", "-50 -50 100 100");
    svg.innerHTML =
      '<circle r="48" class="rim"/><circle r="24" class="ring"/><path class="arrow" d=""/><circle r="7" class="knob"/>';
    element.append(svg);
    this.arrow = /** @type {SVGPathElement} */ (svg.querySelector(".arrow"));
    this.knob = /** @type {SVGCircleElement} */ (svg.querySelector(".knob"));
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      this.point(event);
    });
    element.addEventListener("pointermove", (event) => element.hasPointerCapture(event.pointerId) && this.point(event));
    element.addEventListener("keydown", (event) => this.press(event));
  }

  /** @param {PointerEvent} event */
  point(event) {
    const { left, top, width } = this.element.getBoundingClientRect();
    const half = width / 2;
    const [x, y] = [(event.clientX - left - half) / (0.96 * half), (half - (event.clientY - top)) / (0.96 * half)];
    const size = Math.hypot(x, y);
    const scale = (this.most * Math.min(size, 1)) / (size || 1);
    this.give(this.turned([x * scale, y * scale], this.turn));
  }

  /** @param {KeyboardEvent} event */
  press(event) {
    const steps = { ArrowUp: [0, STEP], ArrowDown: [0, -STEP], ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0] };
    const step = steps[event.key];
    if (!step) return;
    event.preventDefault();
    const [x, y] = this.turned(step, this.turn);
    this.give([this.flow[0] + x, this.flow[1] + y]);
  }

  turned([x, y], angle) {
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    return [c * x - s * y, s * x + c * y];
  }

  give(flow) {
    this.show(flow, this.turn);
    this.changed(this.flow);
  }

  /** Show a flow [m/s] in a view that is turned about up [rad]. */
  show(flow, turn) {
    const size = Math.hypot(...flow);
    const scale = size > this.most ? this.most / size : 1;
    this.flow = flow.map((part) => part * scale);
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
