"use strict";
// Pages work without this script; it moves the border between two pictures and chooses one frame of a row.

// --- two pictures, one border: drag it, or use the arrow keys --------------------------------
for (const input of document.querySelectorAll(".compare input")) {
  const box = input.parentElement;
  const move = () => {
    const [left, right] = [...box.querySelectorAll(".tag")].map((tag) => tag.textContent);
    box.style.setProperty("--cut", input.value + "%");
    input.setAttribute("aria-valuetext", `${Math.round(input.value)} % ${left}, the rest ${right}`);
  };
  input.addEventListener("input", move);
  const follow = (event) => { // exactly under the pointer; a browser's own handle lags by half its width
    const { left, width } = input.getBoundingClientRect();
    input.value = (100 * (event.clientX - left)) / width;
    move();
  };
  let held = null;
  input.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    held = event.pointerId;
    input.setPointerCapture(held);
    follow(event);
  });
  input.addEventListener("pointermove", (event) => { if (event.pointerId === held) follow(event); });
  for (const name of ["pointerup", "pointercancel"]) input.addEventListener(name, () => { held = null; });
  input.addEventListener("mousedown", (event) => { event.preventDefault(); input.focus({ preventScroll: true }); });
  move();
}

// --- one frame of a row at a time; all of them keep the border where it was -------------------
for (const views of document.querySelectorAll(".views")) {
  const frames = [...views.querySelectorAll(".frame")];
  const buttons = [...views.querySelectorAll(".picker button")];
  buttons.forEach((button, n) => button.addEventListener("click", () => {
    const cut = views.querySelector(".frame.on .compare input")?.value;
    frames.forEach((frame, m) => frame.classList.toggle("on", m === n));
    buttons.forEach((other, m) => other.setAttribute("aria-pressed", String(m === n)));
    const input = frames[n].querySelector(".compare input");
    if (input && cut !== undefined) { input.value = cut; input.dispatchEvent(new Event("input")); }
  }));
}

// --- of more than two pictures, which are shown left and right ---------------------------------
for (const select of document.querySelectorAll(".chooser select")) select.addEventListener("change", () => {
  const views = select.closest(".views");
  const [left, right] = [...views.querySelectorAll(".chooser select")].map((other) => other.selectedIndex);
  for (const box of views.querySelectorAll(".compare")) {
    const images = [...box.querySelectorAll("img")];
    images.forEach((image, n) => { image.className = n === left ? "under" : n === right ? "over" : ""; });
    box.querySelector(".tag.left").textContent = images[left].dataset.word;
    box.querySelector(".tag.right").textContent = images[right].dataset.word;
    box.querySelector("input").dispatchEvent(new Event("input"));
  }
});

// --- on paper everything is open --------------------------------------------------------------
const closed = [];
window.addEventListener("beforeprint", () => {
  closed.push(...document.querySelectorAll("details:not([open])"));
  for (const details of closed) details.open = true;
});
window.addEventListener("afterprint", () => { for (const details of closed.splice(0)) details.open = false; });
