// A camera image whose pixels move with the body, magnified, in the phase of the scene: x(t) = Re{X exp(+jωt)}.
"use strict";
(() => {
  function start(figure) {
    const data = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
    const canvas = figure.querySelector("canvas"), pen = canvas.getContext("2d"), image = figure.querySelector("img");
    const columns = data.columns, rows = data.at.length / 2 / (columns + 1) - 1, told = figure.querySelector("output");
    const still = data.flow.map(line => (i => !line.slice(4 * i, 4 * i + 4).some(x => x)));
    figure.classList.add("live");

    function draw({ line, phase, stretch }) {
      if (figure.hidden || !data.flow[line]) return;
      const flow = data.flow[line], c = Math.cos(phase), s = Math.sin(phase), size = data.size[line] * 10 ** stretch;
      const now = i => [0, 1].map(k => data.at[2 * i + k] + size * (flow[4 * i + 2 * k] * c - flow[4 * i + 2 * k + 1] * s));
      pen.setTransform(1, 0, 0, 1, 0, 0);
      pen.drawImage(image, 0, 0, canvas.width, canvas.height);
      for (let row = 0; row < rows; row++) for (let column = 0; column < columns; column++) {
        const corner = row * (columns + 1) + column, cell = [corner, corner + 1, corner + columns + 2, corner + columns + 1];
        if (cell.every(still[line])) continue;
        triangle([cell[0], cell[1], cell[2]], now); triangle([cell[0], cell[2], cell[3]], now);
      }
      told.textContent = `× ${+size.toPrecision(2)}`;
    }
    // The affine map of one triangle of the image; clipped a little larger, since neighbours would leave a seam.
    function triangle(nodes, now) {
      const [a, b, c] = nodes.map(now), [p, q, r] = nodes.map(i => [data.at[2 * i], data.at[2 * i + 1]]);
      const area = (q[0] - p[0]) * (r[1] - p[1]) - (r[0] - p[0]) * (q[1] - p[1]);
      const by = k => [
        ((b[k] - a[k]) * (r[1] - p[1]) - (c[k] - a[k]) * (q[1] - p[1])) / area,
        ((c[k] - a[k]) * (q[0] - p[0]) - (b[k] - a[k]) * (r[0] - p[0])) / area,
      ];
      const [xx, xy] = by(0), [yx, yy] = by(1), middle = [0, 1].map(k => (a[k] + b[k] + c[k]) / 3);
      pen.setTransform(1, 0, 0, 1, 0, 0);
      pen.save(); pen.beginPath();
      for (const at of [a, b, c]) {
        const away = [at[0] - middle[0], at[1] - middle[1]], more = 1 + 0.7 / Math.max(1, Math.hypot(...away));
        pen.lineTo(middle[0] + away[0] * more, middle[1] + away[1] * more);
      }
      pen.closePath(); pen.clip();
      pen.setTransform(xx, yx, xy, yy, a[0] - xx * p[0] - xy * p[1], a[1] - yx * p[0] - yy * p[1]);
      pen.drawImage(image, 0, 0, canvas.width, canvas.height);
      pen.restore();
    }
    let last = { line: 0, phase: 0, stretch: 0 };
    document.addEventListener("scene-moved", event => draw(last = event.detail));
    image.decode().then(() => draw(last)).catch(() => {});
    figure.querySelector("select")?.addEventListener("change", event => {
      for (const other of document.querySelectorAll("figure.moving")) {
        other.hidden = other.dataset.name !== event.target.value;
        const choice = other.querySelector("select");
        if (choice) choice.value = event.target.value;
      }
      document.dispatchEvent(new CustomEvent("scene-moved", { detail: last }));
    });
  }
  document.addEventListener("DOMContentLoaded", () => document.querySelectorAll("figure.moving").forEach(start));
})();
