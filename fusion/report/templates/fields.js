// Values of points as colours over a camera image, interpolated between neighbours. x(t) = Re{X exp(+jωt)}.
"use strict";
// Draws { size, points, triangles, side } on a canvas over an image; null: over nothing. Coordinates are pixels of the image.
const fieldCanvas = (() => {
  const LEVELS = 256, DEG = Math.PI / 180;
  const decode = text => new Float32Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
  function table(colours) { // red, green, blue between colours at equal steps
    const given = colours.map(c => [1, 3, 5].map(k => parseInt(c.slice(k, k + 2), 16))), out = new Uint8Array(3 * LEVELS);
    for (let i = 0; i < LEVELS; i++) {
      const at = i / (LEVELS - 1) * (given.length - 1), k = Math.min(Math.floor(at), given.length - 2), share = at - k;
      for (let c = 0; c < 3; c++) out[3 * i + c] = Math.round((1 - share) * given[k][c] + share * given[k + 1][c]);
    }
    return out;
  }
  const level = (value, low, high) => Math.round((LEVELS - 1) * Math.min(1, Math.max(0, (value - low) / (high - low))));

  function make(canvas, image, field) {
    const [width, height] = field.size, points = field.points, triangles = field.triangles, pen = canvas.getContext("2d");
    const count = points.length / 2, within = [], corners = [], weights = [], taken = new Uint8Array(width * height);
    canvas.width = width; canvas.height = height;
    for (let t = 0; t < triangles.length; t += 3) { // pixels inside each triangle, with their weights
      const [a, b, c] = [0, 1, 2].map(k => triangles[t + k]), [ax, ay] = [points[2 * a], points[2 * a + 1]];
      const ux = points[2 * b] - ax, uy = points[2 * b + 1] - ay, vx = points[2 * c] - ax, vy = points[2 * c + 1] - ay;
      const area = ux * vy - uy * vx;
      if (!area) continue;
      const xs = [ax, ax + ux, ax + vx], ys = [ay, ay + uy, ay + vy];
      for (let y = Math.max(0, Math.ceil(Math.min(...ys))); y <= Math.min(height - 1, Math.max(...ys)); y++) {
        for (let x = Math.max(0, Math.ceil(Math.min(...xs))); x <= Math.min(width - 1, Math.max(...xs)); x++) {
          const q = ((x - ax) * vy - (y - ay) * vx) / area, r = (ux * (y - ay) - uy * (x - ax)) / area;
          if (q < -1e-9 || r < -1e-9 || q + r > 1 + 1e-9 || taken[y * width + x]) continue;
          taken[y * width + x] = 1; within.push(y * width + x); corners.push(a, b, c); weights.push(1 - q - r, q, r);
        }
      }
    }
    const pixels = Int32Array.from(within), corner = Int32Array.from(corners), weight = Float64Array.from(weights);
    let plain = null;
    function background() {
      if (!image) return new ImageData(width, height);
      pen.drawImage(image, 0, 0, width, height);
      plain ??= pen.getImageData(0, 0, width, height);
      return new ImageData(new Uint8ClampedArray(plain.data), width, height);
    }
    // values (N): NaN leaves a point free. cells: each point as a square, else linear between neighbours.
    function draw({ values, low, high, colours, opacity, cells, levels, mark }) {
      const shown = background(), out = shown.data, share = image ? opacity : 1, rest = 1 - share;
      if (!cells) for (let i = 0; i < pixels.length; i++) {
        const k = 3 * i, value = weight[k] * values[corner[k]] + weight[k + 1] * values[corner[k + 1]] + weight[k + 2] * values[corner[k + 2]];
        if (Number.isNaN(value)) continue;
        const at = 4 * pixels[i], colour = 3 * level(value, low, high);
        for (let c = 0; c < 3; c++) out[at + c] = rest * out[at + c] + share * colours[colour + c];
        if (!image) out[at + 3] = 255 * opacity;
      }
      pen.putImageData(shown, 0, 0);
      if (cells) for (let i = 0; i < count; i++) {
        if (Number.isNaN(values[i])) continue;
        const k = 3 * level(values[i], low, high), half = 0.47 * field.side;
        pen.globalAlpha = opacity; pen.fillStyle = `rgb(${colours[k]} ${colours[k + 1]} ${colours[k + 2]})`;
        pen.fillRect(points[2 * i] + 0.5 - half, points[2 * i + 1] + 0.5 - half, 2 * half, 2 * half);
        pen.globalAlpha = 1;
      }
      if (levels) contours(values, levels);
      if (mark !== null) frame(pen, mark);
    }
    function frame(pen, mark, unit = 1) { // around a point, with lines in units of `unit` pixels
      const x = points[2 * mark] + 0.5, y = points[2 * mark + 1] + 0.5, half = field.side / 2;
      for (const [colour, line] of [["#fff", 4], ["#111", 1.6]]) {
        pen.strokeStyle = colour; pen.lineWidth = line * unit; pen.strokeRect(x - half, y - half, 2 * half, 2 * half);
      }
    }
    function contours(values, levels) {
      pen.beginPath();
      for (const at of levels) for (let t = 0; t < triangles.length; t += 3) {
        const ends = [];
        for (let k = 0; k < 3; k++) {
          const i = triangles[t + k], j = triangles[t + (k + 1) % 3], p = values[i] - at, q = values[j] - at;
          if (p < 0 === q < 0 || Number.isNaN(p + q)) continue;
          const share = p / (p - q);
          ends.push([0, 1].map(c => points[2 * i + c] + share * (points[2 * j + c] - points[2 * i + c]) + 0.5));
        }
        if (ends.length === 2) { pen.moveTo(...ends[0]); pen.lineTo(...ends[1]); }
      }
      for (const [colour, line] of [["#ffffffb0", 2.6], ["#111", 1]]) { pen.strokeStyle = colour; pen.lineWidth = line; pen.stroke(); }
    }
    function nearest(x, y, reach = 1.5 * field.side) { // null: no point within reach
      let best = null, least = reach;
      for (let i = 0; i < count; i++) {
        const away = Math.hypot(points[2 * i] + 0.5 - x, points[2 * i + 1] + 0.5 - y);
        if (away < least) { least = away; best = i; }
      }
      return best;
    }
    function beside(i, right, down) { // the next point in a direction, or the same
      let best = i, least = Infinity;
      for (let j = 0; j < count; j++) {
        const dx = points[2 * j] - points[2 * i], dy = points[2 * j + 1] - points[2 * i + 1];
        const along = dx * right + dy * down, across = Math.abs(dx * down - dy * right);
        if (along > 0.5 * field.side && along + 3 * across < least) { least = along + 3 * across; best = j; }
      }
      return best;
    }
    return { draw, frame, nearest, beside, count };
  }

  const signed = text => text.replace("-", "\u2212");
  const fixed = (value, expanded) => { // two significant digits of U
    if (!(expanded > 0)) return signed(String(+value.toPrecision(5)));
    const decimals = Math.max(0, 1 - Math.floor(Math.log10(expanded) + 1e-9));
    return `${signed(value.toFixed(decimals))} ± ${expanded.toFixed(decimals)}`;
  };
  const median = list => { const kept = [...list].filter(Number.isFinite).sort((a, b) => a - b); return kept.length ? kept[kept.length >> 1] : 0; };
  const ends = list => { const kept = [...list].filter(Number.isFinite); return kept.length ? [Math.min(...kept), Math.max(...kept)] : [0, 1]; };

  // Values of a field as they are shown: numbers, ends of the scale, colours, and what the probe says. null: not at this line.
  // state: { key, line, view: size|phase|now, range: fit|zero, phase, mask: hide what is not above noise }.
  function values(field, state) {
    const quantity = field.quantities.find(q => q.key === state.key), line = quantity?.lines[state.line], n = field.points.length / 2;
    if (!line) return null;
    line.numbers ??= decode(line.values);
    const column = k => line.numbers.subarray(k * n, (k + 1) * n), phasor = quantity.phasor;
    const re = column(0), im = phasor ? column(1) : null, along = column(phasor ? 2 : 1), across = phasor ? column(3) : null;
    const size = phasor ? re.map((x, i) => Math.hypot(x, im[i])) : re, noise = quantity.noise ? column(4) : null;
    const above = i => !noise || size[i] > noise[i], hidden = i => state.mask && !above(i);
    const view = phasor ? state.view : "size", found = { quantity, unit: line.unit, view };
    found.above = noise ? size.reduce((sum, _, i) => sum + above(i), 0) : n;
    found.cells = found.above < n && state.mask; // single points: nothing to interpolate
    let shown = size, expanded = along, low, high;
    if (view === "now") {
      const turn = i => Math.atan2(im[i], re[i]) + state.phase;
      shown = size.map((x, i) => x * Math.cos(turn(i)));
      expanded = along.map((u, i) => Math.hypot(u * Math.cos(turn(i)), across[i] * Math.sin(turn(i))));
      high = Math.max(...size.filter(Number.isFinite), 1e-12); low = -high;
      found.colours = "sign";
    } else if (view === "phase") {
      found.unit = "°"; found.colours = "phase";
      const mean = state.range === "fit" ? Math.atan2(im.reduce((s, y) => s + y, 0), re.reduce((s, x) => s + x, 0)) : 0;
      shown = re.map((x, i) => { const turn = Math.atan2(im[i], x) - mean; return (mean + Math.atan2(Math.sin(turn), Math.cos(turn))) / DEG; });
      expanded = across.map((u, i) => Math.min(u / size[i] / DEG, 180));
      [low, high] = [-180, 180];
      if (state.range === "fit" && !noise) { [low, high] = wide(ends(shown), median(expanded)); found.colours = "size"; }
    } else {
      found.colours = "size";
      [low, high] = state.range === "zero" || noise ? [0, ends(size)[1] || 1] : wide(ends(size), median(expanded));
    }
    return { ...found, low, high, values: shown.map((x, i) => hidden(i) ? NaN : x), shown, expanded, noise, size, along, across, re, im };
  }
  function wide([low, high], least) { // a range narrower than U shows noise: widened to U
    const more = Math.max(least - (high - low), 1e-9 * Math.abs(high), 1e-30) / 2;
    return [low - (more > 0 ? more : 0), high + (more > 0 ? more : 0)];
  }
  // What the probe says of point i: its place in the camera's image, value ± U with unit, and phase.
  function probe(field, found, i) {
    const at = [0, 1].map(c => ((field.points[2 * i + c] + 0.5) / field.scale - 0.5).toFixed(0));
    const unit = found.unit ? `${found.unit === "°" ? "" : " "}${found.unit}` : "";
    let text = `Subset at (${at.join(", ")}) px: ${fixed(found.shown[i], found.expanded[i])}${unit}`;
    if (found.view === "size" && found.quantity.phasor) {
      const angle = Math.atan2(found.im[i], found.re[i]) / DEG, expanded = found.across[i] / found.size[i] / DEG;
      text += expanded < 90 ? `, phase ${fixed(angle, expanded)}°` : ", phase not determined";
    }
    return found.noise && !(found.size[i] > found.noise[i]) ? `${text}, not above noise` : text;
  }
  // Low end, middle and high end of a scale with two significant digits of its range.
  function scale({ low, high }) {
    const decimals = Math.max(0, 1 - Math.floor(Math.log10(high - low)));
    return [low, (low + high) / 2, high].map(x => signed(x.toFixed(decimals)));
  }
  return { make, decode, table, values, probe, scale, median, ends };
})();

(() => {
  const TURN_S = 2.0, STEP = 15, LINES = 9, DEG = Math.PI / 180, KIND = { model: "model of a rigid body", measured: "measured", shapes: "shapes fitted to all pixels", score: "score" };
  const spread = list => { const [low, high] = fieldCanvas.ends(list); return high - low; }; // of 100 normal numbers below 6.6 σ in 99 %

  function start(panel) {
    const part = name => panel.querySelector(`[data-field="${name}"]`);
    const calm = matchMedia("(prefers-reduced-motion: reduce)");
    const state = { key: part("quantity").value, line: 0, view: "size", range: "fit", phase: 0, playing: false, seen: true };
    let before = 0, asked = 0;
    const figures = [...panel.querySelectorAll("figure")].map(figure => {
      const data = JSON.parse(figure.querySelector("script[type='application/json']").textContent), of = name => figure.querySelector(`[data-field="${name}"]`);
      data.points = fieldCanvas.decode(data.points);
      const same = [...document.querySelectorAll("figure.moving")].find(one => one.dataset.name === data.name);
      const image = of("image") ?? same.querySelector("img");
      return { figure, data, image, of, mark: null, tables: Object.fromEntries(Object.entries(data.colours).map(([k, c]) => [k, fieldCanvas.table(c)])) };
    });
    panel.classList.add("live");

    function draw() {
      for (const one of figures) paint(one);
      part("phase").value = Math.round(state.phase / DEG) % 360;
      part("phase-told").textContent = `${Math.round(state.phase / DEG) % 360}°`;
      part("play").textContent = state.playing ? "Pause" : "Play";
      part("view").value = state.view;
      if (state.playing && state.seen && !asked) asked = requestAnimationFrame(turn);
    }
    function turn(time) {
      asked = 0;
      if (!state.playing) return;
      state.phase = (state.phase + (before ? (time - before) / 1000 / TURN_S * 2 * Math.PI : 0)) % (2 * Math.PI);
      before = time;
      draw();
    }
    function paint(one) {
      const found = fieldCanvas.values(one.data, { ...state, mask: part("mask").checked });
      one.found = found;
      one.figure.classList.toggle("absent", !found);
      if (!found || !one.canvas) return;
      const levels = part("lines").checked ? Array.from({ length: LINES }, (_, i) => found.low + (i + 1) / (LINES + 1) * (found.high - found.low)) : null;
      one.canvas.draw({ ...found, colours: one.tables[found.colours], opacity: one.data.opacity, levels, mark: one.mark });
      const width = found.high - found.low, told = fieldCanvas.scale(found);
      one.of("ramp").style.background = `linear-gradient(to top, ${one.data.colours[found.colours].join(", ")})`;
      ["low", "middle", "high"].forEach((name, i) => { one.of(name).textContent = told[i]; });
      one.of("unit").textContent = found.unit;
      const expanded = fieldCanvas.median(found.expanded), bracket = one.of("bracket");
      bracket.hidden = !(expanded > 0);
      bracket.style.height = `${Math.min(100, 200 * expanded / width)}%`;
      const hertz = part("line").selectedOptions[0].textContent, { quantity } = found;
      const what = quantity.kind === "score" ? "mean over the frames" : { size: quantity.phasor ? "amplitude at " : "at ", phase: "phase at ", now: `at ${Math.round(state.phase / DEG) % 360}° of ` }[found.view] + hertz;
      one.of("shown").textContent = `${quantity.label}, ${what}: ${KIND[quantity.kind]}.` +
        (expanded > 0 ? ` U of a subset ${Number(expanded.toPrecision(2))}${found.unit === "°" ? "" : " "}${found.unit} (median).` : "") +
        (expanded > 0 && quantity.kind === "measured" && !found.noise && found.view !== "now" && spread(found.shown) < 3.3 * expanded ? " Differences between subsets are no larger than their noise." : "") +
        (found.noise ? ` ${found.above} of ${one.canvas.count} subsets are above their noise${quantity.kind === "measured" ? "; 5 % would be by chance" : ""}.` : "");
      one.of("probe").textContent = told_at(one, found);
    }
    function told_at(one, found) {
      one.of("probe").classList.toggle("empty", one.mark === null);
      if (one.mark === null) return "Point at a subset, or use the arrow keys on the image.";
      return fieldCanvas.probe(one.data, found, one.mark);
    }

    // Probe: pointer, touch, and arrow keys.
    for (const one of figures) {
      const canvas = one.of("canvas");
      const at = event => {
        const box = canvas.getBoundingClientRect(), scale = canvas.width / box.width;
        const found = one.canvas.nearest((event.clientX - box.left) * scale, (event.clientY - box.top) * scale);
        if (found !== null && found !== one.mark) { one.mark = found; paint(one); }
      };
      for (const name of ["pointermove", "pointerdown"]) canvas.addEventListener(name, at);
      canvas.addEventListener("keydown", event => {
        const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
        if (event.key === " ") { event.preventDefault(); play(!state.playing); }
        if (!way) return;
        event.preventDefault();
        one.mark = one.mark === null ? one.canvas.nearest(canvas.width / 2, canvas.height / 2, Infinity) : one.canvas.beside(one.mark, ...way);
        paint(one);
      });
      one.image.decode().then(() => { one.canvas = fieldCanvas.make(canvas, one.image, one.data); paint(one); one.figure.dataset.drawn = ""; }).catch(() => {});
    }
    function play(on) {
      state.playing = on; before = 0;
      if (on) state.view = "now";
      draw();
    }
    const change = (name, key, convert = x => x) => part(name).addEventListener("input", event => { state[key] = convert(event.target.value); draw(); });
    change("quantity", "key"); change("line", "line", Number); change("range", "range");
    part("view").addEventListener("input", event => { state.view = event.target.value; state.playing = false; draw(); });
    part("phase").addEventListener("input", event => { state.phase = event.target.value * DEG; state.playing = false; state.view = "now"; draw(); });
    part("play").addEventListener("click", () => play(!state.playing));
    for (const [name, way] of [["back", -1], ["on", 1]]) part(name).addEventListener("click", () => {
      state.phase = (state.phase + (way * STEP + 360) * DEG) % (2 * Math.PI); state.view = "now"; state.playing = false; draw();
    });
    for (const name of ["lines", "mask"]) part(name).addEventListener("input", draw);
    calm.addEventListener("change", () => { if (calm.matches) play(false); });
    addEventListener("beforeprint", () => { state.playing = false; draw(); });
    new IntersectionObserver(entries => { state.seen = entries[entries.length - 1].isIntersecting; before = 0; draw(); }).observe(panel);
  }
  document.addEventListener("DOMContentLoaded", () => document.querySelectorAll(".fields").forEach(start));
})();
