/* Image pairs: frames in time or by phase of a line, played or stepped; overlays on them; picked subsets and points. */
"use strict";
(() => {
  const SIDES = ["left", "right"];
  const KEPT = 256 * 2 ** 20; // bytes of images
  const AHEAD = 6; // frames asked for in advance in the direction of the slider, and a third of them behind it
  const state = { order: [], place: 0, way: 1, picked: null, epipolar: null, subsets: null, frame: 0, cache: new Map(), playing: false };
  view.images = state;
  const pair = () => view.told.pairs[Number(view.get("pairs").value)];
  const number = (place = Number(view.get("frame").value)) => state.order[place] ?? 0;
  const ports = SIDES.map((side) => new view.Viewport(side, () => paint()));
  view.where = (side, event) => ports[SIDES.indexOf(side)].at(event);
  state.ports = ports;

  /* An answer of a frame, asked for once; those not used for the longest time are dropped. */
  function cached(key, ask) {
    const found = state.cache.get(key) ?? { bytes: 0, answer: ask() };
    if (!state.cache.delete(key)) {
      found.answer.then((answer) => { found.bytes = answer.grey?.byteLength ?? 0; drop(); }, () => state.cache.delete(key));
    }
    state.cache.set(key, found);
    return found.answer;
  }

  function drop() {
    let bytes = [...state.cache.values()].reduce((sum, one) => sum + one.bytes, 0);
    for (const [old, one] of state.cache) {
      if (bytes <= KEPT) return;
      bytes -= one.bytes;
      state.cache.delete(old);
    }
  }

  const picture = (side, frame, one = pair()) => cached(`${one.number}/${side}/${frame}`, () => view.ask("frame", { pair: one.number, side, frame }).then((found) => {
    if (!(found instanceof ArrayBuffer)) return { refused: found.refused };
    const { head, at } = view.head(found);
    return { ...head, grey: head.bits === 8 ? new Uint8Array(found, at) : new Uint16Array(found, at) };
  }));
  const seenIn = (frame, one = pair()) => cached(`${one.number}/subsets/${frame}`, () => view.ask("subsets", { pair: one.number, frame }));
  const all = (frame, one = pair()) => Promise.all([seenIn(frame, one), ...one.cameras.map((_, side) => picture(side, frame, one))]);

  /* What is drawn on the images, in this order: each is given the side (0, 1), a pen whose unit is one pixel of the image (the
     centre of pixel (x, y) is at x + 0.5, y + 0.5), pixels of the image per pixel of the screen, and what `subsets` answered. */
  view.overlays = {
    field: (side, pen) => view.field.draw(side, pen),
    subsets(side, pen, scale, seen) {
      if (!view.get("show-subsets").checked) return;
      const half = seen.radius;
      (seen[SIDES[side]] ?? []).forEach(([x, y], i) => {
        if (x === null) return;
        pen.strokeStyle = view.dye(i === state.picked ? "picked" : "subset");
        pen.lineWidth = (i === state.picked ? 3 : 1.2) * scale;
        pen.strokeRect(x + 0.5 - half, y + 0.5 - half, 2 * half, 2 * half);
      });
    },
    residuals(side, pen, scale, seen) {
      if (!view.get("show-residuals").checked || !seen.residual) return;
      const times = Number(view.get("magnified").value) || 1;
      pen.strokeStyle = view.dye("line");
      pen.lineWidth = 2 * scale;
      pen.beginPath();
      (seen[SIDES[side]] ?? []).forEach(([x, y], i) => {
        const rest = seen.residual[SIDES[side]]?.[i];
        if (x === null || !rest || rest[0] === null) return;
        pen.moveTo(x + 0.5, y + 0.5);
        pen.lineTo(x + 0.5 + times * rest[0], y + 0.5 + times * rest[1]);
      });
      pen.stroke();
    },
    epipolar(side, pen, scale) {
      const line = state.epipolar?.[SIDES[side]];
      if (!line?.length) return;
      pen.strokeStyle = view.dye("picked");
      pen.lineWidth = 1.5 * scale;
      pen.beginPath();
      line.forEach(([x, y], i) => (i ? pen.lineTo(x + 0.5, y + 0.5) : pen.moveTo(x + 0.5, y + 0.5)));
      pen.stroke();
      if (line.length === 1) pen.strokeRect(line[0][0] + 0.5 - 4 * scale, line[0][1] + 0.5 - 4 * scale, 8 * scale, 8 * scale);
    },
    probe: (side, pen, scale) => view.field.mark(side, pen, scale),
    outlines: (side, pen, scale) => { if (side === 0) view.region.draw(pen, scale); },
  };

  function paint() {
    if (!view.told || view.tab !== "images") return;
    ports.forEach((port, side) => {
      if (port.canvas.parentElement.hidden) return;
      port.paint((pen, scale) => Object.values(view.overlays).forEach((draw) => draw(side, pen, scale, state.subsets ?? {})));
    });
  }
  state.paint = paint;

  /* Show the frame of the slider. Frames it has passed meanwhile are left out. */
  function show() {
    state.due = true;
    state.shows ??= (async () => {
      while (state.due) {
        state.due = false;
        await step().catch(view.fail);
      }
      state.shows = null;
      ahead().catch(view.fail);
    })();
    return state.shows;
  }

  async function step() {
    if (view.tab !== "images" || !view.told?.pairs.length) return;
    const { told } = view, one = pair(), place = Number(view.get("frame").value), frame = number(place);
    const [subsets, ...frames] = await all(frame, one);
    if (told !== view.told || one !== pair()) return;
    [state.subsets, state.frame, state.way, state.place] = [subsets, frame, place < state.place ? -1 : 1, place];
    frames.forEach((image, side) => ports[side].show(image.grey ? image : null));
    paint();
    caption(one, frame, frames);
    view.get("images-told").textContent = [one.missing, subsets.told].filter(Boolean).join(" ");
    document.body.dataset.frame = String(frame);
  }

  /* Ask for the next frames one after another, until the slider moves. */
  async function ahead() {
    const { told } = view, { place, way } = state, count = state.order.length;
    for (let i = 0; i < Math.min(AHEAD + AHEAD / 3, count - 1); i += 1) {
      if (state.shows || view.tab !== "images" || told !== view.told) return;
      const step = i < AHEAD ? i + 1 : AHEAD - i - 1;
      await all(number((place + way * step + 2 * count) % count));
    }
  }

  function caption(one, frame, frames) {
    const told = [`frame ${frame} (${Number(view.get("frame").value) + 1} of ${one.frames})`];
    const time = one.times?.[frame], phase = one.phases?.[Number(view.get("order").value) - 1]?.[frame];
    if (Number.isFinite(time)) told.push(`${time.toFixed(6)} s`);
    if (Number.isFinite(phase)) told.push(`phase ${(360 * phase).toFixed(1)}°`);
    view.get("frame-told").textContent = told.join(", ");
    view.get("frame").setAttribute("aria-valuetext", told.join(", "));
    one.cameras.forEach((camera, i) => {
      const caught = frames[i].refused, text = view.get(`${SIDES[i]}-told`);
      text.textContent = `${camera.side}: ${camera.files[frame] || "no image"}`;
      if (caught) text.append(" ", view.element("b", `⚠ ${caught.code}`), ` ${caught.where}: ${caught.text}`);
      text.dataset.refused = caught?.code ?? "";
      view.get(SIDES[i]).setAttribute("aria-label", `Image of the ${camera.side} camera of ${one.name}, ${told.join(", ")}`);
    });
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
    ports.forEach((port, side) => {
      const camera = one.cameras[side];
      port.canvas.parentElement.hidden = !camera;
      port.shadeKept = false;
      if (camera) port.opened(camera.size, camera.full);
    });
    view.region.opened(one);
    view.field.opened(one);
    ordered();
    show();
  }

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
    paint();
    state.epipolar = await view.ask("epipolar", { pair: one.number, side, x: at[0], y: at[1] });
    paint();
    document.body.dataset.picked = state.picked ?? "";
    if (state.picked !== null) await view.drawTrack(one, state.picked);
  }

  /* Frames one after another; the next ones are asked for in advance. */
  async function play() {
    state.playing = !state.playing;
    const button = view.get("play");
    button.textContent = state.playing ? "❚❚ pause" : "▶ play";
    button.setAttribute("aria-pressed", String(state.playing));
    if (!state.playing || state.runs) return;
    state.runs = true;
    let due = performance.now();
    while (state.playing && view.tab === "images") {
      const slider = view.get("frame"), count = state.order.length, next = (Number(slider.value) + 1) % count;
      slider.value = next;
      await show();
      due = Math.max(due + 1000 / Number(view.get("rate").value), performance.now());
      await new Promise((resolve) => { setTimeout(resolve, due - performance.now()); });
    }
    state.runs = false;
    if (state.playing) play();
  }

  SIDES.forEach((name, side) => view.get(name).addEventListener("click", (event) => {
    if (!view.drawing(name) && !ports[side].dragged && event.detail < 2) pick(side, view.where(name, event)).catch(view.fail);
  }));
  view.get("rate").replaceChildren(...[1, 2, 5, 10, 20, 30].map((hz) => view.element("option", String(hz), { value: hz, selected: hz === 10 })));
  view.get("play").addEventListener("click", play);
  view.get("frame").addEventListener("input", () => show());
  view.get("order").addEventListener("change", () => { ordered(); show(); });
  view.get("pairs").addEventListener("change", paired);
  const each = (act) => { ports.forEach(act); paint(); };
  view.get("zoom-in").addEventListener("click", () => each((port) => port.zoomBy(view.ZOOM_STEP)));
  view.get("zoom-out").addEventListener("click", () => each((port) => port.zoomBy(1 / view.ZOOM_STEP)));
  view.get("zoom-whole").addEventListener("click", () => each((port) => port.whole()));
  for (const id of ["show-subsets", "show-residuals", "magnified"]) view.get(id).addEventListener("input", paint);
  window.addEventListener("resize", paint);
  document.addEventListener("keydown", (event) => {
    if (view.tab !== "images" || event.ctrlKey || event.metaKey || /INPUT|SELECT|TEXTAREA|BUTTON/.test(event.target.tagName)) return;
    const under = ports.find((port) => port.under), zoomed = (act) => (under ? act(under) : each(act));
    const slider = view.get("frame");
    const acts = {
      ArrowLeft: () => { slider.value = Number(slider.value) - 1; show(); },
      ArrowRight: () => { slider.value = Number(slider.value) + 1; show(); },
      " ": play,
      "+": () => zoomed((port) => port.zoomBy(view.ZOOM_STEP, port.under)),
      "-": () => zoomed((port) => port.zoomBy(1 / view.ZOOM_STEP, port.under)),
      0: () => each((port) => port.whole()),
    };
    const act = acts[event.key === "=" ? "+" : event.key];
    if (!act) return;
    act();
    event.preventDefault();
  });
  view.parts.images = {
    opened: () => {
      state.cache.clear();
      view.field.clear();
      if (state.playing) play();
      view.options("pairs", view.told.pairs.map((one) => one.name));
      if (view.told.pairs.length) paired();
    },
    shown: () => show(),
  };
})();
