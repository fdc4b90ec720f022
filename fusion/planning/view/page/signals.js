/* Channels over time: those of one recorder on its own time axis. */
"use strict";
(() => {
  const COLUMNS = 1200;
  const MOST = 16; // channels drawn at a time
  const state = { chosen: [], groups: [], asked: 0 };

  /* One stroke through the extremes of each column; plain samples where both are the same. */
  function stroke(edge, low, high) {
    const plain = low.every((value, i) => value === high[i] || Number.isNaN(value));
    if (plain) return { x: Array.from(edge.subarray(0, low.length)), y: Array.from(low) };
    const x = [], y = [];
    low.forEach((value, i) => {
      const middle = (edge[i] + edge[i + 1]) / 2;
      x.push(middle, middle);
      y.push(value, high[i]);
    });
    return { x, y };
  }

  async function asked(numbers, limits = {}) {
    const { head, arrays } = view.numbers(await view.ask("signal", { channels: numbers.join(","), columns: COLUMNS, ...limits }));
    const strokes = new Map(head.channels.map((number, i) => [number, stroke(arrays[3 * i], arrays[3 * i + 1], arrays[3 * i + 2])]));
    return { ...head, strokes };
  }

  async function zoomed(group) {
    const mine = ++group.asked, { start, end } = group.range, began = performance.now();
    const { strokes } = await asked(group.plots.map((one) => one.number), { from: start, to: end });
    if (mine !== group.asked) return;
    for (const { number, source } of group.plots) source.data = strokes.get(number);
    view.get("signals-told").textContent = `${group.daq}: ${view.short(start)} s to ${view.short(end)} s, answered in ${Math.round(performance.now() - began)} ms`;
    view.get("signals").dataset.zoom = `${start} ${end}`;
  }

  function panel(group, number, found, last) {
    const channel = view.told.channels[number];
    const plot = view.panel({ title: `${channel.daq}.${channel.name}`, x_range: group.range, height: state.chosen.length > 4 ? 130 : 220,
      x_axis_label: last ? `time on the clock of ${channel.daq} / s` : null, y_axis_label: `${channel.quantity} / ${found.units[number] || "as stored"}` });
    const source = new Bokeh.ColumnDataSource({ data: found.strokes.get(number) });
    plot.line({ field: "x" }, { field: "y" }, { source, line_color: view.colour(channel.colour), line_width: 1 });
    return { plot, source, number };
  }

  async function grouped(daq, numbers) {
    const found = await asked(numbers);
    const ends = [...found.strokes.values()].map((one) => one.x[one.x.length - 1]), end = Math.max(...ends);
    const group = { daq, found, asked: 0, timer: 0, range: new Bokeh.Range1d({ start: 0, end: Number.isFinite(end) && end > 0 ? end : 1 }) };
    group.plots = found.channels.map((number, i) => panel(group, number, found, i + 1 === found.channels.length));
    const later = () => {
      clearTimeout(group.timer);
      group.timer = setTimeout(() => zoomed(group).catch(view.fail), 40);
    };
    group.range.properties.start.change.connect(later);
    group.range.properties.end.change.connect(later);
    group.whole = () => group.range.setv({ start: 0, end });
    return group;
  }

  function refused(groups) {
    const listed = groups.flatMap(({ found }) => [...Object.values(found.refused), ...Object.values(found.remarks)]);
    view.notices("signals-refused", [...new Map(listed.map((one) => [JSON.stringify(one), one])).values()]);
    for (const { found } of groups) {
      for (const number of [...Object.keys(found.refused), ...Object.keys(found.remarks)]) {
        view.get("channels").querySelector(`label[data-number="${number}"] b`).textContent = " ⚠";
      }
    }
  }

  async function draw() {
    const mine = ++state.asked, recorders = new Map();
    for (const number of state.chosen) {
      const { daq } = view.told.channels[number];
      recorders.set(daq, [...(recorders.get(daq) ?? []), number]);
    }
    const groups = await Promise.all([...recorders].map(([daq, numbers]) => grouped(daq, numbers)));
    if (mine !== state.asked) return;
    state.groups = groups;
    refused(groups);
    const plots = groups.flatMap((group) => group.plots);
    view.signals = { range: groups[0]?.range, groups };
    await view.show("signals-drawn", plots.map((one) => one.plot), true);
    view.get("signals-told").textContent = plots.length ? "smallest and largest sample of every column; drag or wheel to zoom; each recorder has its own clock" : "";
  }

  view.get("whole").addEventListener("click", () => state.groups.forEach((group) => group.whole()));
  view.parts.signals = {
    opened: () => {
      const boxes = view.told.channels.map((channel, number) => {
        const label = document.createElement("label");
        label.dataset.number = number;
        const box = view.element("input", "", { type: "checkbox", value: number, checked: number === 0 });
        box.addEventListener("change", () => {
          state.chosen = [...view.get("channels").querySelectorAll("input:checked")].map((one) => Number(one.value)).slice(0, MOST);
          draw().catch(view.fail);
        });
        label.append(box, ` ${channel.daq}.${channel.name}`, document.createElement("b"));
        return label;
      });
      view.get("channels").replaceChildren(view.element("legend", `Channels (up to ${MOST})`), ...boxes);
      state.chosen = view.told.channels.length ? [0] : [];
      state.groups = [];
      view.notices("signals-refused", []);
    },
    shown: () => (state.groups.length ? null : draw().catch(view.fail)),
  };
})();
