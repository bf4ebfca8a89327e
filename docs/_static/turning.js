// What the moving pictures share: a canvas that fits its place, is turned by dragging or the arrow keys, and moves with
// time unless its reader asks for less motion.
"use strict";

function turning(canvas, { lean = -0.42, speed = 0.12, advance, draw }) {
  const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  const view = { turn: 0.9, lean, still, context: canvas.getContext("2d"), width: 0, height: 0 };
  let dragged = null, last = null;

  view.colour = (name) => getComputedStyle(canvas).getPropertyValue(name).trim();

  view.project = (p) => { // right, up, away from the eye
    const [a, b] = [Math.cos(view.turn), Math.sin(view.turn)];
    const x = a * p[0] - b * p[1], y = b * p[0] + a * p[1];
    const [c, s] = [Math.cos(view.lean), Math.sin(view.lean)];
    return [x, c * p[2] - s * y, s * p[2] + c * y];
  };

  function redraw() {
    const ratio = window.devicePixelRatio || 1;
    [view.width, view.height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(view.width * ratio) || canvas.height !== Math.round(view.height * ratio)) {
      canvas.width = Math.round(view.width * ratio);
      canvas.height = Math.round(view.height * ratio);
    }
    view.context.setTransform(ratio, 0, 0, ratio, ratio * view.width / 2, ratio * view.height / 2);
    view.context.clearRect(-view.width / 2, -view.height / 2, view.width, view.height);
    draw(view);
  }

  function tick(now) {
    const passed = last === null ? 0 : Math.min(now - last, 100) / 1000;
    last = now;
    if (dragged === null) view.turn += speed * passed;
    advance(passed);
    redraw();
    if (canvas.isConnected) requestAnimationFrame(tick);
  }

  function move(right, down) {
    view.turn += right;
    view.lean = Math.max(-1.5, Math.min(1.5, view.lean + down));
    if (still) redraw();
  }
  canvas.addEventListener("pointerdown", (event) => {
    dragged = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (dragged === null) return;
    move((event.clientX - dragged[0]) / 120, (event.clientY - dragged[1]) / 120);
    dragged = [event.clientX, event.clientY];
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { dragged = null; });
  canvas.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    if (by) { move(...by); event.preventDefault(); }
  });
  new ResizeObserver(redraw).observe(canvas);
  new MutationObserver(redraw).observe(document.documentElement, { attributeFilter: ["data-theme"] });
  still ? redraw() : requestAnimationFrame(tick);
}

function pictures(name, make) { // each canvas of a class, with the scene in the element behind it
  document.addEventListener("DOMContentLoaded", () => {
    for (const canvas of document.querySelectorAll("canvas." + name))
      make(canvas, JSON.parse(canvas.nextElementSibling.textContent));
  });
}
