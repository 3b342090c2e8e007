// A film of Gaussians: splats once, the displacement of grid nodes per frame. See docs/web.md.
import { Frames, readHead } from "./bundle.js";
import { button, element } from "./panel.js";
import { View } from "./view.js";

// `read(name)` gives a part of the file once it is there; `tell(sentence)` is called if the file ends too early.
export async function play(read, tell) {
  const [head, stencils] = await readHead(read);
  const frames = new Frames(head);

  const state = { frame: -1, time: 0, playing: true, last: null };
  const view = new View(element("canvas"), { takeOther: (_kind, bytes, count) => frames.add(bytes, count) });
  const { drawing } = view;
  await view.open(head, stencils, read);
  view.aimAsWritten();

  const play = button("play", "❚❚", "Pause", () => setPlaying(!state.playing));
  const slider = Object.assign(document.createElement("input"), { id: "time", type: "range", min: 0, max: head.frames - 1, value: 0 });
  slider.setAttribute("aria-label", "Time");
  const clock = Object.assign(document.createElement("span"), { id: "clock" });
  const loop = button("loop", "⟳", "Loop", () => loop.setAttribute("aria-pressed", String(!looping())));
  loop.setAttribute("aria-pressed", "true");
  element("bar").append(play, slider, clock, loop);
  const looping = () => loop.getAttribute("aria-pressed") === "true";

  function show(frame) {
    if (frame === state.frame) return;
    view.move((data) => frames.write(data, frame));
    state.frame = frame;
    slider.value = String(frame);
    const seconds = (count) => (count * head.frame_dt).toFixed(2);
    clock.textContent = `${seconds(frame)} / ${seconds(head.frames - 1)} s`;
  }

  // Show a frame, or the last one that has come so far.
  function seek(wanted) {
    const frame = Math.min(wanted, frames.loaded - 1);
    state.time = frame * head.frame_dt;
    show(frame);
  }

  function setPlaying(on) {
    if (on && state.frame === head.frames - 1) seek(0);
    state.playing = on;
    state.last = null;
    play.textContent = on ? "❚❚" : "▶";
    play.setAttribute("aria-label", on ? "Pause" : "Play");
  }

  slider.addEventListener("input", () => {
    setPlaying(false);
    seek(Number(slider.value));
  });
  window.addEventListener("keydown", (event) => {
    if (event.key !== " " || /** @type {Element} */ (event.target).closest?.("button")) return;
    event.preventDefault();
    setPlaying(!state.playing);
  });

  function tick(now) {
    if (!state.playing || view.first === null) return;
    state.time += state.last === null ? 0 : Math.min(now - state.last, 250) / 1000;
    state.last = now;
    if (frames.loaded < head.frames) state.time = Math.min(state.time, (frames.loaded - 1) * head.frame_dt);
    if (state.time >= frames.duration && !looping()) {
      seek(head.frames - 1);
      setPlaying(false);
    } else {
      state.time %= frames.duration;
      show(frames.at(state.time));
    }
  }

  show(0);
  setPlaying(true);
  view.begin(tick);
  const complete = view.takeRest();
  complete.catch((error) => {
    console.info(error.message);
    tell(error.message);
  });

  // Indices of depths in the order in which they would be drawn.
  async function order(depths) {
    const readback = new Uint32Array(Float32Array.from(depths).buffer);
    const call = { numSplats: depths.length, readback, ordering: new Uint32Array(depths.length) };
    const { activeSplats, ordering } = await drawing.spark.sortWorker.call("sortSplats32", call);
    return ordering.subarray(0, activeSplats);
  }

  window.film = {
    head,
    frame: () => state.frame,
    drawn: () => view.drawn,
    first: () => view.first,
    complete,
    pause: () => setPlaying(false),
    play: () => setPlaying(true),
    seek: async (frame) => {
      setPlaying(false);
      await complete;
      seek(frame);
      await view.settled();
    },
    positions: () => view.positions(),
    order,
  };
}
