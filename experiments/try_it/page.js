const data = JSON.parse(document.getElementById("data").textContent);
const one = (selector) => document.querySelector(selector);
const form = one(".switches");
const OBSTACLES = { discs: [[0.03, 0.14, 0.02, 0.1]], polygons: [[[[0.1, -0.02], [0.15, -0.02], [0.15, 0.02], [0.1, 0.02]], 0.06]] };
const FIRST = { pose: [0, 0, 0.3], goal: [0.13, 0.085] };
const objects = data.objects.map((object) => ({ ...object, seconds: data.seconds }));
const undone = [];
let [object, pose, goal, obstacles] = [objects[0], FIRST.pose, FIRST.goal, structuredClone(OBSTACLES)];
let [chain, shown, playing] = [[], null, 0];

const view = new Table(one(".table"), {
  goal: (xy, final) => change(() => (goal = xy), final),
  pose: (to, final) => change(() => (pose = to), final),
  obstacle: (kind, k, [x, y], final) => change(() => {
    if (kind === "disc") obstacles.discs[k] = [x, y, ...obstacles.discs[k].slice(2)];
    else {
      const [corners, height] = obstacles.polygons[k];
      const middle = [0, 1].map((axis) => corners.reduce((sum, at) => sum + at[axis], 0) / corners.length);
      obstacles.polygons[k] = [corners.map(([u, v]) => [u + x - middle[0], v + y - middle[1]]), height];
    }
  }, final),
  press: (key) => (key === "Enter" ? play() : end()),
});

// A change by hand: planned for at once, and remembered when the hand lets go.
let dragging = false;
function change(act, final) {
  if (!dragging) undone.push(structuredClone({ pose, goal, obstacles }));
  dragging = !final;
  act();
  replan();
}

function mapOf(thing) {
  if (!(thing.map instanceof EffectMap)) {
    thing.map = new EffectMap(thing.map);
    thing.reachable = reachability(data.reach, thing.map.primitive);
  }
  return thing;
}

function problem() {
  const { most, partial, risk } = form.elements;
  return {
    object: mapOf(object), pose, goal, tolerance: 0.01, most: Number(most.value), partial: partial.checked,
    risk: Number(risk.value), obstacles: form.elements.obstacles.checked ? obstacles : {},
    reachable: object.reachable, table: data.table, previous: chain,
  };
}

function replan() {
  stop();
  const asked = problem();
  shown = plan(asked);
  chain = shown.chain;
  const full = !view.held && asked.partial ? plan({ ...asked, partial: false, previous: null }) : null;
  const { sigma, swept } = form.elements;
  view.set({
    object, pose, goal: { xy: goal, tolerance: 0.01 }, steps: shown.steps, obstacles: asked.obstacles,
    ring: data.ring, sigma: sigma.checked, swept: swept.checked, movable: true, note: "prediction",
  });
  tell(full);
  one(".play").disabled = one(".scrub").disabled = !shown.steps.length;
}

function tell(full) {
  const verb = object.map.primitive;
  const { steps, distance, reached } = shown;
  const many = ["No", "One", "Two", "Three"][steps.length];
  const stops = steps.map(({ stop }) => `${Math.round(100 * stop)} %`).join(", ");
  let text = steps.length
    ? `${many} ${verb}${steps.length > 1 ? "es".slice(verb === "push" ? 0 : 1) : ""}, stopped at ${stops}. `
    : "No action brings it nearer. ";
  if (steps.length) text += `Predicted to end ${(1000 * distance).toFixed(1)} mm from the goal, σ ${(1000 * steps.at(-1).std).toFixed(1)} mm. `;
  if (!reached && steps.length) text += "The star is farther than these actions reach. ";
  if (full && full.distance > distance + 0.001) text += `Without stopping early it would miss by ${(1000 * full.distance).toFixed(0)} mm. `;
  if (!object.known) text += "The network was trained on no such object: errors may be far larger than predicted.";
  one(".words").textContent = text;
}

function stop() {
  cancelAnimationFrame(playing);
  playing = 0;
  view.clock = null;
  one(".play").textContent = "▶";
  one(".scrub").value = 0;
}

function end() {
  stop();
  view.draw();
}

function at(time) {
  view.clock = time;
  one(".scrub").value = time / view.seconds;
  view.draw();
}

function play() {
  if (playing || !shown.steps.length) return end();
  one(".play").textContent = "■";
  let [last, time] = [performance.now(), 0];
  if (still()) return at(view.seconds);
  const frame = (now) => {
    time += ((now - last) / 1000) * Number(one(".speed").value);
    last = now;
    at(Math.min(time, view.seconds));
    if (time < view.seconds) playing = requestAnimationFrame(frame);
    else {
      playing = 0;
      one(".play").textContent = "▶";
    }
  };
  playing = requestAnimationFrame(frame);
}

one(".play").addEventListener("click", play);
one(".scrub").addEventListener("input", (event) => {
  cancelAnimationFrame(playing);
  playing = 0;
  at(Number(event.target.value) * view.seconds);
});
form.addEventListener("input", replan);
form.addEventListener("submit", (event) => event.preventDefault());
form.elements.undo.addEventListener("click", () => {
  if (undone.length) ({ pose, goal, obstacles } = undone.pop());
  replan();
});
form.addEventListener("reset", () => setTimeout(() => {
  [pose, goal, obstacles, chain] = [FIRST.pose, FIRST.goal, structuredClone(OBSTACLES), []];
  replan();
}));

objects.forEach((thing, k) => {
  const choice = document.createElement("button");
  const points = thing.outline.map(([x, y]) => [22 + 380 * x, 18 - 380 * y].join()).join(" ");
  choice.type = "button";
  choice.setAttribute("role", "radio");
  choice.innerHTML = `<svg viewBox="0 0 44 36" aria-hidden="true"><polygon points="${points}"/></svg>${escaped(thing.name)}` +
    `<small class="${thing.known ? "" : "new"}">${thing.known ? "known kind" : "never seen"}</small>`;
  choice.addEventListener("click", () => {
    [object, chain] = [thing, []];
    choose();
  });
  choice.addEventListener("keydown", (event) => {
    const way = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!way) return;
    event.preventDefault();
    const next = one(".things").children[(k + way + objects.length) % objects.length];
    next.focus();
    next.click();
  });
  one(".things").append(choice);
});

function choose() {
  [...one(".things").children].forEach((choice, k) => {
    choice.setAttribute("aria-checked", objects[k] === object);
    choice.tabIndex = objects[k] === object ? 0 : -1;
  });
  replan();
}
choose();
