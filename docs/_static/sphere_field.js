// Draws the scene of a <canvas class="sphere-field">: frames of a function on a grid of the sphere, one after another.
"use strict";

pictures("sphere-field", (canvas, scene) => {
  const PIXELS = 260; // across the sphere; the canvas scales it
  const { rows, columns, frames, times } = scene;
  const image = document.createElement("canvas"), paint = image.getContext("2d");
  image.width = image.height = PIXELS;
  const data = paint.createImageData(PIXELS, PIXELS);
  let clock = null;

  function value(frame, latitude, longitude) { // between the points of the grid, rows from pole to pole
    const i = Math.max(0, Math.min(rows - 1.001, latitude * rows - 0.5)), j = longitude * columns;
    const [a, b] = [Math.floor(i), Math.floor(j)], [u, v] = [i - a, j - b];
    const at = (row, column) => frame[row * columns + ((column % columns) + columns) % columns];
    return (1 - u) * ((1 - v) * at(a, b) + v * at(a, b + 1)) + u * ((1 - v) * at(a + 1, b) + v * at(a + 1, b + 1));
  }

  function draw(view) {
    if (clock === null) clock = view.still ? frames.length - 1 : 0;
    const first = Math.min(Math.floor(clock), frames.length - 1), second = Math.min(first + 1, frames.length - 1);
    const share = Math.min(clock - first, 1), context = view.context;
    const [ca, sa, cl, sl] = [Math.cos(view.turn), Math.sin(view.turn), Math.cos(view.lean), Math.sin(view.lean)];
    for (let row = 0, k = 0; row < PIXELS; row++) {
      for (let column = 0; column < PIXELS; column++, k += 4) {
        const right = 2 * (column + 0.5) / PIXELS - 1, up = 1 - 2 * (row + 0.5) / PIXELS;
        const rest = 1 - right * right - up * up;
        data.data[k + 3] = rest > 0 ? 255 : 0;
        if (rest <= 0) continue;
        const away = -Math.sqrt(rest), z = cl * up + sl * away, y0 = -sl * up + cl * away; // project, backwards
        const x = ca * right + sa * y0, y = -sa * right + ca * y0;
        const latitude = Math.acos(Math.max(-1, Math.min(1, z))) / Math.PI;
        const longitude = Math.atan2(y, x) / (2 * Math.PI);
        const f = (1 - share) * value(frames[first], latitude, longitude)
          + share * value(frames[second], latitude, longitude);
        const level = Math.max(-1, Math.min(1, f / scene.largest)), fade = 255 * (1 - Math.abs(level)), dim = 0.7 - 0.3 * away;
        data.data[k] = dim * (level > 0 ? 255 - 0.17 * (255 - fade) : fade); // blue, white, red
        data.data[k + 1] = dim * (fade + 0.2 * (255 - fade));
        data.data[k + 2] = dim * (level > 0 ? fade : 255 - 0.3 * (255 - fade));
      }
    }
    paint.putImageData(data, 0, 0);
    const size = 0.92 * Math.min(view.width, view.height);
    context.imageSmoothingEnabled = true;
    context.drawImage(image, -size / 2, -size / 2, size, size);
    context.fillStyle = view.colour("--pst-color-text-base");
    context.font = "0.8rem sans-serif";
    context.fillText("t = " + times[first].toFixed(0), -view.width / 2 + 8, view.height / 2 - 8);
  }

  function advance(seconds) {
    clock += 4 * seconds;
    if (clock > frames.length + 8) clock = 0;
  }

  turning(canvas, { lean: -0.5, advance, draw });
});
