// Panels of lines that sliders change, from a table of numbers for every state of the sliders.
(function explore(el, { sliders, at, panels, words }) {
  const [WIDTH, HEIGHT, LEFT, BELOW, ABOVE] = [440, 240, 40, 24, 26];
  const nearly = (value) => Number(value.toPrecision(3));

  function make(tag, inside, more = {}) {
    const made = Object.assign(document.createElement(tag), more);
    made.append(...inside);
    return made;
  }

  // What is drawn over all states, without dots out of sight.
  function limits(lines, name) {
    const drawn = lines.filter(({ style }) => style !== "o");
    const ends = drawn.flatMap((line) => line[name].flatMap((row) => [Math.min(...row), Math.max(...row)]));
    const [low, high] = [Math.min(...ends), Math.max(...ends)];
    return [low - 0.06 * (high - low), high + 0.06 * (high - low)];
  }

  function ticks([low, high], most) {
    const raw = (high - low) / most;
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = power * [1, 2, 5, 10].find((value) => value * power >= raw);
    const first = Math.ceil(low / step);
    return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, k) => nearly((first + k) * step));
  }

  function draw({ title, lines, square, xs, ys }, state) {
    let scale = [(WIDTH - LEFT - 8) / (xs[1] - xs[0]), (HEIGHT - BELOW - ABOVE) / (ys[1] - ys[0])];
    if (square) scale = scale.fill(Math.min(...scale));
    const x = (value) => LEFT + (value - xs[0]) * scale[0];
    const y = (value) => HEIGHT - BELOW - (value - ys[0]) * scale[1];
    const row = (values) => values[values.length > 1 ? state : 0];
    let inside = `<text x="0" y="14" class="title">${title}</text>`;
    for (const value of ticks(xs, 6)) inside += `<path class="grid" d="M${x(value)} ${y(ys[0])}V${y(ys[1])}"/><text x="${x(value)}" y="${HEIGHT - 8}" text-anchor="middle">${value}</text>`;
    for (const value of ticks(ys, 5)) inside += `<path class="grid" d="M${x(xs[0])} ${y(value)}H${x(xs[1])}"/><text x="${LEFT - 6}" y="${y(value) + 4}" text-anchor="end">${value}</text>`;
    for (const line of lines) {
      const [u, v, band] = [line.x, line.y, line.band].map((values) => values && row(values));
      const points = (by) => v.map((value, k) => `${x(u[k]).toFixed(1)},${y(value + by * (band?.[k] ?? 0)).toFixed(1)}`);
      if (band) inside += `<polygon points="${[...points(1), ...points(-1).reverse()].join(" ")}" fill="${line.color}" opacity="0.2"/>`;
      if (line.style === "o") inside += u.map((value, k) => (v[k] < ys[0] ? "" : `<circle cx="${x(value)}" cy="${y(v[k])}" r="5" fill="${line.color}"/>`)).join("");
      else {
        const dash = { "--": "7 5", ":": "2 4" }[line.style] ?? "none";
        inside += `<polyline points="${points(0).join(" ")}" stroke="${line.color}" stroke-dasharray="${dash}"/>`;
      }
    }
    return inside;
  }

  for (const panel of panels) {
    panel.xs = limits(panel.lines, "x");
    panel.ys = limits(panel.lines, "y");
  }
  const style = make("style", [".affordlib-explorer{max-width:900px;background:#fff;color:#222;font:14px system-ui,sans-serif;padding:4px}.affordlib-explorer svg{flex:1 1 320px;min-width:0;font-size:12px;overflow:hidden}.affordlib-explorer :is(.row,label){display:flex;flex-wrap:wrap;gap:4px 18px;align-items:center}.affordlib-explorer label span{min-width:14em}.affordlib-explorer input{flex:0 1 220px}.affordlib-explorer polyline{fill:none;stroke-width:2.2}.affordlib-explorer .grid{stroke:#ddd}.affordlib-explorer .title{font-weight:600;font-size:13px}.affordlib-explorer i{border-top:3px solid;width:22px}"]);
  const row = make("div", [], { className: "row" });
  const said = make("p", [], {});
  said.setAttribute("role", "status");
  const names = new Map(panels.flatMap(({ lines }) => lines.map((line) => [line.name, line])));
  const legend = make("div", [...names.values()].map(({ name, color, style }) => {
    const sample = make("i", []);
    sample.style.borderTop = `3px ${{ "--": "dashed", ":": "dotted", o: "dotted" }[style] ?? "solid"} ${color}`;
    return make("label", [sample, name]);
  }), { className: "row" });
  const drawings = panels.map(({ title }) => {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
    svg.setAttribute("role", "img");
    svg.setAttribute("aria-label", title);
    row.append(svg);
    return svg;
  });
  const controls = sliders.map(({ name, values }, k) => {
    const [text, input] = [make("span", []), make("input", [])];
    Object.assign(input, { type: "range", min: 0, max: values.length - 1, step: 1, value: at[k] });
    input.dataset.lmSuppressShortcuts = true; // of JupyterLab, which would take the arrow keys
    input.addEventListener("input", () => {
      at[k] = Number(input.value);
      show();
    });
    const update = () => (text.textContent = `${name} = ${values[at[k]].toFixed(2)}`);
    return { update, label: make("label", [text, input]) };
  });
  function show() {
    const state = sliders.reduce((sum, { values }, k) => sum * values.length + at[k], 0);
    controls.forEach(({ update }) => update());
    panels.forEach((panel, k) => (drawings[k].innerHTML = draw(panel, state)));
    said.innerHTML = words[state];
  }
  show();
  el.replaceChildren(style, ...controls.map(({ label }) => label), row, legend, said);
})
