/* Image pairs on canvas: frames in time or by phase of a line, subsets with residuals, epipolar lines, tracks. */
"use strict";
(() => {
  const SIDES = ["left", "right"];
  const AHEAD = 8; // pictures kept
  const state = { frames: [], order: [], picked: null, epipolar: null, subsets: null, cache: new Map(), asked: 0 };
  view.images = state;
  const pair = () => view.told.pairs[Number(view.get("pairs").value)];
  const number = () => state.order[Number(view.get("frame").value)] ?? 0;

  async function picture(side, frame) {
    const key = `${view.recording}/${pair().number}/${side}/${frame}`;
    if (!state.cache.has(key)) {
      state.cache.set(key, view.ask("frame", { pair: pair().number, side, frame }).then((bytes) => {
        const [width, height] = pair().sizes[side], grey = new Uint8Array(bytes);
        const image = new ImageData(width, height), pixels = new Uint32Array(image.data.buffer);
        for (let i = 0; i < grey.length; i += 1) pixels[i] = 0xff000000 | (grey[i] * 0x010101);
        return image;
      }));
      state.cache.get(key).catch(() => state.cache.delete(key));
      for (const old of state.cache.keys()) {
        if (state.cache.size <= AHEAD) break;
        state.cache.delete(old);
      }
    }
    return state.cache.get(key);
  }

  function marks(side, pen, scale) {
    const seen = state.subsets, shown = seen?.[SIDES[side]];
    pen.lineWidth = 1.2 * scale;
    if (shown && view.get("show-subsets").checked) {
      const half = seen.radius;
      shown.forEach(([x, y], i) => {
        if (x === null) return;
        pen.strokeStyle = i === state.picked ? "#ffd400" : "#56b4e9";
        pen.lineWidth = (i === state.picked ? 3 : 1.2) * scale;
        pen.strokeRect(x + 0.5 - half, y + 0.5 - half, 2 * half, 2 * half);
      });
    }
    if (shown && view.get("show-residuals").checked && seen.residual) {
      const times = Number(view.get("magnified").value) || 1;
      pen.strokeStyle = "#ff6a00";
      pen.lineWidth = 2 * scale;
      pen.beginPath();
      shown.forEach(([x, y], i) => {
        const rest = seen.residual[SIDES[side]]?.[i];
        if (x === null || !rest || rest[0] === null) return;
        pen.moveTo(x + 0.5, y + 0.5);
        pen.lineTo(x + 0.5 + times * rest[0], y + 0.5 + times * rest[1]);
      });
      pen.stroke();
    }
    const line = state.epipolar?.[SIDES[side]];
    if (line?.length) {
      pen.strokeStyle = "#ffd400";
      pen.lineWidth = 1.5 * scale;
      pen.beginPath();
      line.forEach(([x, y], i) => (i ? pen.lineTo(x + 0.5, y + 0.5) : pen.moveTo(x + 0.5, y + 0.5)));
      pen.stroke();
      if (line.length === 1) pen.strokeRect(line[0][0] - 3 * scale, line[0][1] - 3 * scale, 6 * scale, 6 * scale);
    }
    if (side === 0) view.region.draw(pen, scale);
  }

  function paint() {
    state.frames.forEach((image, side) => {
      const canvas = view.get(SIDES[side]), pen = canvas.getContext("2d");
      if (canvas.width !== image.width || canvas.height !== image.height) {
        canvas.width = image.width;
        canvas.height = image.height;
      }
      pen.putImageData(image, 0, 0);
      marks(side, pen, Math.max(1, image.width / (canvas.clientWidth || image.width)));
    });
  }

  async function show() {
    if (view.tab !== "images") return;
    const asked = ++state.asked, frame = number(), one = pair();
    const pictures = one.sizes.map((_, side) => picture(side, frame));
    const [subsets, ...frames] = await Promise.all([view.ask("subsets", { pair: one.number, frame }), ...pictures]);
    if (asked !== state.asked) return;
    state.frames = frames;
    state.subsets = subsets;
    paint();
    const phase = one.phases?.[Number(view.get("order").value) - 1]?.[frame];
    const time = one.times?.[frame];
    const told = [`frame ${frame} (${Number(view.get("frame").value) + 1} of ${one.frames})`];
    if (Number.isFinite(time)) told.push(`${time.toFixed(6)} s`);
    if (Number.isFinite(phase)) told.push(`phase ${(360 * phase).toFixed(1)}°`);
    view.get("frame-told").textContent = told.join(", ");
    view.get("frame").setAttribute("aria-valuetext", told.join(", "));
    SIDES.forEach((side, i) => {
      view.get(side).parentElement.hidden = i >= frames.length;
      if (i >= frames.length) return;  // a camera alone
      view.get(`${side}-told`).textContent = `${side}: ${one.files[i][frame]}`;
      view.get(side).setAttribute("aria-label", `Image of the ${side} camera of ${one.name}, ${told.join(", ")}`);
    });
    view.get("images-told").textContent = [one.missing, subsets.told].filter(Boolean).join(" ");
    document.body.dataset.frame = String(frame);
  }

  function ordered() {
    const one = pair(), kind = Number(view.get("order").value);
    const frames = Array.from({ length: one.frames }, (_, i) => i);
    state.order = kind && one.phases ? frames.sort((a, b) => one.phases[kind - 1][a] - one.phases[kind - 1][b]) : frames;
    view.get("frame").max = one.frames - 1;
  }

  function paired() {
    const one = pair();
    state.picked = state.epipolar = state.subsets = null;
    view.options("order", ["in time", ...(one.beats ?? []).map((hz) => `by phase of ${view.short(hz)} Hz`)]);
    view.get("frame").value = 0;
    view.get("track").replaceChildren();
    view.region.opened(one);
    ordered();
    show().catch(view.fail);
  }

  view.where = (canvas, event) => {
    const box = canvas.getBoundingClientRect();
    return [((event.clientX - box.left) * canvas.width) / box.width - 0.5, ((event.clientY - box.top) * canvas.height) / box.height - 0.5];
  };

  async function pick(side, [x, y]) {
    const one = pair(), seen = state.subsets?.[SIDES[side]] ?? [];
    let best = Infinity;
    state.picked = null;
    seen.forEach(([a, b], i) => {
      if (a === null) return;
      const far = Math.max(Math.abs(a - x), Math.abs(b - y));
      if (far < best && far <= state.subsets.radius + 1) [best, state.picked] = [far, i];
    });
    const at = state.picked === null ? [x, y] : seen[state.picked];
    state.epipolar = await view.ask("epipolar", { pair: one.number, side, x: at[0], y: at[1] });
    paint();
    document.body.dataset.picked = state.picked ?? "";
    if (state.picked !== null) await view.drawTrack(one, state.picked);
  }

  SIDES.forEach((name, side) => view.get(name).addEventListener("click", (event) => {
    if (view.get("mouse").value === "pick") pick(side, view.where(view.get(name), event)).catch(view.fail);
  }));
  view.get("frame").addEventListener("input", () => show().catch(view.fail));
  view.get("order").addEventListener("change", () => { ordered(); show().catch(view.fail); });
  view.get("pairs").addEventListener("change", paired);
  for (const id of ["show-subsets", "show-residuals", "magnified"]) view.get(id).addEventListener("input", paint);
  document.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step || view.tab !== "images" || /INPUT|SELECT|TEXTAREA|BUTTON/.test(event.target.tagName)) return;
    view.get("frame").value = Number(view.get("frame").value) + step;
    show().catch(view.fail);
    event.preventDefault();
  });
  state.paint = paint;
  view.parts.images = {
    opened: () => {
      state.cache.clear();
      view.options("pairs", view.told.pairs.map((one) => one.name));
      if (view.told.pairs.length) paired();
    },
    shown: () => show().catch(view.fail),
  };
})();
