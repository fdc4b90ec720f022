/* Draws the figures of a page from their data (fusion/report/figure.py) with BokehJS, each when it comes into view. */
"use strict";
(() => {
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const HOVERED = 20000; // points of a panel up to which each tells its numbers
  const PX_PER_IN = 108;
  const links = new Map(); // ranges that move together, by the name of their link
  const linked = new WeakMap(); // the link of a range
  const PALETTES = { viridis: "Viridis256", Blues: "Blues9", RdBu: "RdBu11", cividis: "Cividis256" };

  async function unpacked(id) {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }

  const row = (values) => (values ?? []).map((v) => v ?? NaN);

  /* Colours that carry no meaning follow the page's, light or dark. */
  function ink(colour) {
    return { "#222222": css("--ink"), "#7a7a7a": css("--soft"), "#d9d9d9": css("--line"), "#0072b2": css("--mark") }[colour ?? "#0072b2"]
      ?? colour;
  }

  /* Numbers by the rule of shakercal/_common/digits.py; a test compares both. */
  const [SMALLEST_PLAIN, LARGEST_PLAIN] = [1e-3, 1e6], RAISED = "⁻⁰¹²³⁴⁵⁶⁷⁸⁹";
  const power = (size) => (size === 0 || !Number.isFinite(size) || (SMALLEST_PLAIN <= size && size < LARGEST_PLAIN) ? 0 : Math.floor(Math.log10(size)));
  const raised = (exponent) => "10" + String(exponent).replace(/[-\d]/g, (sign) => RAISED["-0123456789".indexOf(sign)]);
  const signed = (text) => (/^-[0.]*$/.test(text) ? text.slice(1) : text.replace("-", "−"));

  /* Value and U to the second digit of U, else to some digits. */
  function told(value, half, digits = 6) {
    if (!Number.isFinite(value)) return "–";
    const known = Number.isFinite(half) && half > 0, exponent = power(Math.max(Math.abs(value), known ? half : 0));
    const [scaled, u] = [value, half].map((one) => one / 10 ** exponent), tens = exponent ? ` × ${raised(exponent)}` : "";
    if (!known) return signed(String(Number(scaled.toPrecision(digits)))) + tens;
    const places = 1 - Number(u.toExponential(1).split("e")[1]), round = (one) => Math.round(one * 10 ** places) / 10 ** places;
    const body = `${signed(round(scaled).toFixed(Math.max(0, Math.min(places, 20))))} ± ${round(u).toFixed(Math.max(0, Math.min(places, 20)))}`;
    return exponent ? `(${body})${tens}` : body;
  }

  /* Ticks with the decimals that distinguish them, over a power of ten; very large or small decades as powers of ten. */
  function ticked(exponent, log = false) {
    const made = new Bokeh.BasicTickFormatter();
    made.doFormat = (ticks) => {
      const values = Array.from(ticks, (tick) => tick / 10 ** exponent), sorted = values.toSorted((a, b) => a - b);
      if (log) {
        const decades = values.every((v) => v > 0 && Math.abs(Math.log10(v) - Math.round(Math.log10(v))) < 1e-9) && values.some((v) => power(v));
        return values.map((v) => (decades ? raised(Math.round(Math.log10(v))) : told(v, NaN, 3)));
      }
      const step = Math.min(...sorted.slice(1).map((v, k) => v - sorted[k]), ...(sorted.length > 1 ? [] : [Math.abs(sorted[0] ?? 1)]));
      let places = 0;
      while (places < 12 && sorted.some((v) => Math.abs(Number(v.toFixed(places)) - v) > 1e-3 * step)) places += 1;
      return values.map((v) => signed(v.toFixed(places)));
    };
    return made;
  }

  /* The power of ten that is taken off the numbers of a linear axis. */
  function off(range) {
    const exponent = power(Math.max(Math.abs(range.start), Math.abs(range.end)));
    return Math.abs(exponent) > 1 ? exponent : 0;
  }

  /* All values of x or y that the marks of panels on one axis have, with their bars. */
  function extent(panels, way) {
    const [low, high] = way === "x" ? ["left", "right"] : ["low", "high"], panel = panels[0];
    let ends = [];
    for (const mark of panels.flatMap((one) => one.marks)) {
      const half = mark[`half_${way}`];
      const at = row(mark[way]);
      if (mark.kind === "Ellipses") {
        const reach = mark.width.map((w, i) => Math.max(w, mark.height[i]) / 2);
        ends.push(...at.map((v, i) => v - reach[i]), ...at.map((v, i) => v + reach[i]));
      } else if (half) {
        ends.push(...at.map((v, i) => v - (half[i] ?? 0)), ...at.map((v, i) => v + (half[i] ?? 0)));
      } else ends = ends.concat(at);
      if (mark.kind === "Boxes" || mark.kind === "Band") ends = ends.concat(row(mark[low]), row(mark[high]));
      if (mark.kind === "Image") ends.push(...(way === "x" ? [mark.left, mark.right] : [mark.top, mark.bottom]));
      if (mark.kind === "Rule" && (mark.along ?? "y") === way && mark.at.length < 4) ends.push(...row(mark.at));
    }
    ends = ends.filter((v) => Number.isFinite(v) && (!panel[way].log || v > 0));
    const rows = panel[way].names?.length;
    if (rows) return way === "x" ? [-0.6, rows - 0.4] : [rows - 0.4, -0.6];
    if (!ends.length) return panel[way].log ? [0.1, 1] : [0, 1];
    const [least, most] = ends.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
    if (panel[way].log) return [least / 1.3, most * 1.3];
    const room = most > least ? 0.05 * (most - least) : 0.05 * Math.max(Math.abs(most), 1e-30);
    return [least - room, most + room];
  }

  /* A panel with its axes and no marks. shared: ranges that it has from others, if any; beside: the panels on its axes. */
  function empty(panel, size, shared, beside, backend) {
    const B = Bokeh;
    const ranges = ["x", "y"].map((way) => {
      if (shared[way]) return shared[way];
      const [start, end] = panel[way].limits ?? extent(beside[way], way);
      return new B.Range1d({ start, end });
    });
    const plot = B.Plotting.figure({
      width: size.width, height: size.height, tools: [], toolbar_location: null, output_backend: backend,
      x_range: ranges[0], y_range: ranges[1], background_fill_color: null, border_fill_color: null, outline_line_color: null,
      x_axis_type: panel.x.log ? "log" : "linear", y_axis_type: panel.y.log ? "log" : "linear",
      min_border_left: size.left, min_border_right: 14, min_border_top: 4, min_border_bottom: 6,
    });
    plot.title.text = panel.title ?? "";
    plot.title.text_color = css("--ink");
    plot.title.text_font_size = "12px";
    plot.title.text_font_style = "normal";
    [[plot.below[0], panel.x, size.labels_x], [plot.left[0], panel.y, size.labels_y]].forEach(
      ([axis, said, labelled], k) => dress(axis, said, labelled && !panel.blank, ranges[k], k ? size.height / 30 : size.width / 75, k ? 0 : size.width - size.left));
    plot.center.filter((part) => part instanceof B.Grid).forEach((grid, k) => {
      grid.grid_line_color = (k === 0 ? panel.x : panel.y).grid === false || panel.blank ? null : css("--grid");
    });
    if (panel.y.second) second(plot, panel.y);
    if (panel.equal) even(plot, size);
    plot.add_tools(new B.BoxZoomTool(), new B.WheelZoomTool({ modifiers: { ctrl: true } }), new B.ResetTool());
    return plot;
  }

  function dress(axis, said, labelled, range, room, across = 0) {
    const colour = css("--ink"), exponent = said.log || said.names?.length ? 0 : off(range);
    Object.assign(axis, {
      axis_label: labelled ? [said.label, exponent ? `× ${raised(exponent)}` : ""].filter(Boolean).join("   ") : "",
      formatter: ticked(exponent, said.log), axis_label_text_color: colour, major_label_text_color: labelled ? colour : null,
      axis_line_color: colour, major_tick_line_color: colour, minor_tick_line_color: null, axis_label_text_font_style: "normal",
      axis_label_text_font_size: "12px", major_label_text_font_size: "11px", major_tick_in: 0,
    });
    if (said.names?.length) {
      axis.ticker = new Bokeh.FixedTicker({ ticks: said.names.map((_, k) => k) });
      axis.major_label_overrides = new Map(said.names.map((name, k) => [k, name]));
      if (across && said.names.join("").length * 7 > across) axis.major_label_orientation = "vertical";
    } else if (!said.log && !said.ticks?.length) axis.ticker.desired_num_ticks = Math.max(2, Math.min(6, Math.floor(room)));
    else if (said.ticks?.length) axis.ticker = new Bokeh.FixedTicker({ ticks: said.ticks });
  }

  /* A second scale at the right: factor · (value - zero). */
  function second(plot, axis) {
    const [label, zero, factor] = axis.second, range = plot.y_range;
    const other = new Bokeh.Range1d({ start: factor * (range.start - zero), end: factor * (range.end - zero) });
    const follow = () => other.setv({ start: factor * (range.start - zero), end: factor * (range.end - zero) });
    range.properties.start.change.connect(follow);
    range.properties.end.change.connect(follow);
    plot.extra_y_ranges = { second: other };
    const scale = new Bokeh.LinearAxis({ y_range_name: "second" });
    dress(scale, { label }, true, other, 5);
    plot.add_layout(scale, "right");
  }

  /* Widen one of the ranges so that both axes have one scale. */
  function even(plot, size) {
    const [x, y] = [plot.x_range, plot.y_range];
    const inner = [size.width - size.left - 20, size.height - 70];
    const spans = [Math.abs(x.end - x.start), Math.abs(y.end - y.start)];
    const unit = Math.max(spans[0] / inner[0], spans[1] / inner[1]);
    [x, y].forEach((range, k) => {
      const more = (unit * inner[k] - spans[k]) / 2 * Math.sign(range.end - range.start);
      range.setv({ start: range.start - more, end: range.end + more });
    });
  }

  function mapper(scale) {
    const given = Array.isArray(scale.colours) ? scale.colours : Array.from(Bokeh.Palettes[PALETTES[scale.colours] ?? "Viridis256"],
      (c) => "#" + (c >>> 8).toString(16).padStart(6, "0"));
    const palette = blend(scale.colours === "Blues" ? given.reverse() : given);
    const settings = { palette, low: scale.low, high: scale.high, nan_color: css("--line") };
    return scale.log ? new Bokeh.LogColorMapper(settings) : new Bokeh.LinearColorMapper(settings);
  }

  /* 256 colours between some at equal steps. */
  function blend(colours) {
    const parts = colours.map((c) => [1, 3, 5].map((k) => parseInt(String(c).slice(k, k + 2), 16)));
    return Array.from({ length: 256 }, (_, k) => {
      const at = k / 255 * (parts.length - 1), low = Math.min(Math.floor(at), parts.length - 2);
      return "#" + parts[low].map((v, j) => Math.round(v + (at - low) * (parts[low + 1][j] - v)).toString(16).padStart(2, "0")).join("");
    });
  }

  /* Add one mark to a plot; returns what is shown and hidden with it, and what tells numbers. */
  function draw(plot, panel, mark) {
    const B = Bokeh, colour = ink(mark.colour);
    const [x, y] = [row(mark.x), row(mark.y)];
    const parts = [], hovered = [];
    const tips = (count, text) => (count <= HOVERED ? Array.from({ length: count }, (_, k) => text(k)) : []);
    const place = (k) => [
      `${panel.x.names?.length ? "" : `${panel.x.label || "x"}: ${told(x[k], mark.half_x?.[k])}`}`,
      `${panel.y.names?.length ? panel.y.names[Math.round(y[k])] ?? "" : `${panel.y.label || panel.title || "y"}: ${told(y[k], mark.half_y?.[k])}`}`,
    ].filter(Boolean).join("\n");
    const source = (data, tip) => new B.ColumnDataSource({ data: tip.length ? { ...data, tip } : data });
    const named = (text, k) => [mark.names?.[k] ?? mark.label, text].filter(Boolean).join("\n");
    if (mark.kind === "Line") {
      const settings = { line_color: colour, line_width: 1.25 * (mark.width ?? 1.1), line_dash: mark.dashed ? "dashed" : "solid" };
      const of = source({ x, y }, tips(x.length, (k) => named(place(k), k)));
      parts.push(mark.step ? plot.step({ x: { field: "x" }, y: { field: "y" }, source: of, mode: "after", ...settings })
        : plot.line({ x: { field: "x" }, y: { field: "y" }, source: of, ...settings }));
      hovered.push(parts[0]);
    } else if (mark.kind === "Points") {
      ["x", "y"].filter((way) => mark[`half_${way}`]).forEach((way) => {
        const half = row(mark[`half_${way}`]);
        const [a, b] = [-1, 1].map((sign) => (way === "x" ? x : y).map((v, k) => v + sign * half[k]));
        const floor = panel[way].log ? a.map((v, k) => (v > 0 ? v : b[k] * 1e-9)) : a;
        const ends = way === "x" ? { x0: floor, x1: b, y0: y, y1: y } : { x0: x, x1: x, y0: floor, y1: b };
        parts.push(plot.segment({ ...ends, line_color: colour, line_width: 1.3 }));
        for (const cap of [floor, b]) {
          const at = way === "x" ? { x: cap, y } : { x, y: cap };
          parts.push(plot.scatter({ ...at, marker: "dash", size: 7, angle: way === "x" ? Math.PI / 2 : 0, line_color: colour }));
        }
      });
      const fill = mark.values ? { field: "v", transform: mapper(mark.scale) } : mark.open || mark.marker === "x" ? null : colour;
      const of = source({ x, y, ...(mark.values ? { v: row(mark.values) } : {}) },
        tips(x.length, (k) => named(place(k) + (mark.values ? `\n${mark.scale.label || "value"}: ${told(mark.values[k] ?? NaN)}` : ""), k)));
      const shape = { plus: "cross" }[mark.marker] ?? mark.marker ?? "circle";
      parts.push(plot.scatter({ x: { field: "x" }, y: { field: "y" }, source: of, marker: shape, size: (shape === "diamond" ? 2.1 : 1.5) * (mark.size ?? 4.5),
        fill_color: fill, line_color: mark.values ? null : colour }));
      hovered.push(parts.at(-1));
      if (mark.values && mark.scale.label) bar(plot, fill.transform, mark.scale);
    } else if (mark.kind === "Bounds") {
      const across = mark.along === "x";
      const of = source({ x, y }, tips(x.length, (k) => named(place(k).replace(/(.*): /s, "$1: < "), k)));
      parts.push(plot.scatter({ x: { field: "x" }, y: { field: "y" }, source: of, marker: "inverted_triangle", size: 8,
        angle: across ? -Math.PI / 2 : 0, fill_color: null, line_color: colour, line_width: 1.4 }));
      hovered.push(parts[0]);
    } else if (mark.kind === "Band") {
      const [low, high] = [row(mark.low), row(mark.high)];
      for (let from = 0, to = 0; to <= x.length; to += 1) {
        if (to < x.length && Number.isFinite(low[to]) && Number.isFinite(high[to])) continue;
        const cut = (values) => values.slice(from, to);
        if (to - from > 1) parts.push(plot.varea({ x: cut(x), y1: cut(low), y2: cut(high), fill_color: colour, fill_alpha: 0.25 }));
        from = to + 1;
      }
    } else if (mark.kind === "Span") {
      const ends = mark.along === "x" ? { left: mark.low, right: mark.high } : { bottom: mark.low, top: mark.high };
      const span = new B.BoxAnnotation({ ...ends, fill_color: colour, fill_alpha: mark.opacity, line_color: null, level: "underlay" });
      plot.add_layout(span);
      parts.push(span);
    } else if (mark.kind === "Rule") {
      const settings = { line_color: colour, line_width: 1.25 * (mark.width ?? 0.8), line_dash: mark.dashed ? "dashed" : "solid" };
      const of = new B.ColumnDataSource({ data: { at: row(mark.at) } }), at = { field: "at" };
      parts.push(mark.along === "x" ? plot.vspan(at, { source: of, ...settings }) : plot.hspan(at, { source: of, ...settings }));
    } else if (mark.kind === "Ellipses") {
      const turn = Array.from({ length: 97 }, (_, k) => 2 * Math.PI * k / 96);
      x.forEach((x0, k) => {
        const [a, b, phi] = [mark.width[k] / 2, mark.height[k] / 2, mark.angle_rad[k]];
        const [c, s] = [Math.cos(phi), Math.sin(phi)];
        parts.push(plot.line({ x: turn.map((t) => x0 + a * Math.cos(t) * c - b * Math.sin(t) * s),
          y: turn.map((t) => y[k] + a * Math.cos(t) * s + b * Math.sin(t) * c), line_color: colour, line_width: 1.4 }));
      });
    } else if (mark.kind === "Boxes") {
      const ends = { left: row(mark.left), right: row(mark.right), bottom: row(mark.low), top: row(mark.high) };
      const values = mark.values ? row(mark.values) : null;
      const fill = values ? { field: "v", transform: mapper(mark.scale) } : mark.filled === false ? null : colour;
      const of = source({ ...ends, ...(values ? { v: values } : {}) }, tips(ends.left.length, (k) => named(values
        ? `${mark.scale.label || "value"}: ${told(values[k])}`
        : panel.y.names?.length ? `${panel.x.label}: ${told(ends.right[k])}` : `${panel.x.label}: ${told(ends.left[k])} … ${told(ends.right[k])}\n${panel.y.label}: ${told(ends.bottom[k])} … ${told(ends.top[k])}`, k)));
      parts.push(plot.quad({ left: { field: "left" }, right: { field: "right" }, bottom: { field: "bottom" }, top: { field: "top" },
        source: of, fill_color: fill, fill_alpha: values ? 1 : 0.8, line_color: mark.filled === false ? colour : null, line_width: 0.8 }));
      hovered.push(parts[0]);
      if (values && mark.scale.label) bar(plot, fill.transform, mark.scale);
    } else if (mark.kind === "Arrows") {
      const [dx, dy] = [row(mark.dx), row(mark.dy)];
      const tip = { x: x.map((v, k) => v + dx[k]), y: y.map((v, k) => v + dy[k]) };
      const flip = Math.sign(plot.y_range.end - plot.y_range.start);
      parts.push(plot.segment({ x0: x, y0: y, x1: tip.x, y1: tip.y, line_color: colour, line_width: 1.1 }));
      parts.push(plot.scatter({ ...tip, marker: "triangle", size: 5, fill_color: colour, line_color: null,
        angle: dx.map((v, k) => Math.atan2(flip * dy[k], v) - Math.PI / 2) }));
    } else if (mark.kind === "Texts") {
      const [across, up] = mark.offset_px ?? [0, 0];
      parts.push(plot.text({ x, y, text: mark.texts, text_align: mark.align ?? "center", text_baseline: "middle", text_color: colour,
        text_font_size: "11px", x_offset: across, y_offset: -up, ...(mark.upright ? { angle: Math.PI / 2, text_align: "left" } : {}) }));
    } else if (mark.kind === "Image") {
      const { left, right, top, bottom } = mark;
      parts.push(plot.image_url({ url: [mark.grey], x: [left], y: [top], w: [Math.abs(right - left)], h: [Math.abs(bottom - top)],
        anchor: "top_left" }));
    }
    return { parts, hovered };
  }

  function bar(plot, color_mapper, scale) {
    const colour = css("--ink");
    plot.add_layout(new Bokeh.ColorBar({ color_mapper, title: scale.label, height: 8, margin: 0, padding: 4, bar_line_color: null,
      background_fill_color: null, major_label_text_color: colour, title_text_color: colour, formatter: ticked(0, scale.log), title_text_font_style: "normal",
      title_text_font_size: "11px", major_label_text_font_size: "10px", major_tick_line_color: colour }), "below");
  }

  /* All panels of a figure as a grid of plots; hidden: names that are not shown; straight: no logarithmic axis of y. */
  function assemble(figure, width, state, backend) {
    const columns = figure.widths.length, total = figure.widths.reduce((a, b) => a + b);
    const rows = figure.heights.length, tall = figure.heights.reduce((a, b) => a + b);
    const whole = Math.max(figure.height_in * PX_PER_IN * Math.min(1, Math.max(width / 900, 0.75)), 120 * rows);
    const tied = [], named = new Map(), plots = [], grid = [];
    const narrow = width < 620 && columns > 1;
    const panels = figure.panels.map((given) => (state.straight
      ? { ...given, y: { ...given.y, log: false, limits: given.y.log ? undefined : given.y.limits } } : given));
    const tied_x = figure.shared_x && !narrow && rows > 1, tied_y = figure.shared_y && columns > 1;
    const around = figure.heights.map((_, r) => (r === rows - 1 || !tied_x ? 48 : 10)
      + (panels.slice(r * columns, (r + 1) * columns).some((panel) => panel.title) ? 20 : 0));
    const inside = Math.max(whole - around.reduce((a, b) => a + b), 60 * rows);
    panels.forEach((panel, k) => {
      const [r, c] = [Math.floor(k / columns), k % columns];
      const longest = Math.max(0, ...(panel.y.names ?? []).map((name) => name.length));
      const size = {
        width: Math.floor(narrow ? width : width * figure.widths[c] / total),
        height: Math.floor(inside * figure.heights[r] / tall + around[r]), left: Math.min(58 + 5 * longest, width / 2),
        labels_x: !tied_x || r === rows - 1, labels_y: !tied_y || c === 0 || narrow,
      };
      const shared = { x: tied_x && r > 0 ? tied[c]?.x : undefined, y: tied_y && c > 0 ? tied[r * columns]?.y : undefined };
      const beside = {
        x: tied_x ? panels.filter((_, n) => n % columns === c) : [panel],
        y: tied_y ? panels.slice(r * columns, (r + 1) * columns) : [panel],
      };
      const plot = empty(panel, size, shared, beside, backend);
      if (panel.blank) [...plot.below, ...plot.left].forEach((axis) => { axis.visible = false; });
      tied[k] = { x: plot.x_range, y: plot.y_range };
      const telling = [], named_x = { ...panel, x: { ...panel.x, label: panel.x.label ?? beside.x.at(-1).x.label } };
      for (const mark of panel.marks) {
        const { parts, hovered } = draw(plot, named_x, mark);
        telling.push(...hovered);
        if (!mark.label) continue;
        named.set(mark.label, [...(named.get(mark.label) ?? []), ...parts]);
        if (state.hidden.has(mark.label)) parts.forEach((part) => { part.visible = false; });
      }
      if (telling.length) plot.add_tools(new Bokeh.HoverTool({ renderers: telling, point_policy: "snap_to_data", line_policy: "nearest",
        tooltips: '<div class="tip" style="white-space:pre-line;max-width:24em">@tip</div>', attachment: "horizontal" }));
      for (const way of ["x", "y"]) if (panel[way].link) tie(panel[way].link, plot[`${way}_range`]);
      plots.push(plot);
      if (narrow) grid.push([plot]);
      else (grid[r] ??= []).push(plot);
    });
    return { grid: Bokeh.Plotting.gridplot(grid, { toolbar_location: null }), plots, named };
  }

  /* Let the ranges of plots go that are drawn no more. */
  function untie(plots) {
    for (const range of plots.flatMap((plot) => [plot.x_range, plot.y_range])) links.get(linked.get(range))?.delete(range);
  }

  /* Let a range move with all others of its link. */
  function tie(link, range) {
    const all = links.get(link) ?? new Set();
    links.set(link, all.add(range));
    linked.set(range, link);
    const follow = () => {
      for (const other of all) if (other !== range && (other.start !== range.start || other.end !== range.end)) other.setv({ start: range.start, end: range.end });
    };
    range.properties.end.change.connect(follow);
    range.properties.start.change.connect(follow);
  }

  function button(text, label, act) {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    made.title = label;
    made.setAttribute("aria-label", label);
    made.addEventListener("click", () => act(made));
    return made;
  }

  /* Legend: a button per name that shows and hides what has it. */
  function legend(figure, state, drawn) {
    const list = document.createElement("div");
    list.className = "legend";
    list.setAttribute("aria-label", "Legend");
    const first = new Map();
    figure.panels.forEach((panel) => panel.marks.forEach((mark) => mark.label && (!first.has(mark.label) || (first.get(mark.label).kind === "Line" && mark.kind === "Points")) && first.set(mark.label, mark)));
    for (const [label, mark] of first) {
      const made = button(label, `show or hide ${label}`, () => {
        const hide = !state.hidden.delete(label);
        if (hide) state.hidden.add(label);
        made.setAttribute("aria-pressed", String(!hide));
        (drawn.named.get(label) ?? []).forEach((part) => { part.visible = !hide; });
      });
      made.setAttribute("aria-pressed", String(!state.hidden.has(label)));
      const swatch = document.createElement("span");
      swatch.className = `swatch ${mark.kind}${mark.open ? " open" : ""}${mark.dashed ? " dashed" : ""} ${mark.marker ?? ""}`;
      swatch.style.setProperty("--swatch", ink(mark.colour));
      made.prepend(swatch);
      list.append(made);
    }
    return list;
  }

  /* What belongs to the figure as a table, one row per value. */
  function csv(figure) {
    const text = (value) => (/[",\n]/.test(value) ? `"${value.replaceAll('"', '""')}"` : value);
    const lines = [["panel", "series", "kind", "name", "x_quantity", "x", "U_x", "y_quantity", "y", "U_y", "value"].join(",")];
    const cell = (values, k) => (values?.[k] ?? "");
    figure.panels.forEach((panel, p) => panel.marks.forEach((mark) => {
      const middle = (a, b) => (a ?? []).map((v, k) => (v + b[k]) / 2);
      const x = mark.x ?? (mark.left ? mark.right : []), y = mark.y ?? (mark.kind === "Band" ? middle(mark.low, mark.high) : mark.low ?? []);
      if (!Array.isArray(x)) return;
      const half = mark.kind === "Band" ? mark.high.map((v, k) => (v - mark.low[k]) / 2) : mark.half_y;
      x.forEach((_, k) => lines.push([text(panel.title || String(p + 1)), text(mark.label ?? ""), mark.kind,
        text(mark.names?.[k] ?? panel.y.names?.[Math.round(y[k])] ?? mark.texts?.[k] ?? ""), text(panel.x.label ?? ""), cell(x, k), cell(mark.half_x, k),
        text(panel.y.label ?? ""), cell(y, k), cell(half, k), cell(mark.values, k)].join(",")));
    }));
    return lines.join("\r\n") + "\r\n";
  }

  function save(name, blob) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  async function svg(figure, width, state) {
    const away = document.createElement("div");
    away.style.cssText = "position:absolute;left:-10000px;top:0";
    document.body.append(away);
    const drawn = assemble(figure, width, state, "svg"), view = await Bokeh.Plotting.show(drawn.grid, away);
    await new Promise((ready) => setTimeout(ready, 50));
    const blob = await view.export("svg").to_blob();
    untie(drawn.plots);
    view.model.document?.clear();
    away.remove();
    return blob;
  }

  /* Zoom (factor below 1: in) or move (share of the span) all horizontal axes: what the mouse does, for the keyboard. */
  function move(plots, factor, share) {
    const alone = new Map([...plots].reverse().map((plot) => [linked.get(plot.x_range) ?? plot.x_range, plot])); // of a link the first
    alone.forEach((plot) => {
      const range = plot.x_range;
      const log = plot.x_scale instanceof Bokeh.LogScale;
      const [start, end] = [range.start, range.end].map((value) => (log ? Math.log(value) : value));
      const middle = (start + end) / 2 + share * (end - start), half = factor * (end - start) / 2;
      const [low, high] = [middle - half, middle + half].map((value) => (log ? Math.exp(value) : value));
      range.setv({ start: low, end: high });
    });
  }

  function prepare(element, figure) {
    const host = element.querySelector(".plot"), state = { hidden: new Set(), straight: false };
    const bars = document.createElement("div");
    bars.className = "tools";
    let drawn = null, view = null, running = Promise.resolve();
    const redraw = () => (running = running.then(async () => {
      view?.model.document?.clear();
      untie(drawn?.plots ?? []);
      host.replaceChildren();
      drawn = assemble(figure, host.clientWidth, state, "canvas");
      bars.querySelector(".legend")?.replaceWith(legend(figure, state, drawn));
      view = await Bokeh.Plotting.show(drawn.grid, host);
      host.style.minHeight = "";
      element.dataset.drawn = "true";
    }));
    const straight = button("log / linear", "logarithmic or linear axes", () => { state.straight = !state.straight; redraw(); });
    straight.hidden = !figure.panels.some((panel) => panel.y.log);
    const buttons = document.createElement("span");
    buttons.className = "buttons";
    buttons.append(
      button("−", "zoom out", () => move(drawn.plots, 1.5, 0)), button("+", "zoom in", () => move(drawn.plots, 1 / 1.5, 0)),
      button("◂", "move left", () => move(drawn.plots, 1, -0.25)), button("▸", "move right", () => move(drawn.plots, 1, 0.25)),
      button("reset", "show all", redraw), straight,
      button("CSV", `data of “${figure.title}” as a table`, () => save(`${figure.name}.csv`, new Blob(["\ufeff", csv(figure)], { type: "text/csv" }))),
      button("SVG", `“${figure.title}” as a vector graphic`, async () => save(`${figure.name}.svg`, await svg(figure, host.clientWidth, state))),
    );
    const list = document.createElement("div");
    list.className = "legend";
    bars.append(list, buttons);
    host.before(bars);
    return redraw;
  }

  /* The image of every figure for paper; those of main figures are in the page as they are. */
  async function paper(elements) {
    const drawings = JSON.parse(await unpacked("figures-paper"));
    const images = elements.filter((one) => one.dataset.figure in drawings).flatMap((element) => {
      const made = drawings[element.dataset.figure].map((drawing) => {
        const image = new Image();
        image.className = "static";
        image.alt = element.querySelector(".plot").ariaLabel;
        image.src = URL.createObjectURL(new Blob([drawing], { type: "image/svg+xml" }));
        return image;
      });
      element.querySelector(".static").replaceWith(...made);
      return made;
    });
    await Promise.all(images.map((image) => image.decode()));
    document.documentElement.dataset.printable = "";
  }

  async function start() {
    const begun = performance.now();
    const [code, data] = await Promise.all([unpacked("figures-library"), unpacked("figures-data")]);
    const script = document.createElement("script");
    script.textContent = code;
    document.head.append(script);
    const redraws = new Map();
    const figures = new Map(JSON.parse(data).map((figure) => [figure.name, figure]));
    const elements = [...document.querySelectorAll("figure[data-figure]")];
    const show = async (element) => {
      if (redraws.has(element)) return;
      const redraw = prepare(element, figures.get(element.dataset.figure));
      redraws.set(element, redraw);
      await redraw();
      document.documentElement.dataset.interactive ??= String(Math.round(performance.now() - begun));
    };
    const seen = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach((entry) => show(entry.target)),
      { rootMargin: "300px" });
    elements.forEach((element) => seen.observe(element));
    const again = () => redraws.forEach((redraw) => redraw());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
    let width = innerWidth, waiting = 0;
    addEventListener("resize", () => {
      if (innerWidth === width) return;
      width = innerWidth;
      clearTimeout(waiting);
      waiting = setTimeout(again, 200);
    });
    await new Promise((ready) => (window.requestIdleCallback ?? setTimeout)(ready, { timeout: 1000 }));
    await paper(elements);
  }

  document.documentElement.classList.add("js");
  start().catch((error) => { document.documentElement.classList.remove("js"); throw error; });
})();
