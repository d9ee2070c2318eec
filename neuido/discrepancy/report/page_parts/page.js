(() => {
  "use strict";
  const root = document.documentElement, toggle = document.getElementById("theme");
  const prefers = window.matchMedia("(prefers-color-scheme: dark)");
  const element = document.getElementById("figures");
  const figures = element ? JSON.parse(element.textContent) : [];
  const drawn = [];
  const colour = name => getComputedStyle(root).getPropertyValue("--" + name).trim();
  const filled = value => {
    if (typeof value === "string") return value.startsWith("@") ? colour(value.slice(1)) : value;
    if (Array.isArray(value)) return value.length && typeof value[0] === "number" ? value : value.map(filled);
    if (value && typeof value === "object") return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, filled(v)]));
    return value;
  };
  const narrow = window.matchMedia("(max-width: 600px)").matches; // there the mode bar would lie over the legend
  const config = { responsive: true, displaylogo: false, displayModeBar: narrow ? false : "hover" };
  const axis = () => ({ gridcolor: colour("rule"), zerolinecolor: colour("rule"), linecolor: colour("soft"), automargin: true });
  const flat = layout => {
    const out = { paper_bgcolor: colour("paper"), plot_bgcolor: colour("paper"), font: { color: colour("ink"), size: 12 }, height: 360,
      margin: { l: 60, r: 15, t: 70, b: 50 }, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, ...layout };
    out.title = { x: 0.01, xanchor: "left", y: 0.98, yanchor: "top", font: { size: 14 }, ...layout.title };
    out.xaxis = { ...axis(), ...layout.xaxis };
    out.yaxis = { ...axis(), ...layout.yaxis };
    return out;
  };
  const spatial = (ranges, unit, down) => {
    const one = (title, range) => ({ title: { text: title + " [" + unit + "]" }, range, color: colour("ink"), gridcolor: colour("rule"),
      backgroundcolor: colour("paper"), zerolinecolor: colour("rule") });
    const up = down ? down.map(v => -v) : [0, 1, 0];
    const eye = Math.abs(up[1]) > 0.7 ? { x: 1.3, y: 0.65, z: 1.8 } : { x: 1.5, y: 1.5, z: 0.7 };
    return { paper_bgcolor: colour("paper"), font: { color: colour("ink"), size: 12 }, margin: { l: 0, r: 0, t: 40, b: 0 }, showlegend: true,
      legend: { orientation: "h", x: 0, y: 1, yanchor: "bottom", itemsizing: "constant", bgcolor: "rgba(0,0,0,0)" }, uirevision: "same",
      scene: { aspectmode: "data", uirevision: "same", xaxis: one("x", ranges[0]), yaxis: one("y", ranges[1]), zaxis: one("z", ranges[2]),
        camera: { up: { x: up[0], y: up[1], z: up[2] }, eye } } };
  };

  const curves = (box, figure) => Plotly.react(box, filled(figure.data), flat(filled(figure.layout)), config);

  const names = (pick, recordings) => recordings.forEach((r, i) => {
    const option = document.createElement("option");
    option.value = String(i); option.textContent = r.name; pick.append(option);
  });

  const player = (box, figure) => {
    const pick = box.querySelector("select"), button = box.querySelector("button"), slider = box.querySelector("input"), out = box.querySelector("output");
    const space = box.querySelector(".space");
    let now = null, sets = [], timer = null, busy = false;
    const decode = text => new Int16Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
    const place = (set, k) => {
      const x = [[], [], []];
      for (let n = 0; n < now.points; n++) {
        const o = 3 * (k * now.points + n), seen = set[o] !== -32768;
        for (let a = 0; a < 3; a++) x[a].push(seen ? now.middle[a] + now.scale * set[o + a] : null);
      }
      return x;
    };
    const barbed = (lines, from, to, size) => { // a shaft and two barbs
      const d = [0, 1, 2].map(a => to[a] - from[a]), length = Math.hypot(...d);
      for (let a = 0; a < 3; a++) lines[a].push(from[a], to[a], null);
      if (!(length > 0.004 * size)) return;
      const along = d.map(v => v / length), least = along.map(Math.abs).indexOf(Math.min(...along.map(Math.abs)));
      const other = [0, 1, 2].map(a => (a === least ? 1 : 0) - along[a] * along[least]), norm = Math.hypot(...other);
      const barb = Math.min(0.35 * length, 0.025 * size);
      for (const side of [-0.5, 0.5]) for (let a = 0; a < 3; a++)
        lines[a].push(to[a], to[a] - barb * along[a] + side * barb * other[a] / norm, null);
    };
    const span = () => Math.max(...now.ranges.map(r => r[1] - r[0]));
    const arrows = (from, to) => {
      const lines = [[], [], []], stride = Math.ceil(now.points / 150);
      const at = (x, n) => [x[0][n], x[1][n], x[2][n]];
      for (let n = 0; n < now.points; n += stride) if (from[0][n] !== null && to[0][n] !== null) barbed(lines, at(from, n), at(to, n), span());
      return lines;
    };
    const traces = k => {
      const at = sets.map(s => place(s, k)), roles = ["measured", "before", "after"], called = figure.called;
      const data = at.map((x, i) => ({ type: "scatter3d", mode: "markers", name: called[i], x: x[0], y: x[1], z: x[2], hoverinfo: "name+x+y+z",
        marker: { size: i ? 2.6 : 3.6, color: colour(roles[i]), opacity: i ? 0.9 : 0.65 } }));
      at.slice(1).forEach((_, m) => {
        const i = m + 1;
        const l = arrows(at[i], at[0]);
        data.push({ type: "scatter3d", mode: "lines", name: "residual " + called[i], x: l[0], y: l[1], z: l[2], hoverinfo: "skip",
          line: { color: colour(roles[i]), width: 2 } });
      });
      return data;
    };
    const fixed = () => {
      const data = now.planes.map((p, i) => ({ type: "mesh3d", name: i ? "collider " + (i + 1) : "floor", showlegend: true, opacity: 0.35,
        color: colour("floor"), x: p.corners.map(c => c[0]), y: p.corners.map(c => c[1]), z: p.corners.map(c => c[2]), i: [0, 0], j: [1, 2], k: [2, 3],
        hoverinfo: "name" }));
      if (now.down) {
        const size = span(), lines = [[], [], []];
        const top = [0, 1, 2].map(a => now.down[a] < -0.5 ? now.ranges[a][1] : now.down[a] > 0.5 ? now.ranges[a][0] : now.ranges[a][0] + 0.04 * size);
        barbed(lines, top, top.map((v, a) => v + 0.22 * size * now.down[a]), 3 * size);
        data.push({ type: "scatter3d", mode: "lines", name: "gravity", x: lines[0], y: lines[1], z: lines[2], line: { color: colour("gravity"), width: 6 },
          hoverinfo: "name" });
      }
      return data;
    };
    const show = () => {
      const k = +slider.value;
      out.textContent = now.times[k].toFixed(3) + " s";
      if (busy) return Promise.resolve();
      busy = true;
      const own = traces(k), change = { x: own.map(t => t.x), y: own.map(t => t.y), z: own.map(t => t.z) };
      return Plotly.restyle(space, change, own.map((_, i) => i)).then(() => {
        busy = false;
        box.dataset.shown = String(k);
        if (+slider.value !== k) return show();
      });
    };
    const whole = () => {
      out.textContent = now.times[+slider.value].toFixed(3) + " s";
      const ranges = now.ranges.map((r, a) => now.planes.reduce((s, p) => [Math.min(s[0], ...p.corners.map(c => c[a])),
        Math.max(s[1], ...p.corners.map(c => c[a]))], r));
      return Plotly.react(space, [...traces(+slider.value), ...fixed()], spatial(ranges, figure.unit, now.down), config);
    };
    const load = () => {
      now = figure.recordings[+pick.value];
      slider.max = String(now.frames - 1); slider.value = String(now.first);
      sets = now.sets.map(decode);
      return whole();
    };
    const stop = () => { clearInterval(timer); timer = null; button.textContent = "play"; };
    names(pick, figure.recordings);
    pick.onchange = load; slider.oninput = () => { stop(); show(); };
    button.onclick = () => {
      if (timer) return stop();
      button.textContent = "stop";
      timer = setInterval(() => { if (!busy) { slider.value = String((+slider.value + 1) % now.frames); show(); } }, 80);
    };
    const first = load();
    return [first, whole];
  };

  const map = (box, figure) => {
    const pick = box.querySelector("select"), radios = [...box.querySelectorAll("input")], space = box.querySelector(".space");
    names(pick, figure.recordings);
    radios.forEach(e => { e.parentElement.hidden = figure.shown.length < 2; });
    const show = () => {
      const r = figure.recordings[+pick.value], when = radios.find(e => e.checked).value;
      const layout = spatial([undefined, undefined, undefined], figure.unit, null);
      const marker = { size: 4, color: r[when], colorscale: "Viridis", cmin: 0, cmax: r.top[when] || 1,
        colorbar: { title: { text: "RMS residual<br>" + when + " [" + figure.unit + "]" }, thickness: 12, len: 0.8 } };
      return Plotly.react(space, [{ type: "scatter3d", mode: "markers", name: "points of the body, coloured by what is left " + when, x: r.place[0],
        y: r.place[1], z: r.place[2], marker }], layout, config);
    };
    pick.onchange = show; radios.forEach(e => { e.onchange = show; });
    return [show(), show];
  };

  const draw = box => {
    box.dataset.begun = "yes";
    const figure = figures[+box.dataset.figure];
    let made;
    if (figure.form === "player") made = player(box, figure);
    else if (figure.form === "map") made = map(box, figure);
    else made = [curves(box, figure), () => curves(box, figure)];
    drawn.push(made[1]);
    made[0].then(() => { box.dataset.drawn = "yes"; });
  };
  const paint = dark => {
    root.dataset.theme = dark ? "dark" : "light";
    toggle.textContent = dark ? "light" : "dark";
    drawn.forEach(again => again());
  };
  paint(prefers.matches);
  prefers.addEventListener("change", e => paint(e.matches));
  toggle.onclick = () => paint(root.dataset.theme !== "dark");
  const seen = new IntersectionObserver(entries => entries.forEach(e => {
    if (e.isIntersecting) { seen.unobserve(e.target); draw(e.target); }
  }), { rootMargin: "400px" });
  const boxes = [...document.querySelectorAll("[data-figure]")];
  boxes.forEach(box => seen.observe(box));
  window.addEventListener("beforeprint", () => boxes.forEach(box => { if (!box.dataset.begun) { seen.unobserve(box); draw(box); } }));
})();
