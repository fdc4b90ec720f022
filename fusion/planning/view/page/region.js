/* Region of interest and masks, drawn with the mouse on the left image, and written into recording.toml on request. */
"use strict";
(() => {
  const NEAR = 8; // px on the screen from the first corner that closes a polygon
  const state = { region: null, masks: [], drawn: null, corners: null, before: "" };
  const canvas = view.get("left");
  const mode = () => view.get("mouse").value;
  const isPolygon = (outline) => Array.isArray(outline[0]);
  const port = () => view.images.ports[0];
  view.drawing = (side) => side === "left" && mode() !== "pick";

  function toml() {
    const told = (one) => `[${one.map((part) => (Array.isArray(part) ? told(part) : part)).join(", ")}]`;
    const lines = [];
    if (state.region) lines.push(`region = ${told(state.region)}`);
    if (state.masks.length) lines.push(`mask = ${told(state.masks)}`);
    return lines.join("\n");
  }

  function changed() {
    const lines = toml();
    view.get("lines").value = lines;
    view.get("region-told").hidden = !lines && lines === state.before;
    view.get("write").disabled = lines === state.before;
    view.get("written").textContent = "";
    view.images.paint();
  }

  /* Whole pixels [x, y, width, height] of what lies between two corners. */
  function box([a, b], [c, d]) {
    const end = (value, most) => Math.min(most, Math.max(0, Math.round(value + 0.5)));
    const x = [end(a, port().width), end(c, port().width)].sort((p, q) => p - q);
    const y = [end(b, port().height), end(d, port().height)].sort((p, q) => p - q);
    return [x[0], y[0], x[1] - x[0], y[1] - y[0]];
  }

  const pixel = ([x, y]) => [Math.min(port().width - 1, Math.max(0, Math.round(x))), Math.min(port().height - 1, Math.max(0, Math.round(y)))];

  function add(outline) {
    if (mode().startsWith("region")) state.region = outline;
    else state.masks.push(outline);
    changed();
  }

  function close() {
    const corners = (state.corners ?? []).filter(([x, y], i, all) => !i || x !== all[i - 1][0] || y !== all[i - 1][1]);
    state.corners = null;
    if (corners.length > 2) add(corners);
    else view.images.paint();
  }

  canvas.addEventListener("pointerdown", (event) => {
    if (!view.drawing("left") || event.button !== 0 || event.shiftKey) return;
    const at = port().at(event);
    if (mode().endsWith("polygon")) {
      const first = state.corners?.[0], scale = port().scale * (window.devicePixelRatio || 1);
      if (first && state.corners.length > 2 && Math.hypot(first[0] - at[0], first[1] - at[1]) < NEAR * scale) close();
      else state.corners = [...(state.corners ?? []), pixel(at)];
      view.images.paint();
    } else {
      state.drawn = [at, at];
      canvas.setPointerCapture(event.pointerId);
    }
    canvas.focus();
    event.preventDefault();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (state.drawn) state.drawn[1] = port().at(event);
    else if (!state.corners) return;
    state.end = port().at(event);
    view.images.paint();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (!state.drawn) return;
    const made = box(state.drawn[0], port().at(event));
    state.drawn = null;
    if (made[2] > 0 && made[3] > 0) add(made);
    else view.images.paint();
  });
  canvas.addEventListener("dblclick", () => { if (state.corners) close(); });
  document.addEventListener("keydown", (event) => {
    if (!state.corners || !["Enter", "Escape", "Backspace"].includes(event.key)) return;
    if (event.key === "Enter") close();
    else state.corners = event.key === "Escape" || state.corners.length < 2 ? null : state.corners.slice(0, -1);
    view.images.paint();
    event.preventDefault();
  });
  view.get("mouse").addEventListener("change", () => { state.corners = null; view.images.paint(); });
  view.get("undo").addEventListener("click", () => {
    if (!state.masks.pop()) state.region = null;
    changed();
  });
  view.get("clear").addEventListener("click", () => {
    [state.region, state.masks] = [null, []];
    changed();
  });

  /* Writing, after a confirmation. */
  view.get("write").addEventListener("click", () => {
    view.get("confirm-file").textContent = view.told.file;
    view.get("confirm-pair").textContent = state.pair.name;
    const marked = (sign, text) => text.split("\n").filter(Boolean).map((line) => `${sign} ${line}`);
    const [old, now] = [state.before.split("\n"), toml().split("\n")];
    view.get("confirm-lines").textContent = [...old.filter((line) => !now.includes(line)).flatMap((line) => marked("−", line)),
      ...now.filter((line) => !old.includes(line)).flatMap((line) => marked("+", line))].join("\n");
    view.get("confirm").showModal();
  });
  view.get("confirm-cancel").addEventListener("click", () => view.get("confirm").close());
  view.get("confirm-write").addEventListener("click", () => {
    view.get("confirm").close();
    const asked = { recording: view.recording, pair: state.pair.number, version: view.told.version, region: state.region, mask: state.masks };
    view.request("outlines", asked).then(async () => {
      const pair = view.get("pairs").value;
      await view.reopen();
      view.get("pairs").value = pair;
      view.get("pairs").dispatchEvent(new Event("change"));
      view.get("region-told").hidden = false;
      view.get("written").textContent = "written";
    }).catch((error) => { view.get("written").textContent = error.message; });
  });

  function trace(pen, outline) {
    if (!isPolygon(outline)) return pen.rect(...outline);
    outline.forEach(([x, y], i) => (i ? pen.lineTo(x + 0.5, y + 0.5) : pen.moveTo(x + 0.5, y + 0.5)));
    return pen.closePath();
  }

  view.region = {
    opened: (pair) => {
      const copy = (one) => structuredClone(one ?? null);
      Object.assign(state, { pair, region: copy(pair.region), masks: copy(pair.mask) ?? [], drawn: null, corners: null });
      state.before = toml();
      changed();
    },
    draw: (pen, scale) => {
      const now = state.drawn ? [[box(...state.drawn), mode()]] : [];
      for (const [one, kind] of [...(state.region ? [[state.region, "region"]] : []), ...state.masks.map((mask) => [mask, "mask"]), ...now]) {
        const colour = view.dye(kind.split("-")[0]);
        pen.lineWidth = 2 * scale;
        [pen.strokeStyle, pen.fillStyle] = [colour, `${colour}59`];
        pen.beginPath();
        trace(pen, one);
        pen.stroke();
        if (kind === "mask") pen.fill();
      }
      if (!state.corners) return;
      pen.strokeStyle = pen.fillStyle = view.dye(mode().split("-")[0]);
      pen.lineWidth = 2 * scale;
      pen.beginPath();
      [...state.corners, ...(state.end ? [state.end] : [])].forEach(([x, y], i) => (i ? pen.lineTo(x + 0.5, y + 0.5) : pen.moveTo(x + 0.5, y + 0.5)));
      pen.stroke();
      for (const [x, y] of state.corners) pen.fillRect(x + 0.5 - 3 * scale, y + 0.5 - 3 * scale, 6 * scale, 6 * scale);
    },
  };
})();
