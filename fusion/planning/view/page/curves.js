/* Spectra, phasors, and the track of a subset. */
"use strict";
(() => {
  const state = { lines: null, asked: 0, timer: 0, range: null };

  /* Spectra. On the logarithmic axis the bin at 0 Hz is drawn at half the first frequency, the left edge. */
  const isLog = () => view.get("frequency-axis").value === "log";

  async function bins(number, limits = {}) {
    const { head, arrays: [frequency, amplitude] } = view.numbers(await view.ask("spectrum", { channel: number, log: isLog() ? 1 : 0, ...limits }));
    const x = Array.from(frequency, (hz) => (isLog() ? Math.max(hz, head.step / 2) : hz));
    return { head, data: { x, y: Array.from(amplitude, (value) => Math.max(value, 1e-300)) } };
  }

  function markLines(plot, { x, y }) {
    const known = (state.lines ?? []).filter((line) => line.frequency <= x[x.length - 1]);
    if (!known.length) return;
    const nearest = (hz) => x.reduce((best, f, i) => (Math.abs(f - hz) < Math.abs(x[best] - hz) ? i : best), 0);
    const source = new Bokeh.ColumnDataSource({ data: { x: known.map((one) => one.frequency), y: known.map((one) => y[nearest(one.frequency)]),
      what: known.map((one) => one.what) } });
    const dots = plot.scatter({ field: "x" }, { field: "y" }, { source, size: 8, fill_color: view.dye("line"), line_color: null });
    plot.add_tools(new Bokeh.HoverTool({ renderers: [dots], tooltips: [["line", "@x Hz"], ["what", "@what"]] }));
  }

  async function spectrum() {
    const mine = ++state.asked, number = Number(view.get("spectrum-channel").value), channel = view.told.channels[number];
    view.notices("spectrum-refused", []);
    const { head, data } = await bins(number);
    if (mine !== state.asked) return;
    const [first, last] = [data.x[0], data.x[data.x.length - 1]];
    const range = new Bokeh.Range1d({ start: isLog() ? first : 0, end: last });
    const plot = view.panel({ title: `${channel.daq}.${channel.name}`, height: 340, y_axis_type: "log", x_axis_label: "frequency / Hz", x_range: range,
      x_axis_type: isLog() ? "log" : "linear", y_axis_label: `amplitude / ${head.unit || "as stored"}` });
    if (isLog()) plot.add_layout(new Bokeh.Label({ x: first, y: 2, y_units: "screen", x_offset: 3, text: "0 Hz", text_color: view.css("--soft"), text_font_size: "12px" }));
    const source = new Bokeh.ColumnDataSource({ data });
    plot.line({ field: "x" }, { field: "y" }, { source, line_color: view.colour(channel.colour) });
    markLines(plot, data);
    const later = () => {
      clearTimeout(state.timer);
      state.timer = setTimeout(async () => {
        const found = await bins(number, { from: Math.max(0, isLog() && range.start <= first ? 0 : range.start), to: Math.max(range.end, range.start + head.step) });
        if (mine === state.asked) source.data = found.data;
      }, 60);
    };
    range.properties.start.change.connect(later);
    range.properties.end.change.connect(later);
    view.spectrum = { range, source };
    if (head.refused) view.notices("spectrum-refused", [head.refused]);
    view.get("spectrum-told").textContent = head.told;
    await view.show("spectrum-drawn", [plot]);
    view.get("spectrum-drawn").dataset.axis = `${number} ${view.get("frequency-axis").value}`;
  }

  async function named() {
    view.get("spectrum-told").textContent = "looking for lines …";
    const { lines } = await view.ask("lines").finally(() => { view.get("spectrum-told").textContent = ""; });
    state.lines = lines;
    view.get("named").replaceChildren(...lines.map((one) => view.row([view.short(one.frequency), one.what, view.short(one.floor), one.use])));
    view.get("lines-table").hidden = false;
    await spectrum();
  }

  const failed = (error) => { view.fail(error); view.show("spectrum-drawn", []); };
  for (const id of ["spectrum-channel", "frequency-axis"]) view.get(id).addEventListener("change", () => spectrum().catch(failed));
  view.get("name-lines").addEventListener("click", () => named().catch(view.fail));
  view.parts.spectra = {
    opened: () => {
      state.lines = null;
      view.get("lines-table").hidden = true;
      view.options("spectrum-channel", view.told.channels.map((one) => `${one.daq}.${one.name}`));
    },
    shown: () => spectrum().catch(failed),
  };

  /* Phasors: colour and marker of each source as in the report, named once. */
  const SIGNS = { circle: "●", square: "■", diamond: "◆", triangle: "▲" };
  async function phasors() {
    const found = await view.ask("phasors", { line: view.get("line").value || 0 });
    view.get("phasors-told").textContent = found.told;
    const sources = new Map(found.panels.flatMap((panel) => panel.values).map((one) => [one.source, one]));
    view.get("phasors-legend").replaceChildren(...[...sources].map(([source, one]) => {
      const entry = view.element("span", ` ${source}`), sign = view.element("span", SIGNS[one.marker] ?? "●");
      sign.style.color = view.colour(one.colour);
      entry.prepend(sign);
      return entry;
    }));
    const plots = found.panels.map((panel) => {
      const reach = (way) => panel.values.flatMap((one) => [one[way] - one.axes[0], one[way] + one.axes[0]]);
      const middle = (all) => (Math.min(...all) + Math.max(...all)) / 2, half = (all) => (Math.max(...all) - Math.min(...all)) / 2;
      const size = 1.1 * Math.max(half(reach("re")), half(reach("im")), 1e-30);
      const range = (way) => new Bokeh.Range1d({ start: middle(reach(way)) - size, end: middle(reach(way)) + size });
      const plot = view.panel({ title: `${panel.name} / ${panel.unit}`, sizing_mode: "fixed", frame_width: 320, frame_height: 320, width: null, height: null,
        x_range: range("re"), y_range: range("im"), tools: "pan,wheel_zoom,box_zoom,reset,save", toolbar_location: "above",
        x_axis_label: "real part", y_axis_label: "imaginary part" });
      panel.values.forEach((one) => {
        const colour = view.colour(one.colour), source = new Bokeh.ColumnDataSource({ data: { x: [one.re], y: [one.im], width: [2 * one.axes[0]],
          height: [2 * one.axes[1]], angle: [one.angle], name: [one.name], size: [one.size] } });
        const dot = plot.scatter({ field: "x" }, { field: "y" }, { source, size: 7, marker: one.marker, fill_color: colour, line_color: colour });
        plot.ellipse({ field: "x" }, { field: "y" }, { field: "width" }, { field: "height" }, { source, angle: { field: "angle" }, fill_alpha: 0.1,
          fill_color: colour, line_color: colour });
        plot.add_tools(new Bokeh.HoverTool({ renderers: [dot], tooltips: [["from", "@name"], ["value", "@size"]] }));
      });
      return plot;
    });
    await view.show("phasors-drawn", plots);
  }

  view.get("line").addEventListener("change", () => phasors().catch(view.fail));
  view.parts.phasors = {
    opened: () => view.options("line", (view.told.resultLines ?? []).map((hz) => `${view.short(hz)} Hz`)),
    shown: () => phasors().catch(view.fail),
  };

  /* The track of a subset. */
  view.drawTrack = async (pair, point) => {
    const { head, arrays } = view.numbers(await view.ask("track", { pair: pair.number, point }));
    const plots = head.panels.map((panel) => {
      const plot = view.panel({ title: panel.title, x_axis_label: panel.x, y_axis_label: panel.y });
      panel.curves.forEach(([name, x, y, colour]) => {
        plot.line(Array.from(arrays[x]), Array.from(arrays[y]), { line_color: colour, legend_label: name });
        plot.scatter(Array.from(arrays[x]), Array.from(arrays[y]), { size: 4, fill_color: colour, line_color: null, legend_label: name });
      });
      return plot;
    });
    await view.show("track", plots);
    view.get("images-told").textContent = [pair.missing, head.told].filter(Boolean).join(" ");
  };
})();
