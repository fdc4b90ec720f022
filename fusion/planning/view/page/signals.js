/* Channels over time, spectra, phasors, and the track of a subset. */
"use strict";
(() => {
  const COLUMNS = 1200;
  const MOST = 16; // channels drawn at a time
  const state = { chosen: [], plots: [], range: null, asked: 0, timer: 0 };

  /* One stroke through the extremes of each column; plain samples where both are the same. */
  function stroke(edge, low, high) {
    const plain = low.every((value, i) => value === high[i]);
    if (plain) return { x: Array.from(edge.subarray(0, low.length)), y: Array.from(low) };
    const x = [], y = [];
    low.forEach((value, i) => {
      const middle = (edge[i] + edge[i + 1]) / 2;
      x.push(middle, middle);
      y.push(value, high[i]);
    });
    return { x, y };
  }

  async function asked(from, to) {
    const limits = from === undefined ? {} : { from, to };
    const { arrays } = view.numbers(await view.ask("signal", { channels: state.chosen.join(","), columns: COLUMNS, ...limits }));
    return state.chosen.map((_, i) => stroke(arrays[3 * i], arrays[3 * i + 1], arrays[3 * i + 2]));
  }

  async function zoomed() {
    const mine = ++state.asked, { start, end } = state.range, began = performance.now();
    const strokes = await asked(start, end);
    if (mine !== state.asked) return;
    strokes.forEach((data, i) => { state.plots[i].source.data = data; });
    view.get("signals-told").textContent = `${view.short(start)} s to ${view.short(end)} s, answered in ${Math.round(performance.now() - began)} ms`;
    view.get("signals").dataset.zoom = `${start} ${end}`;
  }

  async function draw() {
    state.asked += 1;
    if (!state.chosen.length) return view.show("signals-drawn", []);
    const strokes = await asked();
    const last = Math.max(...strokes.map((one) => one.x[one.x.length - 1]));
    state.range = new Bokeh.Range1d({ start: 0, end: last });
    state.plots = state.chosen.map((number, i) => {
      const channel = view.told.channels[number];
      const plot = view.panel({ title: `${channel.daq}.${channel.name}`, x_range: state.range, height: state.chosen.length > 4 ? 130 : 220,
        x_axis_label: i + 1 < state.chosen.length ? null : "time on the block's own clock / s", y_axis_label: `${channel.quantity} / ${channel.unit}` });
      const source = new Bokeh.ColumnDataSource({ data: strokes[i] });
      plot.line({ field: "x" }, { field: "y" }, { source, line_color: view.css("--mark"), line_width: 1 });
      return { plot, source };
    });
    const later = () => {
      clearTimeout(state.timer);
      state.timer = setTimeout(() => zoomed().catch(view.fail), 40);
    };
    state.range.properties.start.change.connect(later);
    state.range.properties.end.change.connect(later);
    state.whole = () => state.range.setv({ start: 0, end: last });
    view.signals = { range: state.range, plots: state.plots };
    await view.show("signals-drawn", state.plots.map((one) => one.plot), true);
    view.get("signals-told").textContent = "smallest and largest sample of every column; drag or wheel to zoom";
  }

  view.get("whole").addEventListener("click", () => state.whole?.());
  view.parts.signals = {
    opened: () => {
      const boxes = view.told.channels.map((channel, number) => {
        const label = document.createElement("label");
        const box = view.element("input", "", { type: "checkbox", value: number, checked: number === 0 });
        box.addEventListener("change", () => {
          state.chosen = [...view.get("channels").querySelectorAll("input:checked")].map((one) => Number(one.value)).slice(0, MOST);
          draw().catch(view.fail);
        });
        label.append(box, ` ${channel.daq}.${channel.name}`);
        return label;
      });
      view.get("channels").replaceChildren(view.element("legend", `Channels (up to ${MOST})`), ...boxes);
      state.chosen = view.told.channels.length ? [0] : [];
      state.plots = [];
    },
    shown: () => (state.plots.length ? null : draw().catch(view.fail)),
  };

  /* Spectra. */
  async function spectrum() {
    const number = Number(view.get("spectrum-channel").value), channel = view.told.channels[number];
    const { head, arrays: [frequency, amplitude] } = view.numbers(await view.ask("spectrum", { channel: number }));
    const plot = view.panel({ title: `${channel.daq}.${channel.name}`, height: 340, y_axis_type: "log", x_axis_label: "frequency / Hz",
      y_axis_label: `amplitude / ${channel.unit}` });
    plot.line(Array.from(frequency), Array.from(amplitude, (v) => Math.max(v, 1e-300)), { line_color: view.css("--mark") });
    const known = (state.lines ?? []).filter((line) => line.frequency <= frequency[frequency.length - 1]);
    const at = (hz) => amplitude[Math.min(amplitude.length - 1, Math.max(0, frequency.findIndex((f) => f >= hz)))];
    if (known.length) {
      const source = new Bokeh.ColumnDataSource({ data: { x: known.map((one) => one.frequency), y: known.map((one) => at(one.frequency)),
        what: known.map((one) => one.what) } });
      const dots = plot.scatter({ field: "x" }, { field: "y" }, { source, size: 8, fill_color: view.css("--other"), line_color: null });
      plot.add_tools(new Bokeh.HoverTool({ renderers: [dots], tooltips: [["line", "@x Hz"], ["what", "@what"]] }));
    }
    view.get("spectrum-told").textContent = head.told;
    await view.show("spectrum-drawn", [plot]);
  }

  async function named() {
    view.get("spectrum-told").textContent = "looking for lines …";
    const { lines } = await view.ask("lines");
    state.lines = lines;
    view.get("named").replaceChildren(...lines.map((one) => view.row([view.short(one.frequency), one.what, view.short(one.floor), one.use])));
    view.get("lines-table").hidden = false;
    await spectrum();
  }

  view.get("spectrum-channel").addEventListener("change", () => spectrum().catch(view.fail));
  view.get("name-lines").addEventListener("click", () => named().catch(view.fail));
  view.parts.spectra = {
    opened: () => {
      state.lines = null;
      view.get("lines-table").hidden = true;
      view.options("spectrum-channel", view.told.channels.map((one) => `${one.daq}.${one.name}`));
    },
    shown: () => spectrum().catch(view.fail),
  };

  /* Phasors. */
  async function phasors() {
    const found = await view.ask("phasors", { line: view.get("line").value || 0 });
    view.get("phasors-told").textContent = found.told;
    const colours = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];
    const plots = found.panels.map((panel) => {
      const reach = (way) => panel.values.flatMap((one) => [one[way] - one.axes[0], one[way] + one.axes[0]]);
      const middle = (all) => (Math.min(...all) + Math.max(...all)) / 2, half = (all) => (Math.max(...all) - Math.min(...all)) / 2;
      const size = 1.1 * Math.max(half(reach("re")), half(reach("im")), 1e-30);
      const range = (way) => new Bokeh.Range1d({ start: middle(reach(way)) - size, end: middle(reach(way)) + size });
      const plot = view.panel({ title: `${panel.name} / ${panel.unit}`, sizing_mode: "fixed", frame_width: 320, frame_height: 320, width: null, height: null,
        x_range: range("re"), y_range: range("im"), tools: "pan,wheel_zoom,box_zoom,reset,save", toolbar_location: "above",
        x_axis_label: "real part", y_axis_label: "imaginary part" });
      panel.values.forEach((one, i) => {
        const colour = colours[i % colours.length], source = new Bokeh.ColumnDataSource({ data: { x: [one.re], y: [one.im], width: [2 * one.axes[0]],
          height: [2 * one.axes[1]], angle: [one.angle], name: [one.name], size: [one.size] } });
        const dot = plot.scatter({ field: "x" }, { field: "y" }, { source, size: 6, fill_color: colour, line_color: colour, legend_label: one.name });
        plot.ellipse({ field: "x" }, { field: "y" }, { field: "width" }, { field: "height" }, { source, angle: { field: "angle" }, fill_alpha: 0.1,
          fill_color: colour, line_color: colour, legend_label: one.name });
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
    const colours = [view.css("--mark"), view.css("--other"), "#009e73"];
    const plots = head.panels.map((panel) => {
      const plot = view.panel({ title: panel.title, x_axis_label: panel.x, y_axis_label: panel.y, ...(panel.log ? { y_axis_type: "log" } : {}) });
      panel.curves.forEach(([name, x, y], i) => {
        plot.line(Array.from(arrays[x]), Array.from(arrays[y]), { line_color: colours[i], legend_label: name });
        plot.scatter(Array.from(arrays[x]), Array.from(arrays[y]), { size: 4, fill_color: colours[i], line_color: null, legend_label: name });
      });
      return plot;
    });
    await view.show("track", plots);
    view.get("images-told").textContent = [pair.missing, head.told].filter(Boolean).join(" ");
  };
})();
