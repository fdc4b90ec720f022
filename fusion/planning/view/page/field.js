/* A field of the results over the images: the value of the frame's phase, amplitude or phase; colour bar; probe. */
"use strict";
(() => {
  const state = { loaded: new Map(), data: null, found: null, point: null, drawn: "" };
  view.field = state;
  const pair = () => view.told.pairs[Number(view.get("pairs").value)];
  const value = (name) => view.get(`field-${name}`).value;
  const shown = () => Boolean(pair()?.fields && view.get("field").value);

  /* The chosen line of the pair with a canvas for each camera; nothing is drawn on it but the field. */
  async function load() {
    const { told, recording } = view, one = pair(), line = Number(value("line")), key = `${recording}/${one.number}/${line}`;
    if (!state.loaded.has(key)) {
      state.loaded.set(key, view.ask("field", { pair: one.number, line }).then((data) => {
        data.tables = Object.fromEntries(Object.entries(data.colours).map(([name, colours]) => [name, fieldCanvas.table(colours)]));
        data.cameras = data.cameras.map((camera) => {
          const made = { ...data, ...camera, points: fieldCanvas.decode(camera.points) }, canvas = document.createElement("canvas");
          return Object.assign(made, { canvas, painter: fieldCanvas.make(canvas, null, made) });
        });
        return data;
      }));
      state.loaded.get(key).catch(() => state.loaded.delete(key));
    }
    const data = await state.loaded.get(key);
    if (told === view.told && one === pair() && line === Number(value("line"))) state.data = data;
  }

  /* Colours of the present frame; drawn anew only if something has changed. */
  function colour() {
    const one = pair(), time = one.times?.[view.images.frame], hertz = one.fields.lines[Number(value("line"))];
    const phase = Number.isFinite(time) ? 2 * Math.PI * ((time * hertz) % 1) : null;
    const asked = { key: view.get("field").value, line: 0, view: value("view"), range: "fit", phase, mask: view.get("field-mask").checked };
    const key = JSON.stringify(asked);
    if (state.drawn === key && state.of === state.data) return;
    [state.drawn, state.of] = [key, state.data];
    const found = fieldCanvas.values(state.data.cameras[0], asked);
    state.found = found?.view === "now" && phase === null ? null : found;
    if (state.found) state.data.cameras.forEach((camera) => camera.painter.draw({ ...found, colours: state.data.tables[found.colours], opacity: state.data.opacity, levels: null, mark: null }));
    scale();
  }

  function scale() {
    const { found } = state;
    view.get("field-scale").hidden = !shown() || !found;
    view.get("field-mask").parentElement.hidden = !shown() || !found?.noise;
    if (found) {
      const [low, , high] = fieldCanvas.scale(found);
      [view.get("field-low").value, view.get("field-high").value] = [low, `${high}${found.unit === "°" ? "" : " "}${found.unit}`];
      view.get("field-ramp").style.background = `linear-gradient(to right, ${state.data.colours[found.colours].join(", ")})`;
    }
    told();
  }

  function told() {
    const { found, point } = state, camera = state.data?.cameras[0];
    const text = !shown() || !camera ? "" : !found ? "This frame has no value of this quantity." : point === null
      ? `Point at a subset${found.noise ? `; ${found.above} of ${camera.painter.count} are above their noise` : ""}.`
      : fieldCanvas.probe(camera, found, point);
    view.get("field-probe").value = text;
    if (!shown() || !found) document.body.dataset.field = "";
  }

  /* Overlays: the pen's unit is one pixel of the camera. */
  function overlay(side, pen, draw) {
    const camera = shown() && state.data?.cameras[side];
    if (!camera) return;
    colour();
    if (!state.found) return;
    pen.save();
    pen.scale(1 / camera.scale, 1 / camera.scale);
    draw(camera);
    pen.restore();
  }
  state.draw = (side, pen) => overlay(side, pen, ({ canvas }) => {
    pen.drawImage(canvas, 0, 0);
    document.body.dataset.field = `${view.get("field").value} ${view.images.frame}`;
  });
  state.mark = (side, pen, unit) => overlay(side, pen, ({ painter, scale: part }) => { if (state.point !== null) painter.frame(pen, state.point, unit * part); });

  function probe(side, find) {
    const camera = shown() && state.found && state.data?.cameras[side];
    const point = camera ? find(camera) : null;
    if (point === null || point === state.point) return;
    state.point = point;
    view.images.paint();
    told();
  }

  for (const [side, name] of ["left", "right"].entries()) {
    const canvas = view.get(name);
    for (const kind of ["pointermove", "pointerdown"]) canvas.addEventListener(kind, (event) => {
      if (event.buttons && kind === "pointermove") return;
      const [x, y] = view.where(name, event);
      probe(side, ({ painter, scale: part }) => painter.nearest((x + 0.5) * part, (y + 0.5) * part));
    });
    canvas.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!way || !event.shiftKey || !shown()) return;
      event.preventDefault();
      event.stopPropagation();
      probe(side, ({ painter, size }) => (state.point === null ? painter.nearest(size[0] / 2, size[1] / 2, Infinity) : painter.beside(state.point, ...way)));
    });
  }

  async function changed() {
    if (shown()) await load();
    state.drawn = "";
    if (!shown()) state.found = null;
    scale();
    view.images.paint();
  }
  for (const id of ["field", "field-line", "field-view", "field-mask"]) view.get(id).addEventListener("input", () => changed().catch(view.fail));
  view.get("field").addEventListener("input", () => { // subsets and arrows would hide its colours
    if (shown()) for (const id of ["show-subsets", "show-residuals"]) view.get(id).checked = false;
  });

  /* Another pair: its quantities, the same one if it has it. */
  state.opened = (one) => {
    const before = view.get("field").value, { fields } = one;
    [state.data, state.found, state.point, state.drawn] = [null, null, null, ""];
    view.get("field-tools").hidden = !fields;
    view.get("field").replaceChildren(...[["", "none"], ...(fields?.quantities ?? [])].map(([key, label]) => view.element("option", label, { value: key })));
    if (fields?.quantities.some(([key]) => key === before)) view.get("field").value = before;
    view.options("field-line", (fields?.lines ?? []).map((hz) => `${view.short(hz)} Hz`));
    if (fields) view.get("field-line").value = fields.main;
    changed().catch(view.fail);
  };
  state.clear = () => state.loaded.clear();
})();
