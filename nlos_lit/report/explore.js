/* The page's behaviour: unpacks what report/explore.py has put into it, draws it with plotly, and follows the
   controls. Arrays are packed as nlos_lit/io/views.py says. */
"use strict";
(async () => {
  const at = (id) => document.getElementById(id);
  const header = JSON.parse(at("header").textContent);
  const facts = header.facts;
  const INFERNO = ["#000004", "#420a68", "#932667", "#dd513a", "#fca50a", "#fcffa4"].map((c, k) => [k / 5, c]);
  const SIGNED = ["#7f3b08", "#e08214", "#f7f7f7", "#8073ac", "#2d004b"].map((c, k) => [k / 4, c]);
  const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7"];

  async function unpacked(id) {
    const bytes = Uint8Array.from(atob(at(id).textContent.trim()), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).arrayBuffer();
  }

  if (!("DecompressionStream" in window)) {
    at("message").textContent =
      "This browser is too old to unpack the page: it needs one of 2023 or later.";
    return;
  }
  const library = document.createElement("script");
  library.textContent = new TextDecoder().decode(await unpacked("plotly"));
  document.head.append(library);
  const buffer = await unpacked("data");
  const TYPES = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i4: Int32Array, f4: Float32Array };
  const array = {};
  for (const [name, a] of Object.entries(header.arrays))
    array[name] = new TYPES[a.type](buffer, a.offset, a.shape.reduce((n, m) => n * m, 1));

  // Transients: whole numbers of √(largest)/65534; 65535 was not recorded.
  const [S, T] = header.arrays.counts.shape;
  const MISSING = 65535, STEPS = 65534;
  const stretched = (packed, whole) => Float64Array.from(packed, (q) => {
    const value = header.largest * (q / STEPS) ** 2;
    return q === MISSING ? NaN : whole ? Math.round(value) : value;
  });
  const counts = stretched(array.counts, header.whole);
  const models = header.models.map((_, k) => stretched(array[`model${k}`], false));
  const metres = (bin) => header.path[0] + (bin + 0.5) * header.path[1];
  const sigma = facts.counts;
  const unit = sigma ? "σ" : "difference";

  /* Sum over the bins [from, to) of a spot, of the bins that were recorded. */
  function sum(values, spot, from, to) {
    let total = 0, any = false;
    for (let k = spot * T + from; k < spot * T + to; k++)
      if (!Number.isNaN(counts[k])) { total += values[k]; any = true; }
    return any ? total : NaN;
  }
  const left = (n, m) => (sigma ? (m > 0 ? (n - m) / Math.sqrt(m) : n > 0 ? NaN : 0) : n - m);
  function residual(k, spot, from, to) { return left(sum(counts, spot, from, to), sum(models[k], spot, from, to)); }

  // What is chosen and looked at; kept over a reload while the run goes on.
  const place = "explore " + facts.name + " " + (facts.origin ? facts.origin.command : "");
  const state = Object.assign(
    { what: "counts", bin: -1, spot: middle(), axis: "z", slice: -1, level: 30, camera: null, live: true,
      layers: {}, profile: null, scroll: 0, focus: null },
    restored(),
  );
  if (!(state.spot >= 0 && state.spot < S)) state.spot = middle();
  if (state.bin >= T) state.bin = -1;
  function restored() { try { return JSON.parse(sessionStorage.getItem(place)) || {}; } catch { return {}; } }
  function remember() { try { sessionStorage.setItem(place, JSON.stringify(state)); } catch { /* not kept */ } }
  /* All that has no event of its own: where the eye stands, how far the page is scrolled, what has the keyboard. */
  function leave() {
    const told = at("hidden")._fullLayout;
    if (told && told.scene && told.scene._scene) state.camera = camera();
    state.scroll = window.scrollY;
    state.focus = document.activeElement ? document.activeElement.id : null;
    remember();
  }
  function middle() {
    const near = header.wall.x.length >> 1, high = header.wall.y.length >> 1;
    const found = array.wall[high * header.wall.x.length + near];
    return found >= 0 ? found : 0;
  }

  const base = { margin: { l: 52, r: 12, t: 8, b: 42 }, font: { family: "system-ui, sans-serif", size: 13, color: "#1a1a1a" },
    paper_bgcolor: "#fff", plot_bgcolor: "#e4e4e4", dragmode: false };
  const config = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["lasso2d", "select2d"] };
  /* Names of curves above them: beside each other, or one below the other where there is no room. */
  const named = (id, n) => ({ legend: { orientation: "h", y: 1, yanchor: "bottom", x: 0 },
    margin: { ...base.margin, t: at(id).clientWidth < 600 ? 12 + 20 * n : 34 } });
  const quantile = (values, q) => {
    const known = Array.from(values).filter(Number.isFinite).sort((a, b) => a - b);
    return known.length ? known[Math.min(known.length - 1, Math.floor(q * known.length))] : 0;
  };
  const short = (value, digits = 4) => (Number.isFinite(value)
    ? String(Number(value.toPrecision(digits))).replace("-", "−") : "–");
  const signed = (value) => (Number.isFinite(value) ? (value >= 0 ? "+" : "−") + Math.abs(value).toFixed(2) : "–");

  // Hidden scene
  const [nz, nx, ny] = header.grid ? header.grid.shape : [0, 0, 0];
  const along = (axis, k) => header.grid.origin["xyz".indexOf(axis)] + k * header.grid.pitch["xyz".indexOf(axis)];

  /* The volume in blocks that a phone can turn, each as bright as its brightest voxel. */
  function coarse() {
    const step = Math.max(1, Math.ceil(Math.cbrt((nz * nx * ny) / 60000)));
    const size = [nz, nx, ny].map((n) => Math.ceil(n / step));
    const value = new Float32Array(size[0] * size[1] * size[2]);
    for (let z = 0, k = 0; z < nz; z++) for (let x = 0; x < nx; x++) for (let y = 0; y < ny; y++, k++) {
      const to = ((((z / step) | 0) * size[1]) + ((x / step) | 0)) * size[2] + ((y / step) | 0);
      if (array.volume[k] > value[to]) value[to] = array.volume[k];
    }
    const X = [], Y = [], Z = [], half = (step - 1) / 2;
    for (let z = 0; z < size[0]; z++) for (let x = 0; x < size[1]; x++) for (let y = 0; y < size[2]; y++) {
      X.push(along("x", x * step + half)); Y.push(along("y", y * step + half)); Z.push(along("z", z * step + half));
    }
    return { X, Y, Z, value: Array.from(value, (v) => v / 255) };
  }

  const shown3d = [];
  function scene() {
    const traces = [];
    const add = (name, usual, trace) => { const visible = name in state.layers ? state.layers[name] : usual; shown3d.push({ name, index: traces.length }); traces.push({ ...trace, name, visible, showlegend: false }); };
    const solid = header.meshes.length + header.clouds.length > 0;
    if (header.grid) {
      const c = coarse();
      add("volume", !solid, { type: "isosurface", x: c.X, y: c.Y, z: c.Z, value: c.value, isomin: state.level / 100, isomax: 1,
        surface: { count: 2 }, opacity: 0.55, colorscale: INFERNO, cmin: 0, cmax: 1, showscale: false,
        caps: { x: { show: false }, y: { show: false }, z: { show: false } }, hoverinfo: "skip" });
    }
    header.clouds.forEach((name, k) => {
      const rows = array[`cloud${k}`], n = rows.length / 7, col = (j) => Array.from({ length: n }, (_, i) => rows[7 * i + j]);
      const grey = col(6);
      add(name, k === header.clouds.length - 1, { type: "scatter3d", mode: "markers", x: col(0), y: col(1), z: col(2),
        marker: { size: n > 5000 ? 1.6 : 3, color: grey, cmin: 0, cmax: quantile(grey, 0.98), colorscale: "Viridis" },
        hovertemplate: "x %{x:.3f}, y %{y:.3f}, z %{z:.3f} m<br>albedo %{marker.color:.3g}<extra></extra>" });
    });
    header.meshes.forEach((name, k) => {
      const v = array[`vertices${k}`], t = array[`triangles${k}`];
      const vertex = (j) => Array.from({ length: v.length / 4 }, (_, i) => v[4 * i + j]);
      const corner = (j) => Array.from({ length: t.length / 3 }, (_, i) => t[3 * i + j]);
      add(name, header.clouds.length === 0, { type: "mesh3d", x: vertex(0), y: vertex(1), z: vertex(2), i: corner(0), j: corner(1), k: corner(2),
        vertexcolor: vertex(3).map((g) => { const c = Math.round(60 + 180 * g); return `rgb(${c},${c},${c})`; }),
        lighting: { ambient: 0.5, diffuse: 0.7, specular: 0.05 }, lightposition: { x: 0, y: 0.5, z: -3 }, hoverinfo: "skip" });
    });
    const low = (k) => Math.min(...Array.from({ length: S }, (_, s) => array.places[2 * s + k]));
    const high = (k) => Math.max(...Array.from({ length: S }, (_, s) => array.places[2 * s + k]));
    const [x0, x1, y0, y1] = [low(0), high(0), low(1), high(1)];
    add("scanned wall", true, { type: "scatter3d", mode: "lines", x: [x0, x1, x1, x0, x0], y: [y0, y0, y1, y1, y0],
      z: [0, 0, 0, 0, 0], line: { color: "#0072B2", width: 4 }, hoverinfo: "skip" });
    const axis = (title) => ({ title: { text: title }, backgroundcolor: "#f4f4f4", showbackground: true, gridcolor: "#cfcfcf" });
    Plotly.newPlot("hidden", traces, { ...base, dragmode: "orbit", margin: { l: 0, r: 0, t: 0, b: 0 }, scene: { aspectmode: "data", dragmode: "orbit",
      xaxis: axis("x (m)"), yaxis: axis("y (m)"), zaxis: axis("z, depth (m)"),
      camera: state.camera || { eye: { x: 0.45, y: 0.3, z: -2.05 }, up: { x: 0, y: 1, z: 0 }, center: { x: 0, y: -0.12, z: 0 } } } }, config);
    for (const { name, index } of shown3d) {
      const label = document.createElement("label"), box = document.createElement("input");
      box.type = "checkbox"; box.checked = traces[index].visible; box.dataset.trace = name;
      box.addEventListener("change", () => { state.layers[name] = box.checked; Plotly.restyle("hidden", { visible: box.checked }, [index]); });
      label.append(box, " " + name);
      at("layers").append(label);
    }
  }
  /* As it is: after a turn by button, plotly's layout does not follow turns by hand. */
  function camera() { return at("hidden")._fullLayout.scene._scene.getCamera(); }
  function look(eye) {
    Plotly.relayout("hidden", { "scene.camera": { eye, up: { x: 0, y: 1, z: 0 }, center: { x: 0, y: 0, z: 0 } } });
  }
  function turn(angle) {
    const { x, y, z } = camera().eye, c = Math.cos(angle), s = Math.sin(angle);
    look({ x: c * x + s * z, y, z: c * z - s * x });
  }

  // Slices
  function slice() {
    const size = { z: nz, x: nx, y: ny }[state.axis];
    if (state.slice < 0 || state.slice >= size) state.slice = brightest(state.axis);
    at("slice").max = size - 1; at("slice").value = state.slice;
    const text = `${state.axis} = ${along(state.axis, state.slice).toFixed(3)} m`;
    at("slice-value").textContent = text; at("slice").setAttribute("aria-valuetext", text);
    const voxel = (z, x, y) => (array.volume[(z * nx + x) * ny + y] / 255) * header.grid.largest;
    const range = (n) => Array.from({ length: n }, (_, k) => k), k = state.slice;
    const [across, up, value] = { z: ["x", "y", (a, b) => voxel(k, a, b)], y: ["x", "z", (a, b) => voxel(b, a, k)],
      x: ["z", "y", (a, b) => voxel(a, k, b)] }[state.axis];
    const n = { x: nx, y: ny, z: nz };
    Plotly.react("slices", [{ type: "heatmap", x: range(n[across]).map((a) => along(across, a)), y: range(n[up]).map((b) => along(up, b)),
      z: range(n[up]).map((b) => range(n[across]).map((a) => value(a, b))), zmin: 0, zmax: header.grid.largest, colorscale: INFERNO,
      colorbar: { title: { text: "intensity", side: "right" }, thickness: 12 },
      hovertemplate: `${across} %{x:.3f}, ${up} %{y:.3f} m<br>%{z:.3g}<extra></extra>` }],
    { ...base, xaxis: { title: { text: `${across} (m)` }, autorange: across === "x" ? "reversed" : true, constrain: "domain", zeroline: false },
      yaxis: { title: { text: `${up} (m)` }, scaleanchor: "x", constrain: "domain", zeroline: false } }, config);
  }
  function brightest(axis) {
    let best = 0, where = 0;
    array.volume.forEach((v, k) => { if (v > best) { best = v; where = k; } });
    return { z: Math.floor(where / (nx * ny)), x: Math.floor(where / ny) % nx, y: where % ny }[axis];
  }

  // The wall
  const window_ = () => (state.bin < 0 ? [0, T] : [state.bin, state.bin + 1]);
  function wallValue(what, spot, from, to) {
    if (what === "counts") return sum(counts, spot, from, to);
    const k = Number(what.split(":")[1]);
    return what.startsWith("model") ? sum(models[k], spot, from, to) : residual(k, spot, from, to);
  }
  function wallTrace(what, from, to) {
    const { x, y } = header.wall, value = Array.from({ length: S }, (_, s) => wallValue(what, s, from, to));
    const isResidual = what.startsWith("residual");
    const limit = isResidual ? Math.max(sigma ? 3 : 1e-30, quantile(value.map(Math.abs), 0.99))
      : Math.max(1e-30, quantile(Array.from({ length: S }, (_, s) => sum(counts, s, from, to)), 0.995));
    const cell = (v) => y.map((_, j) => x.map((_, i) => { const s = array.wall[j * x.length + i]; return s < 0 ? null : v(s); }));
    return { type: "heatmap", x, y, z: cell((s) => value[s]), customdata: cell((s) => s), zmin: isResidual ? -limit : 0, zmax: limit,
      colorscale: isResidual ? SIGNED : INFERNO, hoverongaps: false,
      colorbar: { title: { text: isResidual ? `residual (${unit})` : "counts", side: "right" }, thickness: 12 },
      hovertemplate: "x %{x:.3f}, y %{y:.3f} m<br>%{z:.4g}<extra></extra>" };
  }
  const wallLayout = { ...base, xaxis: { title: { text: "x (m), as seen from the wall" }, autorange: "reversed", constrain: "domain", zeroline: false },
    yaxis: { title: { text: "y (m)" }, scaleanchor: "x", constrain: "domain", zeroline: false } };
  function wall() {
    const [from, to] = window_();
    const text = state.bin < 0 ? "all bins together"
      : `bin ${state.bin} of ${T}: path ${metres(state.bin).toFixed(3)} m, ${(metres(state.bin) / 0.299792458).toFixed(2)} ns`;
    at("time").value = Math.max(0, state.bin); at("time").setAttribute("aria-valuetext", text);
    at("time").disabled = state.bin < 0; at("all").checked = state.bin < 0; at("time-value").textContent = text;
    const mark = { type: "scatter", mode: "markers", x: [array.places[2 * state.spot]], y: [array.places[2 * state.spot + 1]],
      marker: { symbol: "square-open", size: 16, color: "#00e0ff", line: { width: 3 } }, hoverinfo: "skip", showlegend: false };
    Plotly.react("wall", [wallTrace(state.what, from, to), mark], wallLayout, config);
  }

  // One spot
  function spot() {
    const s = state.spot, bins = Array.from({ length: T }, (_, k) => k), path = bins.map(metres);
    const row = (values) => bins.map((k) => (Number.isFinite(values[s * T + k]) ? values[s * T + k] : null));
    const last = models.length - 1;
    const traces = [{ type: "scatter", mode: "lines", name: "measured", x: path, y: row(counts),
      line: { color: "#555", width: 1.3, shape: "hvh" } }];
    models.forEach((values, k) => traces.push({ type: "scatter", mode: "lines", name: header.models[k], x: path, y: row(values),
      line: { color: COLOURS[k % 4], width: 2 } }));
    models.forEach((_, k) => traces.push({ type: "bar", name: `residual, ${header.models[k]}`, x: path,
      y: bins.map((b) => residual(k, s, b, b + 1)), marker: { color: COLOURS[k % 4] }, yaxis: "y2", showlegend: false,
      visible: k === last, width: header.path[1] }));
    const shapes = state.bin < 0 ? [] : [{ type: "line", x0: metres(state.bin), x1: metres(state.bin), yref: "paper", y0: 0, y1: 1,
      line: { color: "#000", width: 1, dash: "dot" } }];
    Plotly.react("transient", traces, { ...base, plot_bgcolor: "#fff", shapes, bargap: 0,
      ...named("transient", models.length + 1), xaxis: { title: { text: "optical path (m)" }, anchor: "y2" }, yaxis: { title: { text: "counts" }, domain: [models.length ? 0.38 : 0, 1], rangemode: "tozero" },
      yaxis2: { title: { text: unit }, domain: [0, 0.28], zeroline: true } }, config);
    numbers();
  }
  function numbers() {
    const s = state.spot, [from, to] = window_();
    at("spot").value = s;
    const where = `spot ${array.spots[s]} of the capture, x = ${array.places[2 * s].toFixed(3)} m, y = ${array.places[2 * s + 1].toFixed(3)} m; `
      + (state.bin < 0 ? "all bins together" : `bin ${state.bin}`);
    at("where").textContent = where;
    const rows = [["measured", sum(counts, s, from, to), null],
      ...models.map((values, k) => [header.models[k], sum(values, s, from, to), residual(k, s, from, to)])];
    at("numbers").replaceChildren(...rows.map(([name, value, r]) => {
      const line = document.createElement("tr");
      line.dataset.row = name; line.dataset.value = value; line.dataset.residual = r === null ? "" : r;
      for (const [tag, text] of [["th", name], ["td", short(value)], ["td", r === null ? "" : `${signed(r)} ${sigma ? "σ" : ""}`]]) {
        const cell = document.createElement(tag);
        if (tag === "th") cell.scope = "row";
        cell.textContent = text; line.append(cell);
      }
      return line;
    }));
  }
  function choose(s) { state.spot = Math.min(S - 1, Math.max(0, s | 0)); remember(); wall(); spot(); }
  function step(dx, dy) {
    const { x, y } = header.wall, [px, py] = [array.places[2 * state.spot], array.places[2 * state.spot + 1]];
    const near = (values, value) => values.reduce((best, v, k) => (Math.abs(v - value) < Math.abs(values[best] - value) ? k : best), 0);
    const i = near(x, px) + dx, j = near(y, py) + dy;
    const found = i >= 0 && i < x.length && j >= 0 && j < y.length ? array.wall[j * x.length + i] : -1;
    if (found >= 0) choose(found);
  }

  // Before and after
  function change() {
    const axis = at("profile").value, p = facts.profiles.find((one) => one.axis === axis);
    if (p.edges_y) {
      const known = [...p.before.flat(), ...p.after.flat()].filter((v) => v !== null).map(Math.abs);
      const limit = Math.max(3, quantile(known, 0.99)), centre = (e) => e.slice(1).map((v, k) => (v + e[k]) / 2);
      const map = (values, k) => ({ type: "heatmap", x: centre(p.edges), y: centre(p.edges_y), z: centre(p.edges_y).map((_, j) => values.map((r) => r[j])),
        zmin: -limit, zmax: limit, colorscale: SIGNED, xaxis: k ? "x2" : "x", yaxis: k ? "y2" : "y", showscale: k === 1,
        colorbar: { title: { text: "residual (σ)", side: "right" }, thickness: 12 }, hovertemplate: "%{z:.2f} σ<extra></extra>" });
      const narrow = at("change").clientWidth < 600, half = (k) => (k ? [0.54, 1] : [0, 0.46]);
      const x = (k) => ({ title: { text: `${k ? "after" : "before"}, x (m)` }, autorange: "reversed", domain: narrow ? [0, 1] : half(k), constrain: "domain", zeroline: false, anchor: k ? "y2" : "y" });
      return Plotly.react("change", [map(p.before, 0), map(p.after, 1)], { ...base, xaxis: x(0), xaxis2: x(1),
        yaxis: { title: { text: "y (m)" }, scaleanchor: "x", constrain: "domain", zeroline: false, domain: narrow ? half(1) : [0, 1] },
        yaxis2: { scaleanchor: "x2", constrain: "domain", zeroline: false, anchor: "x2", domain: narrow ? half(0) : [0, 1] } }, config);
    }
    const line = (name, values, color, k) => ({ type: "scatter", mode: "lines", name, x: p.edges.slice(0, -1).map((e, i) => (e + p.edges[i + 1]) / 2),
      y: values, line: { color, width: 2 - 0.4 * k, shape: "hvh" } });
    Plotly.react("change", [line("before", p.before, COLOURS[1], 0), line("after", p.after, COLOURS[0], 1)],
      { ...base, plot_bgcolor: "#fff", ...named("change", 1),
        shapes: [{ type: "rect", xref: "paper", x0: 0, x1: 1, y0: -3, y1: 3, fillcolor: "#d9d9d9", opacity: 0.5, line: { width: 0 }, layer: "below" }],
        xaxis: { title: { text: `${at("profile").selectedOptions[0].text} (${p.unit})` } }, yaxis: { title: { text: "residual (σ)" } } }, config);
  }

  // Controls
  const on = (id, event, task) => { if (at(id)) at(id).addEventListener(event, task); };
  scene();
  document.querySelectorAll("[data-look]").forEach((b) => b.addEventListener("click", () => look(JSON.parse(b.dataset.look))));
  document.querySelectorAll("[data-turn]").forEach((b) => b.addEventListener("click", () => turn(Number(b.dataset.turn) * Math.PI / 12)));
  if (header.grid) {
    at("level").value = state.level;
    on("level", "change", (e) => { state.level = Number(e.target.value); remember();
      Plotly.restyle("hidden", { isomin: state.level / 100 }, [0]); });
    at("axis").value = state.axis;
    on("axis", "change", (e) => { state.axis = e.target.value; state.slice = -1; slice(); remember(); });
    on("slice", "input", (e) => { state.slice = Number(e.target.value); slice(); remember(); });
    slice();
  }
  at("time").max = T - 1; at("spot").max = S - 1;
  if (![...at("what").options].some((o) => o.value === state.what)) state.what = "counts";
  at("what").value = state.what;
  on("what", "change", (e) => { state.what = e.target.value; wall(); remember(); });
  on("time", "input", (e) => { state.bin = Number(e.target.value); wall(); spot(); remember(); });
  on("all", "change", (e) => { state.bin = e.target.checked ? -1 : peak(); wall(); spot(); remember(); });
  on("spot", "change", (e) => choose(Number(e.target.value)));
  on("wall", "keydown", (e) => {
    const moves = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };  // +x is to the left
    if (e.key in moves) { e.preventDefault(); step(...moves[e.key]); }
  });
  let playing = null;
  on("play", "click", () => {
    if (playing) { clearInterval(playing); playing = null; }
    else playing = setInterval(() => { state.bin = (state.bin + 1) % T; wall(); }, 120);
    at("play").textContent = playing ? "Stop" : "Play";
    if (!playing) { spot(); remember(); }
  });
  function peak() {
    let best = 0, where = 0;
    for (let k = 0; k < T; k++) { const v = Number.isFinite(counts[state.spot * T + k]) ? counts[state.spot * T + k] : 0; if (v > best) { best = v; where = k; } }
    return where;
  }
  wall(); spot();
  at("wall").on("plotly_click", (e) => { const s = e.points[0].customdata; if (Number.isInteger(s)) choose(s); });
  at("transient").on("plotly_click", (e) => { state.bin = e.points[0].pointIndex; wall(); spot(); remember(); });
  if (facts.profiles) {
    if ([...at("profile").options].some((o) => o.value === state.profile)) at("profile").value = state.profile;
    on("profile", "change", () => { state.profile = at("profile").value; change(); });
    change();
  }

  if (facts.status === "running") {
    at("live").checked = state.live;
    on("live", "change", (e) => { state.live = e.target.checked; remember(); });
    setInterval(() => { if (state.live && !playing) location.reload(); }, 10000);
    const quiet = (Date.now() - Date.parse(facts.at)) / 60000;
    if (quiet > 10) at("message").textContent = `Nothing new for ${quiet.toFixed(0)} minutes: the run may have been stopped.`;
  }
  window.addEventListener("pagehide", leave);
  if (state.focus && at(state.focus)) at(state.focus).focus({ preventScroll: true });
  window.scrollTo(0, state.scroll);
  document.body.dataset.ready = "yes";
})().catch((error) => {
  document.getElementById("message").textContent = `This page could not be drawn: ${error.message}`;
  throw error;
});
