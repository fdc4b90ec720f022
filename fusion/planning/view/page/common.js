/* What the parts of the page share: requests, texts as texts, and curves drawn by BokehJS. */
"use strict";
const view = { recording: 0, told: null, parts: {} };

view.get = (id) => document.getElementById(id);
view.css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

view.fail = (error) => { if (error?.name !== "AbortError") view.get("error").textContent = error?.message ?? String(error); };

view.ask = async (what, asked = {}, signal = undefined) => {
  const answer = await fetch(`api/${what}?${new URLSearchParams({ recording: view.recording, ...asked })}`, { signal });
  if (!answer.ok) throw new Error((await answer.json()).error ?? answer.statusText);
  view.get("error").textContent = "";
  return answer.headers.get("Content-Type") === "application/json" ? answer.json() : answer.arrayBuffer();
};

/* Request a change of a file. */
view.request = async (what, asked) => {
  const answer = await fetch(`api/${what}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(asked) });
  const found = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new Error(found.error ?? answer.statusText);
  view.get("error").textContent = "";
  return found;
};

/* Head of an answer in numbers, and where its body begins. */
view.head = (buffer) => {
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  return { head: JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length))), at: 8 + length };
};

/* Head and arrays of doubles of an answer in numbers. */
view.numbers = (buffer) => {
  let { head, at } = view.head(buffer);
  const arrays = head.lengths.map((count) => {
    const part = new Float64Array(buffer, at, count);
    at += 8 * count;
    return part;
  });
  return { head, arrays };
};

view.element = (kind, text = "", settings = {}) => Object.assign(document.createElement(kind), { textContent: text, ...settings });

view.options = (id, texts) => view.get(id).replaceChildren(...texts.map((text, value) => view.element("option", text, { value })));

view.row = (texts) => {
  const row = document.createElement("tr");
  row.append(...texts.map((text) => (text instanceof Node ? Object.assign(document.createElement("td"), {}).appendChild(text).parentNode : view.element("td", text))));
  return row;
};

view.short = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(6))) : "–");

/* A colour of the reports: their black is the page's ink. */
view.colour = (colour) => (colour === view.told?.palette.ink ? view.css("--ink") : colour);
view.dye = (name) => view.colour(view.told.palette[name]);

/* List notices: code, place, sentence and remedy. */
view.notices = (id, notices) => view.get(id).replaceChildren(...notices.map((one) => {
  const row = document.createElement("li");
  row.append(view.element("b", `⚠ ${one.code}`), ` ${one.where}: ${one.text}`);
  if (one.remedy) row.append(" ", view.element("small", `→ ${one.remedy}`));
  return row;
}));

/* A panel of BokehJS in the colours of the page. */
view.panel = (settings) => {
  const plot = Bokeh.Plotting.figure({ sizing_mode: "stretch_width", height: 220, tools: "xpan,xwheel_zoom,xbox_zoom,box_zoom,reset,hover,save",
    output_backend: "canvas", background_fill_color: view.css("--back"), border_fill_color: view.css("--back"), ...settings });
  const ink = view.css("--ink"), line = view.css("--line");
  plot.title.text_color = ink;
  plot.outline_line_color = line;
  for (const axis of [plot.xaxis, plot.yaxis]) {
    axis.axis_label_text_color = axis.major_label_text_color = axis.axis_line_color = ink;
    axis.major_tick_line_color = axis.minor_tick_line_color = ink;
  }
  for (const grid of [plot.xgrid, plot.ygrid]) grid.grid_line_color = line;
  if (plot.toolbar) plot.toolbar.logo = null;
  return plot;
};

/* Show plots in an element; together: as one document, as plots with an axis in common have to be. */
view.show = async (id, plots, together = false) => {
  const host = view.get(id);
  for (const shown of host.bokeh ?? []) shown.clear();
  host.replaceChildren();
  host.bokeh = [];
  for (const plot of together && plots.length ? [new Bokeh.Column({ children: plots, sizing_mode: "stretch_width" })] : plots) {
    const place = document.createElement("div");
    host.append(place);
    host.bokeh.push({ clear: ((shown) => () => shown.then((one) => one.remove?.()))(Bokeh.Plotting.show(plot, place)) });
  }
  const ink = view.css("--ink");
  for (const legend of plots.flatMap((plot) => plot.legend?.items ? [plot.legend] : [])) {
    Object.assign(legend, { background_fill_color: view.css("--back"), background_fill_alpha: 0.7, label_text_color: ink, border_line_color: null });
  }
  host.dataset.drawn = String(plots.length);
};
