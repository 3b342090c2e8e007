// Which simulated time is shown between the states that have arrived, when a simulation is watched while it runs.

const KEPT = 64; // states that wait; older ones are left out
const MEMORY = 1.5; // s of arrivals that the speed is measured from
const FASTEST = 2; // simulated seconds per second
const LAST = 0.5; // s in which the last state is reached before a pause
const MOST_LATE = 1.0; // s that the picture may lag behind the newest state

// The shown time lags behind the newest state by a little more than the states are apart, so that there is mostly a later
// state to move towards. It never runs backwards, and never past the newest state.
export class Playback {
  constructor() {
    this.clear();
  }

  // Forget all states, as the motion starts again.
  clear() {
    this.states = []; // rising in time; the first is the last one before what is shown
    this.arrivals = []; // when a state arrived [s], and its time
    this.shown = null; // simulated time [s]
    this.speed = 1; // simulated seconds per second
    this.last = null; // when it was advanced last [s]
    this.ended = false;
  }

  get newest() {
    return this.states.length ? this.states[this.states.length - 1].time : null;
  }

  // Add a state: an object with a time [s]. `now` is the browser's clock [s]; `ended` says that no other follows for now.
  add(state, now, ended = false) {
    if (this.states.length && state.time < this.newest) this.clear();
    if (state.time === this.newest) this.states.pop();
    else this.arrived(state.time, now);
    this.states.push(state);
    if (this.states.length > KEPT) this.states.splice(0, this.states.length - KEPT);
    this.shown = Math.max(this.shown ?? state.time, this.states[0].time);
    this.ended = ended;
    this.rush = (this.newest - this.shown) / LAST;
  }

  arrived(time, now) {
    if (this.ended) this.arrivals = []; // a pause says nothing about the speed
    this.arrivals.push([now, time]);
    while (this.arrivals.length > 3 && now - this.arrivals[0][0] > MEMORY) this.arrivals.shift();
    const [first, passed] = [this.arrivals[0], now - this.arrivals[0][0]];
    if (passed > 0) this.speed = Math.min((time - first[1]) / passed, FASTEST);
  }

  // Seconds by which the picture lags behind the arrival of states: a little more than the longest time between two.
  get delay() {
    let longest = 0;
    for (let i = 1; i < this.arrivals.length; i++)
      longest = Math.max(longest, this.arrivals[i][0] - this.arrivals[i - 1][0]);
    return Math.min(1.2 * longest + 0.01, MOST_LATE);
  }

  // Move on to a later moment [s]; returns the shown time, null without a state.
  advance(now) {
    const passed = this.last === null ? 0 : Math.min(Math.max(now - this.last, 0), MOST_LATE);
    this.last = now;
    if (!this.states.length) return null;
    let step = passed * this.speed;
    if (this.ended) step = Math.max(step, passed * this.rush);
    else if (this.arrivals.length > 1) {
      // where the simulation is by now, if it goes on as it did, less the delay
      const { delay } = this;
      const waited = now - this.arrivals[this.arrivals.length - 1][0];
      const wanted = this.newest + this.speed * (Math.min(waited, delay) - delay);
      const behind = wanted - (this.shown + step);
      if (behind > 2 * MOST_LATE * this.speed) step += behind; // as after the window was hidden
      else step *= Math.min(Math.max(1 + (0.5 * behind) / (this.speed * delay), 0.5), 1.5);
    }
    this.shown = Math.min(this.shown + step, this.newest);
    while (this.states.length > 1 && this.states[1].time <= this.shown) this.states.shift();
    return this.shown;
  }

  // The states before and after what is shown, and how far it is on the way from one to the other.
  between() {
    const [from, to = from] = this.states;
    const way = to.time - from.time;
    return [from, to, way > 0 ? Math.min(Math.max((this.shown - from.time) / way, 0), 1) : 0];
  }

  // Write the displacements of the nodes that are shown.
  write(data) {
    const [from, to, weight] = this.between();
    for (let i = 0; i < from.moved.length; i++) data[i] = from.moved[i] + weight * (to.moved[i] - from.moved[i]);
  }
}
