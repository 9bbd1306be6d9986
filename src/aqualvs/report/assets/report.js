"use strict";
/* Draws the charts of a report from the JSON that the page carries. All text from files passes
   through `plain`, because Plotly reads a few tags in labels. */
(function () {
  const data = JSON.parse(document.getElementById("report-data").textContent);
  /* The colours of the page, light or dark; those of lasers and labels are the data's. */
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const faded = (hex, share) => hex + Math.round(255 * share).toString(16).padStart(2, "0");
  let INK, GRID, EDGE, PAPER, MEASURED;
  function pickColours() {
    [INK, GRID, EDGE, PAPER, MEASURED] =
      ["--ink", "--line", "--quiet", "--paper", "--accent"].map(css);
  }
  const PAPER_WIDTH = 690;
  const CONFIG = { displaylogo: false, responsive: true };
  const FLAT = { ...CONFIG, modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]] };
  const SMALL = { ...CONFIG, displayModeBar: false };
  const SOLID = { ...CONFIG, modeBarButtons: [["toImage", "orbitRotation", "resetCameraDefault3d"]] };
  const charts = [];

  const plain = (text) =>
    String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  const box = (id) => document.getElementById(id);
  const axis = (title, more) => Object.assign(
    { title: { text: title, standoff: 8, font: { size: 13 } }, gridcolor: GRID, zeroline: false, automargin: true,
      linecolor: EDGE, ticks: "outside", tickcolor: EDGE }, more);
  const layout = (more) => Object.assign({
    font: { family: "system-ui, -apple-system, Segoe UI, Roboto, Arial, sans-serif",
            size: 13, color: INK },
    paper_bgcolor: PAPER, plot_bgcolor: PAPER,
    margin: { l: 64, r: 14, t: 26, b: 46 },
    legend: { orientation: "h", x: 0, y: 1.01, yanchor: "bottom" },
    hoverlabel: { bgcolor: PAPER, bordercolor: EDGE, font: { color: INK } },
  }, more);

  function draw(id, traces, shape, config) {
    const place = box(id);
    if (!place) return;
    Plotly.newPlot(place, traces, shape, config);
    if (!charts.includes(place)) charts.push(place);
  }

  /* A line is drawn in segments, parted where the data have a gap. */
  function segments(line) {
    const parts = [];
    let first = 0;
    for (const last of [...line.breaks, line.x.length - 1]) {
      if (last >= first) parts.push([first, last]);
      first = last + 1;
    }
    return parts;
  }
  function lifted(line, keys) {
    const out = {};
    for (const key of keys) out[key] = [];
    for (const [first, last] of segments(line))
      for (const key of keys) out[key].push(...line[key].slice(first, last + 1), null);
    return out;
  }
  function band(line, sigma) {
    const x = [], y = [];
    const middle = (i) => (line.error ? 0 : line.y[i]);
    for (const [first, last] of segments(line)) {
      for (let i = first; i <= last; i++) { x.push(line.x[i]); y.push(middle(i) + sigma[i]); }
      for (let i = last; i >= first; i--) { x.push(line.x[i]); y.push(middle(i) - sigma[i]); }
      x.push(null); y.push(null);
    }
    return { x, y };
  }
  function shading(stretches, limits) {
    const x = [], y = [], far = 10 * (limits[1] - limits[0]);
    const low = limits[0] - far, high = limits[1] + far;
    for (const { from, to } of stretches) {
      x.push(from, from, to, to, from, null);
      y.push(low, high, high, low, low, null);
    }
    return { x, y };
  }
  function single(line) {
    const alone = segments(line).filter(([a, b]) => a === b).map(([a]) => a);
    return { x: alone.map((i) => line.x[i]), y: alone.map((i) => line.y[i]) };
  }

  /* Range, pitch and yaw above each other on one time axis: the posture, or its error. */
  function strips(id, chart, height) {
    if (!chart) return;
    const traces = [];
    const shape = layout({ height, hovermode: "x unified", hoversubplots: "axis",
                           margin: { l: 70, r: 14, t: 34, b: 48 } });
    shape.xaxis = axis(`time, ${chart.time_unit}`, { anchor: "y3", range: padded(chart.span),
      hoverformat: ".2f", unifiedhovertitle: { text: `%{x} ${chart.time_unit}` } });
    /* Near enough that a pointer in a gap does not show the posture beside it. */
    shape.hoverdistance = Math.round(Math.min(20, Math.max(3, 540 / (chart.strips[0].x.length + 1))));
    chart.strips.forEach((strip, i) => {
      const y = i ? `y${i + 1}` : "y";
      const top = 1 - i * 0.345;
      shape[i ? `yaxis${i + 1}` : "yaxis"] = axis(`${strip.name}, ${strip.unit}`,
        { domain: [Math.max(0, top - 0.31), top], range: strip.axis, zeroline: strip.error,
          zerolinecolor: EDGE, hoverformat: i ? ".2f" : ".1f" });
      if (chart.stretches.length)
        traces.push({ ...shading(chart.stretches, strip.axis), yaxis: y, type: "scatter",
          mode: "lines", fill: "toself", fillcolor: "rgba(90,100,106,0.17)", line: { width: 0 },
          hoverinfo: "skip", name: "no posture", showlegend: i === 0, legendrank: 2000 });
      for (const [key, ink, name] of [["total", 0.2, "±σ, frame and rig"], ["sigma", 0.3, "±σ, frame alone"]])
        traces.push({ ...band(strip, strip[key]), yaxis: y, type: "scatter", mode: "lines", fill: "toself",
          fillcolor: faded(MEASURED, ink), line: { width: 0 }, hoverinfo: "skip",
          name, showlegend: i === 0, legendgroup: `band-${key}` });
      if (strip.truth)
        traces.push({ ...lifted(strip.truth, ["x", "y"]), yaxis: y, type: "scatter", mode: "lines",
          line: { color: INK, width: 1.3, dash: "dash" }, name: "truth", showlegend: i === 0,
          hovertemplate: `%{y} ${strip.unit}<extra>true ${strip.name}</extra>` });
      const line = lifted(strip, ["x", "y", "sigma", "total", "frame"]);
      const told = (s) => (s === null || s === undefined ? "?" : s.toFixed(i ? 2 : 1));
      traces.push({ x: line.x, y: line.y, yaxis: y, type: "scatter", mode: "lines",
        line: { color: MEASURED, width: strip.x.length > 1000 ? 0.9 : 1.6 }, name: chart.measured, showlegend: i === 0,
        customdata: line.total.map((s, k) => [told(s), told(line.sigma[k]), line.frame[k]]),
        hovertemplate: `%{y} ± %{customdata[0]} ${strip.unit}, its noise ± %{customdata[1]} (frame %{customdata[2]})` +
          `<extra>${strip.name}</extra>` });
      traces.push({ ...single(strip), yaxis: y, type: "scatter", mode: "markers", hoverinfo: "skip",
        marker: { color: MEASURED, size: 3.5 }, showlegend: false });
    });
    const hints = { x: [], y: [], text: [] }, middle = mean(chart.strips[0].axis);
    for (const gap of chart.stretches)
      for (const x of gap.hover) { hints.x.push(x); hints.y.push(middle); hints.text.push(plain(gap.words)); }
    traces.push({ ...hints, type: "scatter", mode: "markers", name: "no posture",
      marker: { size: 9, opacity: 0, color: "#5a646a" }, showlegend: false,
      hovertemplate: "%{text}<extra>no posture</extra>" });
    draw(id, traces, shape, FLAT);
  }
  const mean = (pair) => (pair[0] + pair[1]) / 2;
  function padded(span) {
    const room = Math.max(0.01 * (span[1] - span[0]), 1e-3);
    return [span[0] - room, span[1] + room];
  }

  let chosen = 0;
  function planes() {
    const chart = data.planes;
    if (!chart || !chart.frames.length) return;
    chosen = Math.floor(chart.frames.length / 2);
    const slider = box("plane-slider");
    slider.max = chart.frames.length - 1;
    slider.value = chosen;
    const go = (i) => {
      chosen = Math.min(Math.max(i, 0), chart.frames.length - 1);
      slider.value = chosen;
      plane(chart);
      if (cloudMode === "frame") cloud("frame");
    };
    slider.addEventListener("input", () => go(Number(slider.value)));
    box("plane-back").addEventListener("click", () => go(chosen - 1));
    box("plane-next").addEventListener("click", () => go(chosen + 1));
  }
  function plane(chart) {
    const frame = chart.frames[chosen];
    box("plane-words").textContent = frame.words;
    frame.lasers.forEach((points, index) => {
      if (!chart.known[index]) return;
      const laser = data.lasers[index], limits = chart.axes, traces = [];
      data.labels.forEach((label, code) => {
        const mine = points.label.flatMap((value, i) => (value === code ? [i] : []));
        traces.push({ x: mine.map((i) => points.x[i]), y: mine.map((i) => points.y[i]),
          type: "scatter", mode: "markers", name: label.name, showlegend: false,
          marker: { color: label.colour, symbol: label.symbol, size: code ? 5 : 4.5, opacity: 0.85 },
          hovertemplate: "x %{x} mm<br>y %{y} mm" });
      });
      if (points.line && Math.abs(points.line[1]) > 1e-3) {
        const [a, b, c] = points.line;
        traces.unshift({ x: limits.x, y: limits.x.map((x) => (c - a * x) / b), type: "scatter",
          mode: "lines", line: { color: INK, width: 1, dash: "dot" }, hoverinfo: "skip",
          showlegend: false });
      }
      const shape = layout({ height: 330, margin: { l: 58, r: 10, t: 34, b: 44 },
        title: { text: plain(laser.name), x: 0.02, font: { size: 14 } }, hovermode: "closest" });
      shape.xaxis = axis("x, mm", { range: limits.x });
      shape.yaxis = axis("y (forward), mm", { range: limits.y, scaleanchor: "x" });
      shape.shapes = [{ type: "line", xref: "paper", yref: "paper", x0: 0, x1: 1, y0: 1.02, y1: 1.02,
        line: { color: laser.colour, width: 4 } }];
      const place = box(`chart-plane-${index}`);
      if (place.data) Plotly.react(place, traces, shape, SMALL);
      else draw(place.id, traces, shape, SMALL);
    });
  }

  let cloudMode = "dive";
  function framePoints(index) {
    const basis = data.planes.basis[index], out = { x: [], y: [], z: [] };
    if (!basis) return out;
    const points = data.planes.frames[chosen].lasers[index];
    points.used.forEach((used, i) => {
      if (!used) return;
      ["x", "y", "z"].forEach((name, k) => out[name].push(
        basis.origin[k] + points.x[i] * basis.x[k] + points.y[i] * basis.y[k]));
    });
    return out;
  }
  const origin = () => (data.cloud.dome_radius_mm ? "dome" : "lens");
  function dome() {
    const r = data.cloud.dome_radius_mm || 30, x = [], y = [], z = [];
    for (let turn = 0; turn < 4; turn++) {
      const a = (turn * Math.PI) / 4;
      for (let i = 0; i <= 24; i++) {
        const b = (i / 24) * Math.PI;
        x.push(r * Math.cos(b) * Math.cos(a)); y.push(r * Math.sin(b)); z.push(r * Math.cos(b) * Math.sin(a));
      }
      x.push(null); y.push(null); z.push(null);
    }
    for (let i = 0; i <= 48; i++) {
      const a = (i / 24) * Math.PI;
      x.push(r * Math.cos(a)); y.push(0); z.push(r * Math.sin(a));
    }
    return { x, y, z, type: "scatter3d", mode: "lines", name: origin(), hoverinfo: "name",
             line: { color: INK, width: 2 } };
  }
  /* In the target's frame the dome is before the plane's origin, at one range after the other. */
  function domePlaces() {
    const ranges = data.cloud.dome_mm || [];
    return { x: ranges.map(() => 0), y: ranges.map((r) => -r), z: ranges.map(() => 0), type: "scatter3d",
             mode: "lines+markers", name: `${origin()}, nearest to farthest`, hovertemplate: "range %{customdata} mm",
             customdata: ranges, marker: { size: 4, color: INK }, line: { color: INK, width: 4 } };
  }
  function cloud(mode) {
    if (!data.cloud || !box("chart-cloud")) return;
    cloudMode = mode;
    const place = box("chart-cloud");
    const traces = data.lasers.map((laser, index) => ({
      ...(mode === "frame" ? framePoints(index) : data.cloud.lasers[index]),
      type: "scatter3d", mode: "markers", name: plain(laser.name),
      marker: { size: mode === "frame" ? 2.6 : 1.7, color: laser.colour },
      hovertemplate: `right %{x:.0f}<br>${mode === "frame" ? "forward" : "beyond the plane"} %{y:.0f}<br>up %{z:.0f} mm`,
    }));
    traces.push(mode === "frame" ? dome() : domePlaces());
    // A narrow page shows less beside the middle.
    const far = place.clientWidth < 600 ? 1.5 : 1.1;
    const of3 = (title) => ({ title: { text: title }, gridcolor: GRID, color: INK, zeroline: false,
                              backgroundcolor: PAPER, showspikes: false, nticks: 6 });
    const shape = layout({ height: 500, margin: { l: 0, r: 0, t: 30, b: 0 },
      legend: { orientation: "h", x: 0, y: 1.0, yanchor: "bottom", itemsizing: "constant" },
      uirevision: mode,
      scene: { aspectmode: "data", xaxis: of3("right, mm"), yaxis: of3(mode === "frame" ? "forward, mm" : "beyond the plane, mm"),
               zaxis: of3("up, mm"), camera: mode === "frame"
                 ? { eye: { x: -1.6, y: -1.5, z: 0.95 }, center: { x: 0.1, y: 0.05, z: -0.22 } }
                 : { eye: { x: -0.95 * far, y: -1.75 * far, z: 0.8 * far }, center: { x: 0, y: 0, z: -0.12 } } } });
    if (place.data) Plotly.react(place, traces, shape, SOLID);
    else {
      draw("chart-cloud", traces, shape, SOLID);
      place.on("plotly_relayout", () => later(snapshot));
    }
    for (const button of document.querySelectorAll("[data-cloud]"))
      button.setAttribute("aria-pressed", String(button.dataset.cloud === mode));
    later(snapshot);
  }
  /* Browsers print an empty box for WebGL; a picture of the same view stands in on paper. */
  let timer = 0;
  function later(job) { clearTimeout(timer); timer = setTimeout(job, 400); }
  function snapshot() {
    Plotly.toImage(box("chart-cloud"), { format: "png", width: PAPER_WIDTH, height: 480, scale: 2 })
      .then((url) => { box("cloud-paper").src = url; })
      .catch(() => { box("cloud-paper").removeAttribute("src"); });
  }

  function histogram(id, chart, title) {
    if (!chart) return;
    const ends = [chart.x[0] - chart.step, chart.x[chart.x.length - 1] + chart.step];
    const traces = chart.lasers.map((counts, index) => ({
      x: [ends[0], ...chart.x, ends[1]], y: [0, ...counts, 0], type: "scatter", mode: "lines", fill: "tozeroy",
      line: { shape: "hvh", color: data.lasers[index].colour, width: 1.8 },
      fillcolor: data.lasers[index].colour + "26", name: plain(data.lasers[index].name),
      hovertemplate: "%{x}: %{y} points" }));
    const shape = layout({ height: 300, hovermode: "closest", showlegend: false });
    shape.xaxis = axis(title);
    shape.yaxis = axis("points", { rangemode: "tozero" });
    draw(id, traces, shape, SMALL);
  }
  function quality() {
    const chart = data.quality;
    if (!chart) return;
    const counts = chart.counts.map((line, index) => ({
      ...lifted(line, ["x", "y"]), type: "scatter", mode: "lines", name: plain(data.lasers[index].name),
      line: { color: data.lasers[index].colour, width: 1.4 } }));
    const shape = (title) => Object.assign(
      layout({ height: 300, hovermode: "x unified", showlegend: false }),
      { xaxis: axis(`time, ${chart.time_unit}`), yaxis: axis(title, { rangemode: "tozero" }) });
    const spread = [["rms", "rms residual", MEASURED], ["sigma", "σ of the range", INK]];
    draw("chart-counts", counts, shape("target points"), SMALL);
    draw("chart-rms", spread.map(([key, name, color]) => ({ ...lifted(chart[key], ["x", "y"]),
      type: "scatter", mode: "lines", line: { color, width: 1.4 }, name })),
      Object.assign(shape("mm"), { showlegend: true }), SMALL);
    histogram("chart-residual", chart.residual, "distance from the plane, mm");
    histogram("chart-quality", chart.quality, "stripe quality (0 to 1)");
  }

  function bare() {
    const chart = data.bare;
    if (!chart) return;
    const styles = [["truth", "truth", INK, "dash"], ["bare", "without refraction", "#D55E00", "solid"],
                    ["dome", "with it", MEASURED, "solid"]];
    const traces = styles.filter(([key]) => chart[key]).map(([key, name, color, dash]) => ({
      ...lifted(chart[key], ["x", "y"]), type: "scatter", mode: "lines", name,
      line: { color, dash, width: 1.6 } }));
    const shape = layout({ height: 320, hovermode: "x unified" });
    shape.xaxis = axis(`time, ${chart.time_unit}`);
    shape.yaxis = axis("range, mm", { hoverformat: ".1f" });
    draw("chart-bare", traces, shape, FLAT);
  }

  /* On paper every chart takes the width of its place there. */
  function paper() {
    for (const place of charts) {
      const half = place.closest(".grid") !== null;
      const tall = place.id === "chart-posture";
      Plotly.relayout(place, { width: half ? PAPER_WIDTH / 2 - 10 : PAPER_WIDTH,
                               ...(tall ? { height: 500 } : {}) });
    }
  }
  function screen() {
    for (const place of charts)
      Plotly.relayout(place, { width: null, autosize: true,
                               ...(place.id === "chart-posture" ? { height: 640 } : {}) });
  }
  const dark = matchMedia("(prefers-color-scheme: dark)");
  window.addEventListener("beforeprint", () => {
    document.documentElement.dataset.theme = "light";
    if (dark.matches) drawAll();
    paper();
  });
  window.addEventListener("afterprint", () => {
    delete document.documentElement.dataset.theme;
    if (dark.matches) drawAll();
    screen();
  });
  dark.addEventListener("change", () => drawAll());

  for (const button of document.querySelectorAll("[data-cloud]"))
    button.addEventListener("click", () => cloud(button.dataset.cloud));
  function drawAll() {
    pickColours();
    strips("chart-posture", data.posture, 640);
    strips("chart-error", data.error, 520);
    if (data.planes && data.planes.frames.length) plane(data.planes);
    quality();
    bare();
    cloud(cloudMode);
  }
  /* The library is a third as large when packed. */
  async function unpack() {
    const bytes = Uint8Array.from(atob(box("chart-library").textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  }
  unpack().then(() => {
    planes();
    drawAll();
    document.documentElement.dataset.ready = "true";
  }).catch((fault) => {
    const words = document.createElement("p");
    words.className = "warn";
    words.textContent = `The charts could not be drawn (${fault.message}); a newer browser may.`;
    document.querySelector("main").prepend(words);
    throw fault;
  });
})();
