"use strict";
// Pages work without this script; it moves the border between two pictures and chooses one frame of a row.
for (const input of document.querySelectorAll(".compare input")) {
  const box = input.parentElement;
  const move = () => {
    const [left, right] = [...box.querySelectorAll(".tag")].map((tag) => tag.textContent);
    box.style.setProperty("--cut", input.value + "%");
    input.setAttribute("aria-valuetext", `${Math.round(input.value)} % ${left}, the rest ${right}`);
  };
  input.addEventListener("input", move);
  move();
}

// one frame of a row at a time; all of them keep the border where it was
for (const views of document.querySelectorAll(".views")) {
  const frames = [...views.querySelectorAll(".frame")], buttons = [...views.querySelectorAll(".picker button")];
  buttons.forEach((button, n) => button.addEventListener("click", () => {
    const cut = views.querySelector(".frame.on .compare input")?.value;
    frames.forEach((frame, m) => frame.classList.toggle("on", m === n));
    buttons.forEach((other, m) => other.setAttribute("aria-pressed", String(m === n)));
    const input = frames[n].querySelector(".compare input");
    if (input && cut !== undefined) { input.value = cut; input.dispatchEvent(new Event("input")); }
  }));
}

// on paper everything is open
const closed = [];
window.addEventListener("beforeprint", () => {
  closed.push(...document.querySelectorAll("details:not([open])"));
  for (const details of closed) details.open = true;
});
window.addEventListener("afterprint", () => { for (const details of closed.splice(0)) details.open = false; });
