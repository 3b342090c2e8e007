// A body that sways by its modes; the definition is gaussian_swaying/mpm/modes.py, and the kernels are those of mpm/modal_kernels.py.
import { Body } from "./body.js";

export class ModalSolver extends Body {
  /** @param {{head: any, arrays: Record<string, any>}} block */
  constructor(block) {
    super(block);
    const { omega } = this.a;
    const count = omega.length;
    for (const name of ["sites", "nodes"]) {
      const { [name]: shape, [`${name}Step`]: step } = this.a;
      this.tables[name].set(Float32Array.from(shape, (x, i) => x * step[Math.floor(i / count)] * omega[i % count]));
    }
    this.reset();
  }

  /** Back to rest. */
  reset() {
    super.reset();
    this.tables.q.fill(0);
    this.tables.p.fill(0);
  }

  /**
   * Advance by one frame.
   * @returns {number} substeps
   */
  advance() {
    const { tables, kernels, head } = this;
    const { frameDt, substep, damping, viscous, substeps: [longest, shortest, wanted] } = head;
    const steps = Math.ceil(frameDt / (substep ?? Math.min(Math.max(wanted / Math.sqrt(this.stiffness), shortest), longest)) - 1e-9);
    const dt = frameDt / steps;
    tables.numbers.set([dt, this.stiffness, damping, viscous]);
    kernels.factors();
    tables.factor.set(tables.factors);
    tables.ahead[0] = 0.5 * dt;
    const kind = this.pull ? "held" : "free";
    for (let k = 0; k < steps; k++) {
      this.blow([this.time + 0.5 * dt]);
      kernels[kind]();
      if (k === 0) kernels[`${kind}Drag`]();
      kernels.swing();
      this.time += dt;
    }
    if (!tables.q.every(Number.isFinite)) throw new Error("the motion has become too fast to be computed");
    return steps;
  }

  /** As in Body, but of the mass that resists there: a few modes bend less around a place than the material does. */
  grab(eye, ray, wide) {
    this.tables.ahead[0] = 0;
    const found = super.grab(eye, ray, wide);
    if (found === null) return null;
    const { held } = this.pull;
    const rows = 3 * this.a.omega.length; // of the shapes of a site
    let mobility = 0;
    this.tables.sites.subarray(0, rows * this.points).forEach((x, i) => (mobility += (held[Math.floor(i / rows)] * x * x) / 3));
    for (let s = 0; s < this.points; s++) held[s] /= mobility;
    return found;
  }

  /** Displacements of the nodes that Gaussians follow [m], four numbers each. */
  drawn() {
    this.tables.ahead[0] = 0;
    this.kernels.show();
    return this.tables.shown.slice();
  }
}
