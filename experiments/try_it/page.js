const data = JSON.parse(document.getElementById("data").textContent);
const one = (selector) => document.querySelector(selector);
const form = one(".switches");
const FIRST = { pose: [0, 0, 0.3], goal: [0.13, 0.085] };
const objects = data.objects.map((object) => ({ ...object, seconds: data.seconds }));
const undone = [];
let [object, pose, goal, obstacles] = [objects[0], FIRST.pose, FIRST.goal, []];
let [chain, shown, playing] = [[], null, 0];
let film = null; // {rows, every (seconds), recorded}: what is played

const view = new Table(one(".table"), {
  goal: (xy, final) => change(() => (goal = xy), final),
  pose: (to, final) => change(() => (pose = to), final),
  obstacles: (all, final) => change(() => (obstacles = all), final),
  press: (key) => (key === "Enter" ? play() : end()),
});

// A change by hand: planned for immediately, and remembered when the hand lets go.
let dragging = false;
function change(act, final) {
  if (!dragging) undone.push(structuredClone({ pose, goal, obstacles }));
  dragging = !final;
  act();
  replan();
}

function mapOf(item) {
  if (!(item.map instanceof EffectMap)) {
    item.map = new EffectMap(item.map);
    item.reachable = reachability(data.reach, item.map.primitive);
  }
  return item;
}

function problem() {
  const { most, partial, risk } = form.elements;
  return {
    object: mapOf(object), pose, goal, tolerance: 0.01, most: Number(most.value), partial: partial.checked,
    risk: Number(risk.value), obstacles,
    reachable: object.reachable, table: data.table, previous: chain, quick: Boolean(view.held),
  };
}

function replan() {
  stop();
  const query = problem();
  shown = plan(query);
  chain = shown.chain;
  const { sigma, swept, compare } = form.elements;
  const full = query.partial && (compare.checked || !view.held) ? plan({ ...query, partial: false, previous: null }) : null;
  view.set({
    object, pose, goal: { xy: goal, tolerance: 0.01 }, steps: shown.steps, obstacles,
    other: compare.checked && full ? full.steps : [],
    ring: data.ring, sigma: sigma.checked, swept: swept.checked, note: "prediction",
  });
  film = { rows: predicted(0.02), every: 0.02, recorded: false };
  tell(full);
  offer();
  one(".play").disabled = one(".scrub").disabled = !shown.steps.length;
}

const APPROACH = 0.45; // seconds that the hand takes to come down, and to leave

// The execution as it is predicted: a motion for `replay`, with a row every so many seconds.
function predicted(every) {
  const { map, hand, seconds } = object;
  return shown.steps.flatMap(({ direction, stop, from, path }) => {
    const [begins, first] = [Math.min(0.9 * map.from, stop), Math.min(map.from, stop)];
    const acts = (stop - begins) * seconds;
    const lasts = acts + 2 * APPROACH;
    const rows = Math.ceil(lasts / every);
    return Array.from({ length: rows + 1 }, (_, k) => {
      const time = (k / rows) * lasts;
      const phase = share(begins, stop, between(0, (time - APPROACH) / acts, 1));
      const moved = between(0, (phase - first) / (stop - first || 1), 1);
      const near = between(0, Math.min(time, lasts - time) / APPROACH, 1);
      const [along, gap] = handAt(hand, phase);
      const tool = [...beyond(from, direction, along), share(HIGH, LOW, near), direction, gap];
      return [...blend(path, moved * (path.length - 1)), 0, ...tool];
    });
  });
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
  if (full && (form.elements.compare.checked || full.distance > distance + 0.001)) text += `Full pushes only would miss by ${(1000 * full.distance).toFixed(0)} mm. `;
  if (!object.known) text += "The network was trained on no such object: errors may be far larger than predicted.";
  one(".words").textContent = text;
}

// The recorded goal that is nearest, of those whose way was recorded beside no obstacle.
function nearestRun() {
  const there = object.runs.map((run) => ({ run, xy: placed([run.goal], pose)[0] }));
  return there.reduce((best, one) => (apart(one.xy, goal) < apart(best.xy, goal) ? one : best));
}

function offer(text) {
  const { xy } = nearestRun();
  one(".recorded span").textContent = text ??
    `Recorded for the nearest of ${object.runs.length} goals, ${(100 * apart(xy, goal)).toFixed(1)} cm from yours.`;
}

// Rows of a recorded motion, moved to where the object stands.
function motionOf({ motion: text }) {
  const all = Array.from(decoded(text, Int16Array), (value) => value / 10000);
  return Array.from({ length: all.length / 9 }, (_, k) => {
    const [x, y, yaw, lift, u, v, z, turn, gap] = all.slice(9 * k, 9 * k + 9);
    const [[x1, y1], [u1, v1]] = placed([[x, y], [u, v]], pose);
    return [x1, y1, yaw + pose[2], lift, u1, v1, z, turn + pose[2], gap];
  });
}

function robot() {
  const { run, xy } = nearestRun();
  const from = pose;
  stop();
  const steps = stepsOf({ object: mapOf(object), pose: from }, run.chain.map((v, k) => (k % 2 ? v : v + from[2])));
  view.set({ goal: { xy, tolerance: 0.01 }, steps, other: [], obstacles: [], note: "recorded in the simulation" });
  offer(`The robot ended ${(1000 * run.distance).toFixed(1)} mm from this recorded goal (predicted: ${
    (1000 * apart(steps.at(-1)?.end ?? from, xy)).toFixed(1)} mm).`);
  film = { rows: motionOf(run), every: data.every, recorded: true };
  play();
}

function stop() {
  cancelAnimationFrame(playing);
  playing = 0;
  view.state.live = null;
  view.state.trail = [];
  one(".play").textContent = "▶";
  one(".scrub").value = 0;
}

function end() {
  stop();
  if (film.recorded) replan();
  else view.draw();
}

const seconds = () => (film.rows.length - 1) * film.every;

function at(time) {
  one(".scrub").value = time / seconds();
  view.replay(film.rows, time / film.every, film.recorded);
}

function play() {
  if (playing || (!film.recorded && !shown.steps.length)) return end();
  one(".play").textContent = "■";
  let [last, time] = [performance.now(), 0];
  if (still()) return at(seconds());
  const frame = (now) => {
    time += ((now - last) / 1000) * Number(one(".speed").value);
    last = now;
    at(Math.min(time, seconds()));
    if (time < seconds()) playing = requestAnimationFrame(frame);
    else {
      playing = 0;
      one(".play").textContent = "▶";
    }
  };
  playing = requestAnimationFrame(frame);
}

one(".play").addEventListener("click", play);
one("[name=robot]").addEventListener("click", robot);
one(".scrub").addEventListener("input", (event) => {
  cancelAnimationFrame(playing);
  playing = 0;
  at(Number(event.target.value) * seconds());
});
form.addEventListener("input", replan);
form.addEventListener("submit", (event) => event.preventDefault());
form.elements.undo.addEventListener("click", () => {
  if (undone.length) ({ pose, goal, obstacles } = undone.pop());
  replan();
});
form.addEventListener("reset", () => setTimeout(() => {
  [pose, goal, obstacles, chain] = [FIRST.pose, FIRST.goal, [], []];
  replan();
}));

objects.forEach((item, k) => {
  const choice = document.createElement("button");
  const points = item.outline.map(([x, y]) => [22 + 300 * x, 18 - 300 * y].join()).join(" ");
  choice.type = "button";
  choice.setAttribute("role", "radio");
  choice.innerHTML = `<svg viewBox="0 0 44 36" aria-hidden="true"><polygon points="${points}"/></svg>${escaped(item.name)}` +
    `<small class="${item.known ? "" : "new"}">${item.known ? "known kind" : "never seen"}</small>`;
  choice.addEventListener("click", () => {
    [object, chain] = [item, []];
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
if (window !== parent) {
  // In a page of the book, which makes room for all of it.
  document.documentElement.classList.add("framed");
  new ResizeObserver(() => parent.postMessage(one("main").offsetHeight, "*")).observe(one("main"));
}
