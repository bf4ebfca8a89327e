// Draws the scene of a <canvas class="tumbling-rod">: on the left a rod with antennas in space, with its momentum upright; on
// the right the momentum as it is seen from the rod, on its sphere.
"use strict";

pictures("tumbling-rod", (canvas, scene) => {
  const HALF = 1, RADIUS = 0.11, SIDES = 12, SPEED = 25; // frames a second
  const ring = (z) => Array.from({ length: SIDES + 1 }, (_, i) => {
    const angle = 2 * Math.PI * i / SIDES;
    return [RADIUS * Math.cos(angle), RADIUS * Math.sin(angle), z];
  });
  const edges = [ring(-HALF), ring(-HALF / 3), ring(HALF / 3), ring(HALF)];
  for (let i = 0; i < SIDES; i += 3) edges.push([edges[0][i], edges[3][i]]);
  const antennas = [0, 1, 2, 3].map((i) => {
    const [c, s] = [Math.cos(i * Math.PI / 2), Math.sin(i * Math.PI / 2)];
    return [[RADIUS * c, RADIUS * s, -HALF / 3], [0.5 * c, 0.5 * s, -HALF / 3]];
  });
  const circles = [0, 1, 2].map((axis) => Array.from({ length: 73 }, (_, i) => {
    const angle = 2 * Math.PI * i / 72, point = [0, 0, 0];
    point[(axis + 1) % 3] = Math.cos(angle);
    point[(axis + 2) % 3] = Math.sin(angle);
    return point;
  }));
  let clock = null;

  function draw(view) {
    const { context, project } = view, last = scene.momenta.length - 1;
    const scale = 0.4 * Math.min(view.width / 2, view.height);
    if (clock === null) clock = view.still ? last : 0;
    const now = Math.min(Math.floor(clock), last), g = scene.attitudes[now];
    const inSpace = (p) => [0, 3, 6].map((row) => g[row] * p[0] + g[row + 1] * p[1] + g[row + 2] * p[2]);

    function path(points, middle, paint, width) { // what lies behind the middle is pale
      context.strokeStyle = paint;
      context.lineWidth = width;
      for (let i = 1; i < points.length; i++) {
        const [a, b] = [project(points[i - 1]), project(points[i])];
        context.globalAlpha = a[2] + b[2] < 0 ? 1 : 0.3;
        context.beginPath();
        context.moveTo(middle + a[0] * scale, -a[1] * scale);
        context.lineTo(middle + b[0] * scale, -b[1] * scale);
        context.stroke();
      }
    }

    function dot(point, middle, paint) {
      const [x, y, away] = project(point);
      context.globalAlpha = away < 0 ? 1 : 0.4;
      context.fillStyle = paint;
      context.beginPath();
      context.arc(middle + x * scale, -y * scale, 5, 0, 2 * Math.PI);
      context.fill();
    }

    context.lineCap = "round";
    const [left, right] = [-view.width / 4, view.width / 4];
    const [plain, blue, orange] = ["--sphere-orbit", "--sphere-path", "--sphere-head"].map(view.colour);
    for (const edge of edges) path(edge.map(inSpace), left, plain, 1.5);
    for (const antenna of antennas) path(antenna.map(inSpace), left, blue, 1.5);
    path([[0, 0, 0], [0, 0, 1.15]], left, orange, 2.5);
    dot([0, 0, 1.15], left, orange);
    for (const circle of circles) path(circle, right, plain, 0.7);
    path(scene.momenta.slice(0, now + 1), right, blue, 2);
    dot(scene.momenta[now], right, orange);
    context.globalAlpha = 1;
    context.fillStyle = plain;
    context.textAlign = "center";
    context.fillText("in space", left, view.height / 2 - 6);
    context.fillText("seen from the rod", right, view.height / 2 - 6);
  }

  function advance(seconds) {
    clock += SPEED * seconds;
    if (clock > scene.momenta.length + 40) clock = 0;
  }

  turning(canvas, { advance, draw, speed: 0.03 });
});
