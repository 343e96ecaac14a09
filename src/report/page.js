/* Charts over time: a cursor that shows the values, and a zoom that applies to all charts of one time axis. Drag to zoom; double click */
/* to reset. */
/* Without this script the page is complete. */
"use strict";
(() => {
  const SVG = document.querySelector("svg")?.namespaceURI;
  /* The element below a figure that shows the values at the pointer; both sizes of a chart share it. */
  const readoutOf = (svg) => {
    const caption = svg.closest("figure").querySelector("figcaption");
    const readout = caption.querySelector(".readout") || document.createElement("span");
    readout.className = "readout";
    caption.append(readout);
    return readout;
  };
  const numbers = (text) => text.split(" ").map(Number);
  const area = (plot) => ["x", "y", "width", "height"].map((name) => Number(plot.getAttribute(name)));
  /* A chart has one plot, or two above each other. */
  const plotOf = (plot, ticks) => {
    const [, top, , height] = area(plot);
    const lines = [...plot.querySelectorAll("path.line")].filter((path) => path.dataset.label).map((path) => ({
      label: path.dataset.label,
      points: path.getAttribute("d").split(/[ML]/).slice(1).map((at) => numbers(at.split("h")[0])),
    }));
    return { plot, top, height, lines, ticks, all: ticks.innerHTML, labelled: Boolean(ticks.querySelector("text")),
      value: numbers(plot.dataset.y), logarithmic: plot.dataset.scale === "log" };
  };
  /* The charts with one time axis, and its visible part as fractions of it. */
  const groups = new Map();
  const charts = [...document.querySelectorAll("svg.time")].map((svg) => {
    const ticks = svg.querySelectorAll("g.ticks");
    const plots = [...svg.querySelectorAll("svg.plot")].map((plot, index) => plotOf(plot, ticks[index]));
    const [left, , width] = area(plots[0].plot), last = plots.at(-1);
    const marks = plots[0].plot.querySelector("use")?.getAttribute("href");
    const changes = (marks ? [...document.querySelectorAll(`${marks} path.change`)] : []).map((path) => ({
      x: numbers(path.getAttribute("d").slice(1))[0], about: path.querySelector("title")?.textContent,
    }));
    const group = groups.get(svg.dataset.x) || { charts: [], visible: [0, 1] };
    groups.set(svg.dataset.x, group);
    const chart = { svg, group, plots, left, width, top: plots[0].top, height: last.top + last.height - plots[0].top, changes,
      readout: readoutOf(svg), time: numbers(svg.dataset.x), names: svg.querySelector("use.names") };
    group.charts.push(chart);
    return chart;
  });
  const element = (name, attributes, text) => {
    const made = document.createElementNS(SVG, name);
    Object.entries(attributes).forEach(([key, value]) => made.setAttribute(key, value));
    made.textContent = text || "";
    return made;
  };
  const showPlot = ({ plot, top, height, ticks, all, labelled }, { left, width, time }, from, to) => {
    plot.setAttribute("viewBox", `${left + from * width} ${top} ${(to - from) * width} ${height}`);
    if (from === 0 && to === 1) { ticks.innerHTML = all; return; }
    const [low, high] = [from, to].map((part) => time[0] + part * (time[1] - time[0]));
    const raw = (high - low) / 8, decade = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((m) => m * decade).find((step) => step >= raw);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    ticks.replaceChildren();
    for (let n = Math.ceil(low / step); n * step <= high; n += 1) {
      const x = left + width * (n * step - low) / (high - low);
      ticks.append(element("path", { class: "grid", d: `M${x} ${top}V${top + height}` }));
      if (labelled) ticks.append(element("text", { x, y: top + height + 15, "text-anchor": "middle" }, (n * step).toFixed(digits)));
    }
  };
  const show = (group, from, to) => {
    group.visible = [from, to];
    for (const chart of group.charts) {
      if (chart.names) chart.names.style.display = from > 0 || to < 1 ? "none" : "";
      chart.plots.forEach((plot) => showPlot(plot, chart, from, to));
    }
  };
  /* Returns the position of the pointer as a fraction of the width of the plot. */
  const part = ({ svg, left, width }, event) => {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    return Math.min(1, Math.max(0, (at.x - left) / width));
  };
  const valuesAt = ({ lines, top, height, value, logarithmic }, x, width) => {
    const valueAt = (y) => {
      const between = value[0] + (1 - (y - top) / height) * (value[1] - value[0]);
      return (logarithmic ? 10 ** between : between).toPrecision(3);
    };
    return lines.map(({ label, points }) => {
      /* A column of a line has a smallest and a largest value at one time. */
      const nearest = Math.min(...points.map(([px]) => Math.abs(px - x)));
      if (!(nearest <= width / 100)) return "";
      const values = points.filter(([px]) => Math.abs(px - x) <= nearest + 0.05).map(([, y]) => valueAt(y));
      const ends = [...new Set([values[0], values.at(-1)])];
      return `${label}: ${ends.join(" to ")}`;
    });
  };
  const point = (chart, at) => {
    const { left, width, plots, changes, time, group: { visible } } = chart;
    const whole = visible[0] + at * (visible[1] - visible[0]), x = left + whole * width;
    const texts = plots.flatMap((plot) => valuesAt(plot, x, width));
    const near = changes.filter((change) => Math.abs(change.x - x) <= width / 150 * (visible[1] - visible[0]));
    const now = time[0] + whole * (time[1] - time[0]);
    chart.readout.textContent = [`t = ${now.toPrecision(4)} s`, ...texts, ...near.map(({ about }) => about)].filter(Boolean).join("; ");
  };
  /* Shows the description of a cell or case below its chart, for touch screens too. */
  for (const svg of document.querySelectorAll("figure > svg:not(.time)")) {
    if (!svg.querySelector("title")) continue;
    const readout = readoutOf(svg);
    const describe = ({ target }) => { readout.textContent = target.querySelector(":scope > title")?.textContent || ""; };
    svg.addEventListener("pointerover", describe);
    svg.addEventListener("pointerdown", describe);
  }
  for (const chart of charts) {
    const { svg, left, top, width, height, group } = chart;
    const cursor = element("path", { class: "cursor" });
    svg.append(cursor);
    let begun = null;
    const move = (event) => {
      const at = part(chart, event), from = begun === null ? at : begun;
      cursor.setAttribute("d", `M${left + at * width} ${top}v${height}` + (from === at ? "" : `M${left + from * width} ${top}v${height}`));
      point(chart, at);
    };
    svg.addEventListener("pointerdown", (event) => { begun = part(chart, event); });
    svg.addEventListener("pointermove", move);
    svg.addEventListener("pointerleave", () => { begun = null; cursor.setAttribute("d", ""); chart.readout.textContent = ""; });
    svg.addEventListener("pointerup", (event) => {
      const [from, to] = [begun === null ? 0 : begun, part(chart, event)].sort((a, b) => a - b);
      const [low, high] = group.visible;
      if (begun !== null && to - from > 0.01) show(group, low + from * (high - low), low + to * (high - low));
      begun = null;
    });
    svg.addEventListener("dblclick", () => show(group, 0, 1));
  }
})();
