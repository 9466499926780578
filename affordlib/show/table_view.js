// The table from above, in millimetres: draws what `scene` says, and asks for a goal.
// A click, a drag or an arrow key sets `asked` = [x_m, y_m, number]; the number tells equal goals
// apart. The star follows the hand at once, the plan when Python answers.

const SVG = "http://www.w3.org/2000/svg";
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const STEP_M = 0.01;
const FINE_STEP_M = 0.001;

const mm = ([x, y]) => [1000 * x, -1000 * y];
const points = (path) => path.map((p) => mm(p).map((v) => v.toFixed(1)).join(",")).join(" ");

function add(parent, tag, attributes, text) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text !== undefined) element.textContent = text;
  parent.append(element);
  return element;
}

function ring([x, y], radius) {
  const r = 1000 * radius;
  return `M ${x - r} ${y} a ${r} ${r} 0 1 0 ${2 * r} 0 a ${r} ${r} 0 1 0 ${-2 * r} 0 z`;
}

function star([x, y], radius) {
  const corner = (k) => {
    const r = k % 2 ? 0.4 * radius : radius;
    return [x + r * Math.sin((k * Math.PI) / 5), y - r * Math.cos((k * Math.PI) / 5)].join(",");
  };
  return [...Array(10).keys()].map(corner).join(" ");
}

function placed(outline, [x, y, yaw]) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return outline.map(([u, v]) => [x + c * u - s * v, y + s * u + c * v]);
}

function drawGround(svg, { table, reach, half_width }) {
  const ground = add(svg, "g", { class: "ground" });
  const [x0, x1, y0, y1] = table;
  const [left, top] = mm([x0, y1]);
  const area = { x: left, y: top, width: 1000 * (x1 - x0), height: 1000 * (y1 - y0) };
  add(ground, "rect", { ...area, class: "table" });
  const centre = mm(reach.centre);
  const both = ring(centre, reach.outer) + ring(centre, reach.inner);
  add(ground, "path", { d: both, class: "reach", "fill-rule": "evenodd" });
  const edge = 1000 * half_width;
  for (let cm = -100; cm <= 100; cm += 10) {
    const at = 10 * cm;
    if (Math.abs(at) >= edge) continue;
    add(ground, "line", { x1: at, x2: at, y1: -edge, y2: edge, class: "grid" });
    add(ground, "line", { x1: -edge, x2: edge, y1: at, y2: at, class: "grid" });
    add(ground, "text", { x: at, y: edge - 8, "text-anchor": "middle", class: "tick" }, cm);
    if (cm) add(ground, "text", { x: -edge + 8, y: -at + 6, class: "tick" }, cm);
  }
  add(ground, "text", { x: edge - 8, y: edge - 8, "text-anchor": "end", class: "tick" }, "cm");
}

function drawArrow(parent, start, direction) {
  const [x, y] = mm(start);
  const [u, v] = [Math.cos(direction), -Math.sin(direction)];
  const [tipX, tipY] = [x - 38 * u, y - 38 * v];
  add(parent, "line", { x1: x - 80 * u, y1: y - 80 * v, x2: tipX, y2: tipY, class: "push" });
  const head = [
    [tipX + 6 * u, tipY + 6 * v],
    [tipX - 8 * u - 7 * v, tipY - 8 * v + 7 * u],
    [tipX - 8 * u + 7 * v, tipY - 8 * v - 7 * u],
  ];
  add(parent, "polygon", { points: head.join(" "), class: "push-head" });
}

function drawPlan(svg, steps, outline) {
  const plan = add(svg, "g", { class: "plan" });
  const moves = steps.filter((step) => step.direction !== null).length;
  const poses = steps.length - moves; // which turn and lift what is already there
  let stack = null; // of labels beside the end, away from where the object comes from
  for (const [k, step] of steps.entries()) {
    const [x, y] = mm(step.end);
    if (k >= moves) {
      stack ??= { x: x + 28, y: y - 18, "text-anchor": "start" };
      stack.y += 24;
      add(plan, "text", { ...stack, class: "step" }, step.label);
      continue;
    }
    if (step.disc) add(plan, "circle", { cx: x, cy: y, r: 1000 * step.disc, class: "sigma" });
    drawArrow(plan, step.start, step.direction);
    add(plan, "polyline", { points: points(step.path), class: "prediction" });
    add(plan, "circle", { cx: x, cy: y, r: 3, class: "prediction-end" });
    // Beside the end, where neither the next push comes from nor its object goes.
    const last = k === moves - 1;
    const ahead = (last ? step : steps[k + 1]).direction;
    const [right, up] = [Math.cos(ahead) >= 0, Math.sin(ahead) > (k % 2 ? 0.5 : -0.5)];
    const at = {
      x: x + (right ? 1 : -1) * (last ? 28 : 12),
      y: y + (last ? 6 - (Math.sin(ahead) > 0 ? 24 * poses : 0) : up ? 26 : -14),
      "text-anchor": right ? "start" : "end",
    };
    add(plan, "text", { ...at, class: "step" }, step.label);
    if (last) stack = at;
  }
  const end = steps[steps.length - 1];
  const foreseen = end ? points(placed(outline, [...end.end, end.yaw])) : "";
  if (end) add(plan, "polygon", { points: foreseen, class: "foreseen" });
}

function render({ model, el }) {
  const svg = document.createElementNS(SVG, "svg");
  // JupyterLab's own shortcuts (arrow keys move between cells) stay off while the table has focus.
  el.dataset.lmSuppressShortcuts = "true";
  el.classList.add("affordlib-table");
  svg.setAttribute("tabindex", "0");
  svg.setAttribute("role", "application");
  svg.setAttribute(
    "aria-label",
    "Table from above. Arrow keys move the goal by 1 cm, with Shift by 1 mm; Enter runs the plan, Escape stops it.",
  );
  el.append(svg);

  let goal = null; // where the hand has put it, until Python has answered
  let number = 0;
  let object = null;
  let trail = null; // of the film that is being played
  let film = null;
  let timer = null;

  const scene = () => model.get("scene");

  function moveObject(pose) {
    object?.setAttribute("points", points(placed(scene().object.outline, pose)));
  }

  function drawGoal(layer) {
    const [x, y] = mm(goal ?? scene().goal.xy);
    layer.replaceChildren();
    const { outline } = scene().object;
    const { yaw } = scene().goal;
    if (yaw !== null) {
      const wanted = placed(outline, [...(goal ?? scene().goal.xy), yaw]);
      add(layer, "polygon", { points: points(wanted), class: "tolerance wanted" });
    }
    add(layer, "circle", { cx: x, cy: y, r: 1000 * scene().goal.tolerance, class: "tolerance" });
    add(layer, "polygon", { points: star([x, y], 17), class: "goal" });
  }

  function draw() {
    const now = scene();
    if (!now.goal) return;
    const edge = 1000 * now.half_width;
    svg.setAttribute("viewBox", `${-edge} ${-edge} ${2 * edge} ${2 * edge}`);
    if (now.answered >= number) goal = null;
    if (!now.running) film = null;
    svg.replaceChildren();
    drawGround(svg, now);
    object = add(svg, "polygon", { class: "object" });
    drawPlan(svg, now.steps, now.object.outline);
    for (const path of now.truth) add(svg, "polyline", { points: points(path), class: "truth" });
    trail = add(svg, "polyline", { class: "trail" });
    drawGoal(add(svg, "g", { class: "goal-layer" }));
    if (now.planning) add(svg, "text", { x: 0, y: 40 - edge, class: "busy" }, "planning …");
    if (film) show(performance.now());
    else moveObject(now.object.pose);
    svg.dataset.answered = now.answered;
    svg.dataset.draft = now.draft;
    svg.dataset.planning = now.planning;
    svg.setAttribute("aria-busy", now.planning);
  }

  function show(time) {
    const { poses, seconds, began } = film;
    const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    const share = still || !seconds ? 1 : Math.max(0, Math.min(1, (time - began) / (1000 * seconds)));
    const last = Math.round(share * (poses.length - 1));
    moveObject(poses[last]);
    trail.setAttribute("points", points(poses.slice(0, last + 1)));
    return share < 1;
  }

  function play() {
    const { poses, seconds } = model.get("film");
    if (!poses?.length || !trail) return;
    film = { poses, seconds, began: performance.now() };
    cancelAnimationFrame(timer);
    const frame = (time) => {
      if (film && show(time)) timer = requestAnimationFrame(frame);
    };
    timer = requestAnimationFrame(frame);
  }

  function ask(xy) {
    const limit = scene().limit;
    goal = xy.map((v) => Math.max(-limit, Math.min(limit, Math.round(1000 * v) / 1000)));
    number = Math.max(number, model.get("asked")[2]) + 1;
    svg.dataset.asked = number;
    const layer = svg.querySelector(".goal-layer");
    if (layer) drawGoal(layer);
    model.set("asked", [...goal, number]);
    model.save_changes(); // ipywidgets sends the next one when this one has been dealt with
  }

  function pointed(event) {
    const at = new DOMPoint(event.clientX, event.clientY);
    const { x, y } = at.matrixTransform(svg.getScreenCTM().inverse());
    // A browser may tell of a move where nothing has moved, after a change of layout for one.
    const old = goal ?? scene().goal.xy;
    const moved = Math.abs(x / 1000 - old[0]) + Math.abs(-y / 1000 - old[1]) > FINE_STEP_M;
    if (moved || event.type === "pointerdown") ask([x / 1000, -y / 1000]);
  }

  svg.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    svg.setPointerCapture(event.pointerId);
    pointed(event); // before the table, when it has the focus, may be scrolled into view
    svg.focus({ preventScroll: true });
    event.preventDefault();
  });
  svg.addEventListener("pointermove", (event) => {
    if (svg.hasPointerCapture(event.pointerId)) pointed(event);
  });
  svg.addEventListener("keydown", (event) => {
    const way = KEYS[event.key];
    if (way) {
      const step = event.shiftKey ? FINE_STEP_M : STEP_M;
      const [x, y] = goal ?? scene().goal.xy;
      ask([x + step * way[0], y + step * way[1]]);
    } else if (event.key === "Enter" || event.key === "Escape") {
      model.send({ press: event.key === "Enter" ? "run" : "stop" });
    } else {
      return;
    }
    event.preventDefault();
    event.stopPropagation();
  });

  model.on("change:scene", draw);
  model.on("change:film", play);
  draw();
  return () => {
    cancelAnimationFrame(timer);
    model.off("change:scene", draw);
    model.off("change:film", play);
  };
}

export default { render };
