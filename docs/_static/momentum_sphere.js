// Draws the scene of a <canvas class="momentum-sphere">: free motions on the energy surface, and a relaxing one.
// Drag, or press the arrow keys, to turn it. Who asks for less motion sees it at rest.
"use strict";

function momentumSphere(canvas, scene) {
  const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  const context = canvas.getContext("2d");
  const reach = Math.max(...scene.axes);
  let turn = 0.9, lean = -0.42, dragged = null, clock = still ? scene.relaxing.length - 1 : 0, last = null;

  const colour = (name) => getComputedStyle(canvas).getPropertyValue(name).trim();

  function project(p) {
    const [a, b] = [Math.cos(turn), Math.sin(turn)];
    const x = a * p[0] - b * p[1], y = b * p[0] + a * p[1];
    const [c, s] = [Math.cos(lean), Math.sin(lean)];
    return [x, c * p[2] - s * y, s * p[2] + c * y]; // right, up, away from the eye
  }

  function faces(p) { // does the surface at p look towards the eye?
    const normal = p.map((value, i) => value / scene.axes[i] ** 2);
    return project(normal)[2] < 0;
  }

  function path(points, front, width, paint, to) {
    context.lineWidth = width;
    context.strokeStyle = paint;
    context.beginPath();
    let drawing = false;
    for (let i = 0; i <= to; i++) {
      if (faces(points[i]) !== front) { drawing = false; continue; }
      const [x, y] = project(points[i]);
      drawing ? context.lineTo(x * scale, -y * scale) : context.moveTo(x * scale, -y * scale);
      drawing = true;
    }
    context.stroke();
  }

  let scale = 1;
  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    context.setTransform(ratio, 0, 0, ratio, ratio * width / 2, ratio * height / 2);
    context.clearRect(-width / 2, -height / 2, width, height);
    scale = 0.46 * Math.min(width, height) / reach;
    context.lineJoin = context.lineCap = "round";
    const end = Math.min(Math.floor(clock), scene.relaxing.length - 1);
    for (const front of [false, true]) {
      context.globalAlpha = front ? 0.75 : 0.15;
      for (const orbit of scene.orbits) path(orbit, front, 1, colour("--sphere-orbit"), orbit.length - 1);
      context.globalAlpha = front ? 1 : 0.25;
      path(scene.relaxing, front, 2.5, colour("--sphere-path"), end);
    }
    const head = scene.relaxing[end], [x, y] = project(head);
    context.globalAlpha = faces(head) ? 1 : 0.3;
    context.fillStyle = colour("--sphere-head");
    context.beginPath();
    context.arc(x * scale, -y * scale, 5, 0, 2 * Math.PI);
    context.fill();
  }

  function tick(now) {
    const passed = last === null ? 0 : Math.min(now - last, 100) / 1000;
    last = now;
    if (dragged === null) turn += 0.12 * passed;
    clock += 30 * passed;
    if (clock > scene.relaxing.length + 60) clock = 0;
    draw();
    if (canvas.isConnected) requestAnimationFrame(tick);
  }

  function move(right, down) {
    turn += right;
    lean = Math.max(-1.5, Math.min(1.5, lean + down));
    if (still) draw();
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
  new ResizeObserver(draw).observe(canvas);
  new MutationObserver(draw).observe(document.documentElement, { attributeFilter: ["data-theme"] });
  still ? draw() : requestAnimationFrame(tick);
}

document.addEventListener("DOMContentLoaded", () => {
  for (const canvas of document.querySelectorAll("canvas.momentum-sphere"))
    momentumSphere(canvas, JSON.parse(canvas.nextElementSibling.textContent));
});
