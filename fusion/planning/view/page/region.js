/* Region of interest and masks, drawn with the mouse on the left picture; the lines that recording.toml takes. */
"use strict";
(() => {
  const state = { region: null, masks: [], drawn: null };
  const canvas = view.get("left");

  function text() {
    const told = (box) => `[${box.join(", ")}]`;
    const lines = [];
    if (state.region) lines.push(`region = ${told(state.region)}`);
    if (state.masks.length) lines.push(`mask = [${state.masks.map(told).join(", ")}]`);
    view.get("lines").value = lines.join("\n");
    view.get("region-told").hidden = !lines.length;
  }

  /* Whole pixels [x, y, width, height] of what lies between two corners. */
  function box([a, b], [c, d]) {
    const end = (value, most) => Math.min(most, Math.max(0, Math.round(value + 0.5)));
    const x = [end(a, canvas.width), end(c, canvas.width)].sort((p, q) => p - q);
    const y = [end(b, canvas.height), end(d, canvas.height)].sort((p, q) => p - q);
    return [x[0], y[0], x[1] - x[0], y[1] - y[0]];
  }

  canvas.addEventListener("pointerdown", (event) => {
    if (view.get("mouse").value === "pick" || !canvas.width) return;
    state.drawn = [view.where(canvas, event), view.where(canvas, event)];
    canvas.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!state.drawn) return;
    state.drawn[1] = view.where(canvas, event);
    view.images.paint();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (!state.drawn) return;
    const made = box(state.drawn[0], view.where(canvas, event));
    state.drawn = null;
    if (made[2] > 0 && made[3] > 0) {
      if (view.get("mouse").value === "region") state.region = made;
      else state.masks.push(made);
    }
    text();
    view.images.paint();
  });
  view.get("undo").addEventListener("click", () => {
    if (!state.masks.pop()) state.region = null;
    text();
    view.images.paint();
  });
  view.get("clear").addEventListener("click", () => {
    [state.region, state.masks] = [null, []];
    text();
    view.images.paint();
  });
  view.region = {
    opened: (pair) => {
      [state.region, state.masks, state.drawn] = [pair.region ?? null, (pair.mask ?? []).map((one) => [...one]), null];
      text();
    },
    draw: (pen, scale) => {
      pen.lineWidth = 2 * scale;
      const now = state.drawn && [box(...state.drawn), view.get("mouse").value];
      for (const [one, kind] of [[state.region, "region"], ...state.masks.map((mask) => [mask, "mask"]), now ?? [null, ""]]) {
        if (!one) continue;
        pen.strokeStyle = kind === "mask" ? "#cc79a7" : "#00d084";
        pen.strokeRect(...one);
        if (kind === "mask") {
          pen.fillStyle = "rgba(204, 121, 167, 0.35)";
          pen.fillRect(...one);
        }
      }
    },
  };
})();
