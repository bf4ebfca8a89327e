// Draws the scene of a <canvas class="momentum-sphere">: free motions of a body on a sphere or an ellipsoid, and a relaxing one.
"use strict";

pictures("momentum-sphere", (canvas, scene) => {
  const reach = Math.max(...scene.axes);
  let clock = scene.relaxing.length - 1; // a reader sees the finished curve first, and then how it came

  function draw(view) {
    const { context, project } = view, scale = 0.46 * Math.min(view.width, view.height) / reach;

    function faces(p) { // does the surface at p look towards the eye?
      return project(p.map((value, i) => value / scene.axes[i] ** 2))[2] < 0;
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

    context.lineJoin = context.lineCap = "round";
    const end = Math.min(Math.floor(clock), scene.relaxing.length - 1);
    for (const front of [false, true]) {
      context.globalAlpha = front ? 0.75 : 0.15;
      for (const orbit of scene.orbits) path(orbit, front, 1, view.colour("--sphere-orbit"), orbit.length - 1);
      context.globalAlpha = front ? 1 : 0.25;
      path(scene.relaxing, front, 2.5, view.colour("--sphere-path"), end);
    }
    const head = scene.relaxing[end], [x, y] = project(head);
    context.globalAlpha = faces(head) ? 1 : 0.3;
    context.fillStyle = view.colour("--sphere-head");
    context.beginPath();
    context.arc(x * scale, -y * scale, 5, 0, 2 * Math.PI);
    context.fill();
  }

  function advance(seconds) {
    clock += 30 * seconds;
    if (clock > scene.relaxing.length + 150) clock = 0; // five seconds of the finished curve
  }

  turning(canvas, { advance, draw });
});
