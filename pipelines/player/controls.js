// Mouse, touch and keyboard: they turn, shift and zoom the camera, and steer time.

const TURN = 4; // radians across the canvas's height
const KEY_TURN = 0.08, KEY_PAN = 0.05, KEY_ZOOM = 1.1;
const OWN_KEYS = [ // keys that a control needs itself
  ["select", /./],
  ["input", /^(Arrow.*|Home|End|Page.*)$/],
  ["button, summary", /^( |Enter)$/],
];
const WHEEL = 0.0012; // per pixel of scrolling

// `changed` is called after each change of the camera, `time` has toggle() and step(keys).
export function listen(canvas, orbit, changed, time, views) {
  const fingers = new Map();
  const middle = () => [...fingers.values()].reduce(([x, y], f) => [x + f.x / fingers.size, y + f.y / fingers.size], [0, 0]);
  const width = () => Math.max(1, Math.hypot(...[0, 1].map((k) => [...fingers.values()].slice(0, 2).reduce((d, f, n) => d + (n ? -1 : 1) * [f.x, f.y][k], 0))));

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus();
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = middle(), apart = width();
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const now = middle(), height = canvas.clientHeight;
    const across = (now[0] - before[0]) / height, down = (now[1] - before[1]) / height;
    if (fingers.size > 1) {
      orbit.zoom(apart / width());
      orbit.pan(across, down);
    } else if (event.buttons & 6 || event.shiftKey) orbit.pan(across, down);
    else orbit.turn(-TURN * across, -TURN * down);
    changed();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    orbit.zoom(Math.exp(WHEEL * event.deltaY * (event.deltaMode ? 16 : 1)));
    changed();
  }, { passive: false });

  const turn = (x, y) => () => orbit.turn(x * KEY_TURN, y * KEY_TURN);
  const pan = (x, y) => () => orbit.pan(x * KEY_PAN, y * KEY_PAN);
  const plain = {
    ArrowLeft: turn(-1, 0), ArrowRight: turn(1, 0), ArrowUp: turn(0, -1), ArrowDown: turn(0, 1),
    "+": () => orbit.zoom(1 / KEY_ZOOM), "=": () => orbit.zoom(1 / KEY_ZOOM), "-": () => orbit.zoom(KEY_ZOOM),
    " ": () => time.toggle(), ",": () => time.step(-1), ".": () => time.step(1),
  };
  const shifted = { ArrowLeft: pan(1, 0), ArrowRight: pan(-1, 0), ArrowUp: pan(0, 1), ArrowDown: pan(0, -1) };
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || isOwn(event.target, event.key)) return;
    const act = (event.shiftKey && shifted[event.key]) || plain[event.key] || views(event.key);
    if (!act) return;
    event.preventDefault();
    act();
    changed();
  });
  // what was chosen with a mouse or a finger gives the keys back; with keys one goes on choosing
  addEventListener("change", ({ target }) => target.matches("select:not(:focus-visible)") && target.blur());
}

const isOwn = (target, key) => OWN_KEYS.some(([what, keys]) => target.closest?.(what) && keys.test(key));
