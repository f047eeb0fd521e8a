"use strict";
// --- cameras, points and box in 3D ----------------------------------------------------------
// Orbit camera: yaw and pitch about `up`, distance from `target`. OpenCV axes: x right, y down, z forward.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };
const mix = (a, s, b, t) => a.map((v, i) => v * s + b[i] * t);

function drawSpace(root) {
  const data = JSON.parse(root.querySelector("script").textContent);
  const canvas = root.querySelector("canvas"), pen = canvas.getContext("2d");
  const up = unit(data.up);
  const east = unit(cross(Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], up)), north = cross(up, east);
  const start = { yaw: Math.atan2(dot(data.from, north), dot(data.from, east)) + 0.5, pitch: 0.5, distance: data.radius * 2.6, target: data.target.slice() };
  let view = { ...start };
  const hidden = new Set();
  const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();

  function basis() {
    const flat = mix(east, Math.cos(view.yaw), north, Math.sin(view.yaw));
    const back = mix(flat, Math.cos(view.pitch), up, Math.sin(view.pitch)); // from target to the eye
    const right = unit(cross(up, back));
    return { eye: mix(view.target, 1, back, view.distance), right, down: cross(right, back), ahead: back.map((v) => -v) };
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const b = basis(), focal = 0.95 * Math.min(width, height * 1.3), near = view.distance * 0.02;
    const see = (p) => { const d = sub(p, b.eye); return [dot(d, b.right), dot(d, b.down), dot(d, b.ahead)]; };
    const flat = (q) => [width / 2 + (focal * q[0]) / q[2], height / 2 + (focal * q[1]) / q[2]];
    const line = (p, q) => {
      let u = see(p), v = see(q);
      if (u[2] < near && v[2] < near) return;
      if (u[2] < near) u = mix(u, (v[2] - near) / (v[2] - u[2]), v, (near - u[2]) / (v[2] - u[2]));
      if (v[2] < near) v = mix(v, (u[2] - near) / (u[2] - v[2]), u, (near - v[2]) / (u[2] - v[2]));
      pen.moveTo(...flat(u)); pen.lineTo(...flat(v));
    };
    if (!hidden.has("points")) {
      for (let i = 0; i < data.points.length; i += 3) {
        const q = see([data.points[i], data.points[i + 1], data.points[i + 2]]);
        if (q[2] < near) continue;
        const s = flat(q), size = Math.max(1.2, Math.min(3.5, (1.4 * view.distance) / q[2]));
        pen.fillStyle = `rgb(${data.colours[i]},${data.colours[i + 1]},${data.colours[i + 2]})`;
        pen.fillRect(s[0], s[1], size, size);
      }
    }
    if (!hidden.has("box") && data.box.length === 8) {
      pen.beginPath(); pen.strokeStyle = colour("--muted"); pen.lineWidth = 1;
      for (let a = 0; a < 8; a++) for (const bit of [1, 2, 4]) if (!(a & bit)) line(data.box[a], data.box[a | bit]);
      pen.stroke();
    }
    for (const group of data.groups) {
      if (hidden.has(group.id)) continue;
      pen.strokeStyle = pen.fillStyle = colour(group.colour);
      pen.lineWidth = group.bold ? 1.8 : 1;
      pen.beginPath();
      for (const cam of group.cameras) {
        for (let k = 0; k < 4; k++) { line(cam.centre, cam.corners[k]); line(cam.corners[k], cam.corners[(k + 1) % 4]); }
      }
      if (group.path) for (let k = 1; k < group.cameras.length; k++) line(group.cameras[k - 1].centre, group.cameras[k].centre);
      pen.stroke();
      if (group.labels) {
        pen.font = "12px system-ui, sans-serif";
        for (const cam of group.cameras) {
          const q = see(cam.centre);
          if (q[2] > near) { const s = flat(q); pen.beginPath(); pen.arc(s[0], s[1], 3, 0, 7); pen.fill();
            pen.save(); pen.lineWidth = 4; pen.lineJoin = "round"; pen.strokeStyle = colour("--panel"); // a halo, to be read before points
            pen.strokeText(cam.name, s[0] + 7, s[1] - 6); pen.restore(); pen.fillText(cam.name, s[0] + 7, s[1] - 6);
          }
        }
      }
    }
  }
  let waiting = false;
  const later = () => { if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; draw(); }); } };

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const old = fingers.get(e.pointerId);
    if (!old) return;
    const dx = e.clientX - old[0], dy = e.clientY - old[1];
    if (fingers.size === 1 && !e.shiftKey && e.buttons !== 2) {
      view.yaw -= dx * 0.008;
      view.pitch = Math.max(-1.5, Math.min(1.5, view.pitch + dy * 0.008));
    } else {
      const b = basis(), step = view.distance / (0.95 * Math.min(canvas.clientWidth, canvas.clientHeight * 1.3)) / fingers.size;
      const others = [...fingers].filter(([id]) => id !== e.pointerId).map(([, p]) => p);
      if (others.length) {
        const before = Math.hypot(old[0] - others[0][0], old[1] - others[0][1]);
        const after = Math.hypot(e.clientX - others[0][0], e.clientY - others[0][1]);
        if (before > 10 && after > 10) view.distance *= before / after;
      }
      view.target = mix(mix(view.target, 1, b.right, -dx * step), 1, b.down, -dy * step);
    }
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    later();
  });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); view.distance *= Math.exp(e.deltaY * 0.0012); later(); }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (turn) { view.yaw += turn[0]; view.pitch = Math.max(-1.5, Math.min(1.5, view.pitch + turn[1])); }
    else if (e.key === "+" || e.key === "-") view.distance *= e.key === "+" ? 0.9 : 1.1;
    else return;
    e.preventDefault(); later();
  });
  for (const box of root.querySelectorAll(".switches input")) box.addEventListener("change", () => { hidden[box.checked ? "delete" : "add"](box.value); later(); });
  root.querySelector(".switches button").addEventListener("click", () => { view = { ...start, target: start.target.slice() }; later(); });
  new ResizeObserver(later).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", later);
  window.addEventListener("beforeprint", draw);
  draw();
}
document.querySelectorAll(".space-root").forEach(drawSpace);
