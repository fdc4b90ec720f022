// The rig in space, drawn on a canvas: turned by hand, moved in slow motion. x(t) = Re{X exp(+jωt)}; lengths in mm.
"use strict";
(() => {
  const TURN_S = 2.0, FIELD = 0.42, NEAR = 0.02, DEG = Math.PI / 180;
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const plus = (a, b, s) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const unit = a => plus([0, 0, 0], a, 1 / (Math.hypot(...a) || 1));
  const triples = list => Array.from({ length: list.length / 3 }, (_, i) => list.slice(3 * i, 3 * i + 3));
  const short = x => x >= 1000 ? String(Math.round(x / 10 ** (Math.floor(Math.log10(x)) - 1)) * 10 ** (Math.floor(Math.log10(x)) - 1))
    .replace(/\B(?=(\d{3})+$)/g, "\u202f") : String(+x.toPrecision(2));

  function edges(shape) { // of a closed shape: its ends, the faces on both sides, and whether it is a stroke of its own
    const found = new Map(), of = (i, j) => Math.min(i, j) + " " + Math.max(i, j), sharp = new Set();
    for (const stroke of shape.s) for (let i = 1; i < stroke.length; i++) sharp.add(of(stroke[i - 1], stroke[i]));
    shape.f.forEach((face, number) => face.forEach((i, at) => {
      const j = face[(at + 1) % face.length], key = of(i, j);
      if (!found.has(key)) found.set(key, { ends: [i, j], faces: [], sharp: sharp.has(key) });
      found.get(key).faces.push(number);
    }));
    return [...found.values()];
  }

  function start(figure) {
    const data = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
    const part = name => figure.querySelector(`[data-part="${name}"]`);
    const parts = name => [...figure.querySelectorAll(`[data-part="${name}"]`)];
    const canvas = part("canvas"), pen = canvas.getContext("2d"), tip = part("tip");
    const calm = matchMedia("(prefers-reduced-motion: reduce)"), moving = data.motions.length > 0;
    const up = unit(data.up), flat = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    const first = unit(plus(flat, up, -dot(flat, up))), second = cross(up, first);
    const view = { yaw: -58 * DEG, pitch: 26 * DEG, centre: [0, 0, 0], radius: 1 };
    const state = { phase: 0, playing: moving && !calm.matches, seen: false, line: 0, stretch: 0, mode: +(part("mode")?.value ?? 0), hover: null, fit: "all" };
    const hidden = new Set();
    let colours = {}, primitives = [], width = 0, height = 0, basis = null, asked = 0, before = 0, largest = 1;
    for (const shape of data.shapes) { shape.points = triples(shape.p); shape.edges = shape.c ? edges(shape) : []; }
    figure.classList.add("live");

    // The view: from where, and where a point is seen.
    function look() {
      const level = plus(plus([0, 0, 0], first, Math.cos(view.yaw)), second, Math.sin(view.yaw));
      const towards = plus(plus([0, 0, 0], level, Math.cos(view.pitch)), up, Math.sin(view.pitch));
      const right = plus(plus([0, 0, 0], first, -Math.sin(view.yaw)), second, Math.cos(view.yaw));
      const distance = view.radius / Math.sin(Math.atan(FIELD));
      basis = { towards, right, above: cross(towards, right), distance, scale: Math.min(width, height) / 2 / FIELD };
    }
    function seen(point) {
      const from = plus(point, view.centre, -1), depth = basis.distance - dot(from, basis.towards);
      const size = basis.scale / Math.max(depth, NEAR * basis.distance);
      return [width / 2 + dot(from, basis.right) * size, height / 2 - dot(from, basis.above) * size, depth];
    }
    const before_us = p => p[2] > NEAR * basis.distance;
    function clipped(a, b) { // the part of a line that lies before the viewer
      const p = seen(a), q = seen(b), near = 1.01 * NEAR * basis.distance;
      if (!before_us(p) && !before_us(q)) return null;
      const at = (a, b, p, q) => seen(plus(a, plus(b, a, -1), (p[2] - near) / (p[2] - q[2])));
      return [before_us(p) ? p : at(b, a, q, p), before_us(q) ? q : at(a, b, p, q)];
    }
    function fit(which) { state.fit = which; view.radius = 0; draw(); }
    function fitted() { // the view that just holds all points of what is to be seen
      const bodies = data.shapes.filter(shape => shape.b), bent = bodies.filter(shape => state.mode === 1 && shape.u in data.motions[state.line].d);
      const near = bent.length ? bent : bodies, shapes = state.fit === "near" && near.length ? near : data.shapes;
      const points = shapes.flatMap(shape => shape.points);
      const ends = points[0].map((_, i) => [Math.min, Math.max].map(f => f(...points.map(p => p[i]))));
      view.centre = ends.map(([low, high]) => (low + high) / 2);
      view.radius = largest = Math.max(...points.map(p => Math.hypot(...plus(p, view.centre, -1)))) || 1;
      for (let i = 0; i < 8; i++) {
        look();
        const at = points.map(seen), [x, y] = [0, 1].map(k => [Math.min, Math.max].map(f => f(...at.map(p => p[k]))));
        const size = basis.distance / basis.scale;
        view.centre = plus(plus(view.centre, basis.right, ((x[0] + x[1]) - width) / 2 * size), basis.above, -((y[0] + y[1]) - height) / 2 * size);
        view.radius *= Math.max((x[1] - x[0]) / Math.max(width - 150, 60), (y[1] - y[0]) / Math.max(height - 90, 60));
      }
      if (bent.length) view.radius *= 1.3;
    }
    function from(direction) {
      const aside = [dot(direction, first), dot(direction, second)];
      view.pitch = Math.asin(Math.max(-1, Math.min(1, dot(direction, up))));
      view.yaw = Math.hypot(...aside) > 1e-6 ? Math.atan2(aside[1], aside[0]) : -90 * DEG;
      fit(state.fit);
    }

    // The motion: rigid with its rotation vector, and what is beside it.
    // Modes: 0 whole motion, 1 deflection alone, 2 whole motion with the deflection magnified more.
    const factor = which => moving ? data.motions[state.line].m[which] * 10 ** state.stretch : 0;
    function instant(numbers, size) { // millionths: µm, µrad
      const c = Math.cos(state.phase), s = Math.sin(state.phase), out = [];
      for (let i = 0; i < numbers.length; i += 2) out.push((numbers[i] * c - numbers[i + 1] * s) * size);
      return out;
    }
    function placed(shape) {
      const motion = data.motions[state.line];
      if (!motion || !shape.b) return shape.points;
      let points = shape.points;
      const rigid = state.mode !== 1 && motion.r[shape.b], bent = shape.u && motion.d[shape.u];
      if (rigid) {
        const now = instant(rigid, factor(0)), shift = now.slice(0, 3).map(x => 1e-3 * x);
        const angle = Math.hypot(now[3], now[4], now[5]) * 1e-6, axis = unit(now.slice(3)), c = Math.cos(angle), s = Math.sin(angle);
        points = points.map(p => {
          const turned = plus(plus(p.map(x => c * x), cross(axis, p), s), axis, (1 - c) * dot(axis, p));
          return plus(turned, shift, 1);
        });
      }
      if (bent) { const now = triples(instant(bent, 1e-3 * factor(state.mode ? 1 : 0))); points = points.map((p, i) => plus(p, now[i], 1)); }
      return points;
    }

    // Drawing: faces, lines and dots, the farthest first; labels on top where they have room.
    function collect() {
      primitives = [];
      const labels = [], light = unit(plus(plus(basis.towards, basis.above, 0.6), basis.right, -0.4));
      data.shapes.forEach(shape => {
        if (hidden.has(shape.k)) return;
        const points = placed(shape), at = points.map(seen), base = { shape, colour: colours[shape.k] };
        const front = (shape.f || []).map(face => {
          if (!face.every(i => before_us(at[i]))) return false;
          const [a, b, c] = face.map(i => points[i]), normal = unit(cross(plus(b, a, -1), plus(c, b, -1)));
          const eye = plus(plus(view.centre, basis.towards, basis.distance), a, -1);
          if (shape.c && dot(normal, eye) <= 0) return false;
          const lit = dot(normal, light), shade = shape.c ? 0.55 + 0.45 * Math.max(0, lit) : shape.u ? 0.2 + 0.8 * Math.abs(lit) : 1;
          add({ ...base, kind: "face", at: face.map(i => at[i]), alpha: shape.o * shade * (state.mode === 1 && !shape.u ? 0.3 : 1) });
          return true;
        });
        for (const edge of shape.edges) {
          const sides = edge.faces.filter(number => front[number]).length;
          if (sides === 1 || (sides && edge.sharp)) add({ ...base, kind: "line", at: edge.ends.map(i => at[i]), dashed: shape.h });
        }
        if (!shape.c) for (const stroke of shape.s || []) for (let i = 1; i < stroke.length; i++) {
          const ends = clipped(points[stroke[i - 1]], points[stroke[i]]);
          const last = shape.a && i === stroke.length - 1;
          if (ends) add({ ...base, kind: "line", at: ends, head: last, dashed: shape.h });
        }
        const dots = shape.d === "many" ? at : shape.d ? at.slice(0, 1) : [];
        dots.filter(before_us).forEach((p, i) => {
          add({ ...base, kind: "dot", at: [p], size: shape.d === "many" ? 1.6 : 3.4 });
          if (state.mode === 1 && shape.u) add({ ...base, kind: "line", at: [seen(shape.points[i]), p] });
        });
        const anchor = at[shape.a && !shape.d ? at.length - 1 : 0];
        if (shape.l && before_us(anchor)) labels.push({ text: shape.l, at: anchor, colour: base.colour });
        if (shape.c && moving && state.mode !== 1) rest(shape);
      });
      primitives.sort((a, b) => b.depth - a.depth);
      return labels;
    }
    function add(primitive) {
      primitive.depth = primitive.at.reduce((sum, p) => sum + p[2], 0) / primitive.at.length - (primitive.kind === "dot" ? 1 : 0);
      primitives.push(primitive);
    }
    function rest(shape) {
      for (const stroke of shape.s || []) for (let i = 1; i < stroke.length; i++) {
        const ends = clipped(shape.points[stroke[i - 1]], shape.points[stroke[i]]);
        if (ends) add({ shape, kind: "line", at: ends, colour: colours.soft, thin: true, dashed: 1 });
      }
    }
    function path(at) { pen.beginPath(); at.forEach((p, i) => i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])); }
    function paint(primitive) {
      const chosen = primitive.shape === state.hover && !primitive.thin;
      pen.strokeStyle = pen.fillStyle = primitive.colour;
      pen.lineWidth = (primitive.thin ? 0.7 : primitive.shape.k === "camera" ? 1 : 1.5) + (chosen ? 1.3 : 0);
      pen.setLineDash(primitive.dashed ? [4, 4] : []);
      path(primitive.at);
      if (primitive.kind === "face") {
        pen.closePath();
        if (primitive.shape.o === 1) { pen.fillStyle = colours.back; pen.fill(); pen.fillStyle = primitive.colour; }
        pen.globalAlpha = Math.min(1, primitive.alpha * (chosen ? 1.5 : 1)); pen.fill(); pen.globalAlpha = 1;
        if (primitive.shape.o === 1) { pen.strokeStyle = colours.ink; pen.lineWidth = 0.5; pen.stroke(); }
      } else if (primitive.kind === "line") {
        pen.globalAlpha = primitive.thin ? 0.5 : 1; pen.stroke(); pen.globalAlpha = 1;
        if (primitive.head) head(...primitive.at);
      } else {
        pen.beginPath(); pen.arc(primitive.at[0][0], primitive.at[0][1], primitive.size + (chosen ? 1 : 0), 0, 7); pen.fill();
      }
    }
    function head(foot, end) {
      const away = [end[0] - foot[0], end[1] - foot[1]], length = Math.hypot(...away);
      if (length < 5) return;
      const [x, y] = away.map(v => v / length);
      path([end, [end[0] - 10 * x - 4 * y, end[1] - 10 * y + 4 * x], [end[0] - 10 * x + 4 * y, end[1] - 10 * y - 4 * x]]);
      pen.closePath(); pen.fill();
    }
    function write(labels) {
      const taken = [[0, height - 34, 190, height]];
      pen.font = "12px " + colours.font; pen.lineJoin = "round"; pen.setLineDash([]);
      labels.sort((a, b) => a.at[2] - b.at[2]);
      for (const { text, at: [x, y], colour } of labels) {
        const w = pen.measureText(text).width;
        for (const [dx, dy] of [[7, -6], [7, 14], [-w - 7, -6], [-w - 7, 14], [-w / 2, -10], [-w / 2, 20], [9, 4], [7, -20], [7, 28]]) {
          const box = [x + dx - 2, y + dy - 12, x + dx + w + 2, y + dy + 4];
          const free = box[0] > 0 && box[1] > 0 && box[2] < width && box[3] < height;
          if (!free || taken.some(t => box[0] < t[2] && t[0] < box[2] && box[1] < t[3] && t[1] < box[3])) continue;
          taken.push(box);
          pen.strokeStyle = colours.back; pen.lineWidth = 3.5; pen.strokeText(text, x + dx, y + dy);
          pen.fillStyle = colour; pen.fillText(text, x + dx, y + dy);
          break;
        }
      }
    }
    function bar() { // a length at the distance of the middle
      const size = basis.scale / basis.distance, wanted = 110 / size, power = 10 ** Math.floor(Math.log10(wanted));
      const length = power * [5, 2, 1].find(f => f * power <= wanted), x = 16, y = height - 14;
      pen.strokeStyle = pen.fillStyle = colours.frame ?? colours.ink; pen.lineWidth = 1.5; pen.setLineDash([]);
      path([[x, y - 4], [x, y], [x + length * size, y], [x + length * size, y - 4]]); pen.stroke();
      pen.font = "12px " + colours.font; pen.fillText(`${length} mm`, x + 5, y - 6);
    }
    function draw() { if (!asked) asked = requestAnimationFrame(frame); }
    function frame(now) {
      asked = 0;
      if (state.playing && state.seen) {
        if (before) state.phase = (state.phase + 2 * Math.PI * Math.min(now - before, 100) / 1000 / TURN_S) % (2 * Math.PI);
        before = now; draw();
      } else before = 0;
      if (!width) return;
      if (!view.radius) fitted();
      look();
      pen.clearRect(0, 0, width, height);
      const labels = collect();
      primitives.forEach(paint);
      bar();
      write(labels);
      tell();
    }

    // What is said beside the picture.
    function tell() {
      if (!moving) return;
      const degrees = Math.round(state.phase / DEG) % 360;
      part("phase").value = degrees;
      part("phase").setAttribute("aria-valuetext", `${degrees} degrees`);
      part("phase-told").textContent = `ωt = ${degrees}°`;
      part("size-told").textContent = `× ${short(factor(state.mode === 1 ? 1 : 0))}${state.mode === 2 ? `, deflection × ${short(factor(1))}` : ""}`;
      const play = part("play"), word = state.playing ? "Pause" : "Play";
      if (play.textContent !== word) play.textContent = word;
      document.dispatchEvent(new CustomEvent("scene-moved", { detail: { line: state.line, phase: state.phase, stretch: state.stretch } }));
    }
    function choose() {
      const motion = data.motions[state.line];
      part("told").replaceChildren(...motion.t.map(text => Object.assign(document.createElement("li"), { textContent: text })));
      draw();
    }
    function under(x, y) { // the nearest dot or line within some pixels, else the foremost face
      let best = null, least = 9;
      for (const primitive of primitives) {
        if (primitive.kind === "face" || primitive.thin) continue;
        const [a, b = a] = primitive.at, along = [b[0] - a[0], b[1] - a[1]], square = along[0] ** 2 + along[1] ** 2;
        const t = square ? Math.max(0, Math.min(1, ((x - a[0]) * along[0] + (y - a[1]) * along[1]) / square)) : 0;
        const away = Math.hypot(x - a[0] - t * along[0], y - a[1] - t * along[1]) - (primitive.kind === "dot" ? 3 : 0);
        if (away <= least) { least = away; best = primitive.shape; }
      }
      if (best) return best;
      for (const primitive of [...primitives].reverse()) {
        if (primitive.kind !== "face") continue;
        path(primitive.at);
        if (pen.isPointInPath(x * devicePixelRatio, y * devicePixelRatio)) return primitive.shape;
      }
      return null;
    }
    function name(x, y) {
      const shape = under(x, y);
      if (shape !== state.hover) { state.hover = shape; draw(); }
      tip.hidden = !shape;
      if (!shape) return;
      tip.replaceChildren(Object.assign(document.createElement("b"), { textContent: shape.n }), document.createElement("br"), shape.t);
      tip.style.left = `${Math.max(4, Math.min(x + 14, width - tip.offsetWidth - 4))}px`;
      tip.style.top = `${y + 18 + tip.offsetHeight > height ? y - tip.offsetHeight - 10 : y + 18}px`;
    }

    // Pointer, wheel, keys, buttons.
    let held = null;
    canvas.addEventListener("pointerdown", event => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointerup", () => { held = null; });
    canvas.addEventListener("pointercancel", () => { held = null; });
    canvas.addEventListener("pointerleave", () => { tip.hidden = true; state.hover = null; draw(); });
    canvas.addEventListener("pointermove", event => {
      if (!held) return name(event.offsetX, event.offsetY);
      tip.hidden = true;
      const [dx, dy] = [event.clientX - held[0], event.clientY - held[1]];
      held = [event.clientX, event.clientY];
      if (event.shiftKey) shift(dx, dy); else turn(-0.4 * dx, 0.4 * dy);
    });
    canvas.addEventListener("wheel", event => { // of who has chosen the picture; the page scrolls for everybody else
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault(); zoom(Math.exp(0.0012 * event.deltaY));
    }, { passive: false });
    function turn(dx, dy) {
      view.yaw += dx * DEG; view.pitch = Math.max(-90 * DEG, Math.min(90 * DEG, view.pitch + dy * DEG)); draw();
    }
    function shift(dx, dy) {
      const size = basis.distance / basis.scale;
      view.centre = plus(plus(view.centre, basis.right, -dx * size), basis.above, dy * size); draw();
    }
    function zoom(by) { view.radius = Math.max(0.01 * largest, Math.min(6 * largest, view.radius * by)); draw(); }
    const keys = {
      ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5],
    };
    canvas.addEventListener("keydown", event => {
      const key = event.key, way = keys[key];
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (way && event.shiftKey) shift(-4 * way[0], 4 * way[1]); else if (way) turn(...way);
      else if (key === "+" || key === "=") zoom(0.9); else if (key === "-") zoom(1 / 0.9);
      else if (key === " " && moving) play(!state.playing); else if (key === "0") fit("all"); else return;
      event.preventDefault();
    });
    const act = {
      all: () => fit("all"), near: () => fit("near"), in: () => zoom(0.8), out: () => zoom(1.25),
      left: () => turn(-15, 0), right: () => turn(15, 0), up: () => turn(0, 15), down: () => turn(0, -15),
      front: () => from([0, -1, 0]), side: () => from([1, 0, 0]), top: () => from([0, 0, 1]),
      back: () => step(-15), on: () => step(15),
    };
    for (const button of parts("act")) button.addEventListener("click", () => act[button.dataset.act]());
    for (const box of parts("kind")) box.addEventListener("change", () => {
      if (box.checked) hidden.delete(box.value); else hidden.add(box.value);
      draw();
    });
    function play(on) { state.playing = on; before = 0; draw(); }
    function step(degrees) { play(false); state.phase = (state.phase + (degrees + 360) * DEG) % (2 * Math.PI); }
    if (moving) {
      part("play").addEventListener("click", () => play(!state.playing));
      part("phase").addEventListener("input", event => { play(false); state.phase = event.target.value * DEG; });
      part("line").addEventListener("change", event => { state.line = +event.target.value; choose(); });
      part("size").addEventListener("input", event => { state.stretch = +event.target.value; draw(); });
      part("mode")?.addEventListener("change", event => { state.mode = +event.target.value; fit("near"); });
      calm.addEventListener("change", () => { if (calm.matches) play(false); });
      choose();
    }

    // Size, colours, and whether anyone can see it.
    function paintbox() {
      const style = getComputedStyle(figure), of = name => style.getPropertyValue(name).trim();
      colours = { back: of("--paper"), ink: of("--ink"), soft: of("--soft"), font: style.fontFamily };
      for (const chip of parts("chip")) colours[chip.dataset.kind] = getComputedStyle(chip).color;
      draw();
    }
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paintbox);
    new ResizeObserver(() => {
      width = canvas.clientWidth; height = canvas.clientHeight;
      const ratio = window.devicePixelRatio || 1;
      canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      draw();
    }).observe(canvas);
    new IntersectionObserver(entries => { state.seen = entries[entries.length - 1].isIntersecting; draw(); }).observe(canvas);
    paintbox();
    fit(moving ? "near" : "all");
  }
  document.addEventListener("DOMContentLoaded", () => document.querySelectorAll("figure.scene").forEach(start));
})();
