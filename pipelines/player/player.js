// The page: unpacks what it carries, draws when something has changed, and steers time.
import { Drawing } from "./draw.js";
import { Orbit } from "./camera.js";
import { Splats, unpack } from "./splats.js";
import { listen } from "./controls.js";

const SLOW_MS = 50; // a picture that takes longer while something moves is drawn with fewer pixels
const QUICK_MS = 25;
const COARSEST = 0.5; // pixels against the screen's, along each side
const REST_MS = 200; // after so long without a change it is drawn with all of them
const MOST_PIXELS = 4e6;
const BAR = 0.22; // of the picture's width: about how long the scale bar is

const about = JSON.parse(document.getElementById("about").textContent);
const byId = (name) => document.getElementById(name);
const canvas = byId("canvas");

function fail(text) {
  byId("message").textContent = text;
  byId("message").hidden = false;
  byId("bar").hidden = true;
}

async function begin() {
  if (!window.DecompressionStream) return fail("This browser is too old to unpack the page: it has no DecompressionStream. Any of 2023 or later has.");
  const splats = new Splats(about.splats, await unpack(byId("splats").textContent));
  byId("splats").remove();
  let drawing;
  try {
    drawing = new Drawing(canvas, splats, about.behind);
  } catch (error) {
    if (error.message !== "no WebGL2") throw error;
    return fail("This browser draws no WebGL 2, which the player needs. Switch hardware acceleration on, or try another browser.");
  }
  const orbit = new Orbit(about.views, about.up);
  const { times } = about, keys = times.length, first = times[0], last = times[keys - 1];
  const state = { time: first, playing: false, speed: 1, drawn: 0, pictures: 0, share: 1 };
  let dirty = true, before = 0, lastChange = 0, cost = 0;

  const fits = () => {
    const dpr = window.devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = canvas;
    const scale = Math.min(dpr, Math.sqrt(MOST_PIXELS / Math.max(1, w * h))) * state.share;
    const [width, height] = [w, h].map((side) => Math.max(1, Math.round(side * scale)));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  };
  const changed = () => {
    dirty = true;
    lastChange = performance.now();
  };
  const setTime = (time) => {
    state.time = Math.max(first, Math.min(last, time));
    byId("time").value = state.time;
    byId("clock").textContent = `${state.time.toFixed(2)} s`;
    changed();
  };
  const setPlaying = (playing) => {
    state.playing = playing && keys > 1;
    byId("play").textContent = state.playing ? "❚❚" : "▶";
    byId("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
    changed();
  };
  const time = {
    toggle: () => setPlaying(!state.playing),
    step(by) {
      const nearest = times.reduce((best, t, k) => (Math.abs(t - state.time) < Math.abs(times[best] - state.time) ? k : best), 0);
      setPlaying(false);
      setTime(times[Math.max(0, Math.min(keys - 1, nearest + by))]);
    },
  };
  const show = (n) => (orbit.show(about.views[n]), (byId("view").value = n), changed());

  const frame = (now) => {
    requestAnimationFrame(frame);
    const passed = Math.min(0.25, (now - before) / 1000);
    if (state.playing) {
      const next = state.time + passed * state.speed;
      setTime(next > last ? first : next);
    }
    const busy = now - lastChange < REST_MS;
    if (busy && dirty && now - before < 1000) cost += 0.15 * (now - before - cost);
    before = now;
    const share = !busy ? 1 : cost > SLOW_MS ? Math.max(COARSEST, state.share * 0.9) : cost < QUICK_MS ? Math.min(1, state.share / 0.9) : state.share;
    if (share !== state.share) [state.share, dirty] = [share, true];
    if (!dirty) return;
    fits();
    state.drawn = drawing.draw(orbit.view(canvas.width, canvas.height), splats.at(state.time, times));
    state.pictures += 1;
    dirty = false;
    scaleBar();
  };

  const scaleBar = () => {
    if (!about.metres) return;
    const lens = orbit.view(canvas.clientWidth, canvas.clientHeight);
    const metres = ((orbit.distance * about.metres) / lens.focal[0]) * canvas.clientWidth * BAR;
    const power = 10 ** Math.floor(Math.log10(metres));
    const round = [5, 2, 1].find((digit) => digit * power <= metres) * power;
    byId("scale").style.width = `${(round / metres) * BAR * canvas.clientWidth}px`;
    byId("scale").textContent = round >= 1 ? `${round} m` : `${Math.round(round * 1000) / 10} cm`;
  };

  about.views.forEach((view, n) => byId("view").add(new Option(view.name, n)));
  byId("view").onchange = (event) => show(Number(event.target.value));
  byId("speed").onchange = (event) => (state.speed = Number(event.target.value));
  byId("time").oninput = (event) => (setPlaying(false), setTime(Number(event.target.value)));
  [byId("time").min, byId("time").max] = [first, last];
  byId("play").onclick = time.toggle;
  byId("scale").hidden = !about.metres;
  for (const part of document.querySelectorAll(".moving")) part.hidden = keys < 2;
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => (drawing.build(), changed()));
  new ResizeObserver(changed).observe(canvas);
  listen(canvas, orbit, changed, time, (key) =>
    key === "0" || key === "Home" ? () => show(0) : about.views[Number(key)] && key > "0" ? () => show(Number(key)) : null);
  // for programs that embed the page, and for tests
  window.player = { state, about, canvas, orbit, show, setTime, setPlaying, changed };
  setTime(about.start);
  setPlaying(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  document.body.classList.add("ready");
  requestAnimationFrame(frame);
}

begin().catch((error) => fail(`The player stopped: ${error.message}`));
