// The table from above: plans over an object's effect map, draws what is there and what is planned,
// and lets pointer, touch and keys move goal, object and obstacles. With a kernel it is a widget of
// Python's, without one a part of a page. Metres and radians; x to the right, y upwards.

const TURN = 2 * Math.PI;
const FINE_DIRECTIONS = 180;
const FINE_PHASES = 31;
const STARTS = 128; // chains from which a search begins
const REFINED = 16; // the best of them, corrected until they end at the goal
const CORRECTIONS = 6;
const NEAR_ENOUGH = 0.0003; // [m]
const SPREAD = 1.2; // of the first directions around the goal's [rad]
const ACTION_COST = 0.0005; // [m]
const LOYALTY = 0.001; // advantage of the plan that is shown, so that it does not jump [m]
const PATH_SAMPLES = 41;
const NEARBY = 0.02; // difference of directions for the slope of an effect [rad]
const POSES = 7; // for which the way is checked
const FAR = 0.01; // gaps above this are not distinguished [m]
const ENLARGED = 20; // radius of the drawn disc, in σ
const EXTENT = 0.4; // half width of the largest view [m]
const LIMIT = 0.35; // largest coordinate of a goal [m]
const GROWS = 1500; // time in which a search is drawn [ms]

const between = (low, value, high) => Math.max(low, Math.min(high, value));
const share = (a, b, t) => a + (b - a) * t;
const bearing = ([x, y], [u, v]) => Math.atan2(v - y, u - x);
const plus = ([x, y], [u, v]) => [x + u, y + v];
const minus = ([x, y], [u, v]) => [x - u, y - v];
const apart = ([x, y], [u, v]) => Math.hypot(x - u, y - v);
const farthest = (corners, from = [0, 0]) => Math.max(...corners.map((at) => apart(at, from)));
const rotated = ([x, y], angle) => {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return [c * x - s * y, s * x + c * y];
};
const beyond = (at, direction, far) => plus(at, rotated([far, 0], direction));
const placed = (outline, pose) => outline.map((corner) => plus(pose, rotated(corner, pose[2])));

// The row at a place between two rows.
function blend(rows, place) {
  const k = Math.floor(place);
  const next = rows[Math.min(k + 1, rows.length - 1)];
  return rows[k].map((value, axis) => share(value, next[axis], place - k));
}

const decoded = (text, Type) =>
  new Type(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);

// Effects of an action, ahead, to the left, turn, and their σ, over direction and phase: the cubic
// B-spline of Python's EffectMap, from its numbers.
export class EffectMap {
  constructor({ primitive, shape: [rows, columns], from, scale, coefficients }) {
    const whole = decoded(coefficients, Int16Array);
    const numbers = Float64Array.from(whole, (value, i) => value * scale[i % 6]);
    Object.assign(this, { primitive, rows, columns, from, numbers });
    this.actions = Array.from({ length: FINE_DIRECTIONS * FINE_PHASES }, (_, i) => {
      const phase = share(from, 1, (i % FINE_PHASES) / (FINE_PHASES - 1));
      return [(Math.floor(i / FINE_PHASES) * TURN) / FINE_DIRECTIONS, phase];
    });
    const ends = this.actions.map((action) => rotated(this.at(...action), action[0]));
    this.ends = Float64Array.from(ends.flat());
    this.reach = farthest(ends);
  }

  at(direction, phase) {
    const { rows, columns, from, numbers } = this;
    const x = ((((direction % TURN) + TURN) % TURN) * rows) / TURN;
    const y = ((between(from, phase, 1) - from) * (columns - 1)) / (1 - from);
    const [i, j] = [Math.min(Math.floor(x), rows - 1), Math.min(Math.floor(y), columns - 1)];
    const [weights, others] = [splines(x - i), splines(y - j)];
    const effect = [0, 0, 0, 0, 0, 0];
    for (let a = 0; a < 4; a++) {
      const row = (i + a - 1 + rows) % rows;
      for (let b = 0; b < 4; b++) {
        const column = columns - 1 - Math.abs(columns - 1 - Math.abs(j + b - 1)); // mirrored
        const [weight, first] = [weights[a] * others[b], 6 * (row * columns + column)];
        for (let k = 0; k < 6; k++) effect[k] += weight * numbers[first + k];
      }
    }
    for (let k = 3; k < 6; k++) effect[k] = Math.max(effect[k], 1e-6);
    return effect;
  }

  // The action that ends nearest to a place beside the object.
  nearest(x, y, partial) {
    const [first, step] = partial ? [0, 1] : [FINE_PHASES - 1, FINE_PHASES];
    let [best, least] = [first, Infinity];
    for (let i = first; i < this.actions.length; i += step) {
      const far = (this.ends[2 * i] - x) ** 2 + (this.ends[2 * i + 1] - y) ** 2;
      if (far < least) [best, least] = [i, far];
    }
    return this.actions[best];
  }
}

const splines = (u) => [
  (1 - u) ** 3 / 6,
  (3 * u ** 3 - 6 * u ** 2 + 4) / 6,
  (-3 * u ** 3 + 3 * u ** 2 + 3 * u + 1) / 6,
  u ** 3 / 6,
];

// Actions of a chain [direction, phase, …] on an object at a pose: where each begins and ends,
// and, where wanted, σ of the position: the action's own, and that of turns before it.
export function rollOut({ map, yaw }, pose, chain, uncertain = false) {
  let [from, variance, turnVariance, cx, cy] = [pose, 0, 0, 0, 0];
  const steps = [];
  for (let k = 0; k < chain.length; k += 2) {
    const [direction, stop] = [chain[k], chain[k + 1]];
    const ahead = direction - from[2] + yaw; // in the map's image
    const effect = map.at(ahead, stop);
    if (uncertain) {
      const [before, after] = [map.at(ahead - NEARBY, stop), map.at(ahead + NEARBY, stop)];
      const [u, v, w] = [0, 1, 2].map((i) => (before[i] - after[i]) / (2 * NEARBY));
      const [[sx, sy], kept] = [rotated([u, v], direction), 1 + w];
      variance += 2 * (cx * sx + cy * sy) + turnVariance * (sx * sx + sy * sy);
      variance += effect[3] ** 2 + effect[4] ** 2;
      [cx, cy] = [kept * (cx + turnVariance * sx), kept * (cy + turnVariance * sy)];
      turnVariance = kept ** 2 * turnVariance + effect[5] ** 2;
    }
    const end = [...plus(from, rotated(effect, direction)), from[2] + effect[2]];
    steps.push({ direction, stop, from, end, std: Math.sqrt(variance) });
    from = end;
  }
  return steps;
}

// The same, with paths.
export const stepsOf = ({ object, pose }, chain) =>
  rollOut(object, pose, chain, true).map((step) => ({ ...step, path: pathOf(object, step) }));

// Poses of the object along an action, from its pose before it.
export function pathOf(object, { from, direction, stop }, samples = PATH_SAMPLES) {
  const first = Math.min(object.map.from, stop);
  return Array.from({ length: samples }, (_, k) =>
    rollOut(object, from, [direction, share(first, stop, k / (samples - 1))])[0].end);
}

// Where the hand is at a phase, ahead of the object's place before the action, and its opening.
export const handAt = ({ path }, phase) => blend(path, between(0, phase, 1) * (path.length - 1));

// Whether the arm can act at (x, y) in a direction: Python's network, from its numbers.
export function reachability({ layers, primitives, threshold }, primitive) {
  if (!primitives.includes(primitive)) return () => true;
  const read = layers.map(([inputs, text]) => [inputs, decoded(text, Float32Array)]);
  const hot = primitives.map((one) => Number(one === primitive));
  return (x, y, direction) => {
    let values = [2 * x, 2 * y, Math.cos(direction), Math.sin(direction), ...hot];
    for (const [inputs, weights] of read) {
      const outputs = weights.length / (inputs + 1);
      const next = Array.from(weights.subarray(inputs * outputs)); // the biases
      for (let o = 0; o < outputs; o++) {
        for (let i = 0; i < inputs; i++) next[o] += weights[o * inputs + i] * values[i];
      }
      values = outputs > 1 ? next.map(Math.tanh) : next;
    }
    return 1 / (1 + Math.exp(-values[0])) >= threshold;
  };
}

const SIDES = 16;
const RING = Array.from({ length: SIDES }, (_, k) =>
  beyond([0, 0], (k * TURN) / SIDES, 1 / Math.cos(Math.PI / SIDES)));

// Corners of an obstacle {corners, radius, height}, a disc as the polygon around it.
const cornersOf = ({ corners: [middle], corners, radius }) =>
  radius ? RING.map(([x, y]) => [middle[0] + radius * x, middle[1] + radius * y]) : corners;

const box = (w, h) => [[-w, -h], [w, -h], [w, h], [-w, h]];

const middleOf = (corners) =>
  [0, 1].map((axis) => corners.reduce((sum, at) => sum + at[axis], 0) / corners.length);

const normals = (corners) => corners.map((corner, k) => {
  const [x, y] = minus(corners[(k + 1) % corners.length], corner);
  const long = Math.hypot(x, y) || 1;
  return [y / long, -x / long];
});

// Gap between an obstacle and what a shape sweeps between two poses, as in Python's FreeSpace: the
// largest separation along the normals of all; negative where they overlap, at most about FAR.
function gap(obstacle, sides, one, other) {
  let most = -Infinity;
  const hull = [...one, ...other];
  const along = (these, those) => ([x, y]) => {
    let [low, high] = [Infinity, -Infinity];
    for (const [u, v] of those) low = Math.min(low, u * x + v * y);
    for (const [u, v] of these) high = Math.max(high, u * x + v * y);
    most = Math.max(most, low - high);
    return most > FAR;
  };
  const [from, to] = [middleOf(one), middleOf(other)];
  const across = apart(from, to) > 1e-12 ? normals([from, to]) : []; // to both sides
  if (across.some(along(hull, obstacle)) || sides.some(along(obstacle, hull))) return most;
  [one, other].some((shape) => normals(shape).some(along(hull, obstacle)));
  return most;
}

// What all actions of a plan have in common: obstacles, outline, and the margin at its start.
function spaceOf({ object, pose, obstacles }) {
  const known = obstacles.map((one) => {
    const corners = cornersOf(one);
    const middle = middleOf(corners);
    return { corners, sides: normals(corners), middle, size: farthest(corners, middle) };
  });
  const here = placed(object.seen, pose);
  const [start, most, fullAt] = object.margins;
  const least = Math.min(start, ...known.map((one) => gap(one.corners, one.sides, here, here)));
  const margin = (at) => share(least, most, Math.min(apart(at, pose) / fullAt, 1));
  return { known, margin, size: farthest(object.seen) };
}

// Smallest gap minus margin of an action; the margin grows with the distance from the plan's start.
export function spare(problem, from, direction, stop) {
  const { object } = problem;
  const { known, margin, size: radius } = problem.space ?? spaceOf(problem);
  const path = pathOf(object, { from, direction, stop }, POSES);
  const { size, grip } = object.hand;
  const hands = grip === null
    ? [0, stop].map((phase) =>
        [...beyond(from, direction, handAt(object.hand, phase)[0]), direction])
    : [path[0], path[POSES - 1]].map(([x, y]) => [x, y, grip + from[2] - object.yaw]);
  const sweeps = path.map((at, k) => [object.seen, radius, at, path[k + 1] ?? at, at]);
  sweeps.unshift([box(...size), Math.hypot(...size), ...hands, path[0]]);
  let worst = Infinity;
  for (const [shape, long, a, b, at] of sweeps) {
    const [reach, centre] = [long + apart(a, b) / 2, middleOf([a, b])];
    for (const { corners, sides, middle, size: other } of known) {
      const away = apart(centre, middle) - reach - other;
      const found = away > FAR ? FAR : gap(corners, sides, placed(shape, a), placed(shape, b));
      worst = Math.min(worst, found - margin(at));
    }
    if (worst < 0 && problem.space) return worst; // no plan needs to know by how much
  }
  return worst;
}

// problem: {object: {map, outline, hand, yaw (of the object in the map's image)}, pose [x, y, yaw],
// goal [x, y], tolerance, most (actions), partial (may stop early), risk (weight of the variance),
// obstacles, reachable, table [x0, x1, y0, y1], previous (a chain), quick (a smaller search)}.
export function plan(query) {
  const problem = query.obstacles?.length ? { ...query, space: spaceOf(query) } : query;
  const { object, pose, goal, most = 3, tolerance = 0.02 } = problem;
  const far = apart(goal, pose);
  const fewest = Math.max(1, Math.ceil(far / Math.max(object.map.reach, 1e-4)));
  let best = null;
  for (let n = Math.min(fewest, most); n <= most && far > 1e-4; n++) {
    const found = bestChain(problem, n);
    if (found && !(best?.cost <= found.cost)) best = found;
    if (best && n > fewest && best.distance < tolerance) break;
  }
  const { chain, distance } = best?.distance < far ? best : { chain: [], distance: far };
  return { chain, steps: stepsOf(problem, chain), distance, reached: distance <= tolerance };
}

// Numbers in [0, 1) that fill it evenly.
function halton(i, base) {
  let [value, part] = [0, 1];
  for (let k = i; k > 0; k = Math.floor(k / base)) value += (part /= base) * (k % base);
  return value;
}

function startsOf({ object, pose, goal, partial = true, obstacles = [], quick }, n) {
  const ahead = bearing(pose, goal);
  const starts = [];
  for (let i = 1; i <= (obstacles.length && !quick ? 3 : 1) * STARTS; i++) {
    const spread = obstacles.length && i % 2 ? Math.PI : SPREAD; // half of them make a detour
    const chain = [];
    for (let k = 0; k < n - 1; k++) {
      const phase = partial ? 0.5 + 0.5 * halton(i, [3, 7][k % 2]) : 1;
      chain.push(ahead + spread * (2 * halton(i, [2, 5][k % 2]) - 1), phase);
    }
    const end = rollOut(object, pose, chain).at(-1)?.end ?? pose;
    // A single action begins around the one that ends nearest.
    const off = n > 1 ? [0, 0] : [0.02 * (halton(i, 2) - 0.5), 0.02 * (halton(i, 3) - 0.5)];
    const turn = end[2] - object.yaw;
    const left = rotated(plus(minus(goal, end), off), -turn);
    const [direction, phase] = object.map.nearest(...left, partial);
    starts.push([...chain, direction + turn, phase]);
  }
  return starts;
}

function bestChain(problem, n) {
  const { object, pose, goal, partial = true, risk = 10, previous } = problem;
  const weighed = (chain) => {
    const { end, std } = rollOut(object, pose, chain, true).at(-1);
    const distance = apart(goal, end);
    const cost = distance + Math.sqrt(distance ** 2 + risk * std ** 2) + ACTION_COST * n;
    return { chain, distance, cost };
  };
  const sorted = (all) => all.sort((a, b) => a.cost - b.cost);
  const allowed = ({ chain }) => isAllowed(problem, chain);
  const corrected = (all, rounds) =>
    all.map(({ chain }) => weighed(correct(problem, chain, rounds)));
  const few = [];
  for (const start of sorted(startsOf(problem, n).map(weighed))) {
    if (few.length < REFINED && allowed(start)) few.push(start);
  }
  const options = [...few, ...corrected(few)];
  if (previous?.length === 2 * n && (partial || previous.every((v, k) => k % 2 === 0 || v === 1))) {
    const kept = weighed(correct(problem, previous));
    options.push({ ...kept, cost: kept.cost - LOYALTY });
  }
  const best = sorted(options).find(allowed);
  if (!best || best.distance < NEAR_ENOUGH) return best;
  return sorted([weighed(best.chain), ...corrected(options.slice(0, REFINED), 40)]).find(allowed);
}

// Newton's method on the end of a chain; of all solutions the smallest change.
export function correct({ object, pose, goal, partial = true }, start, rounds = CORRECTIONS) {
  const off = (chain) => minus(goal, rollOut(object, pose, chain).at(-1).end);
  const scale = (k) => (k % 2 ? 0.5 : 1); // half the phase moves the end about as far as a radian
  let [chain, left] = [start, off(start)];
  for (let round = 0; round < rounds && Math.hypot(...left) > 1e-5; round++) {
    const columns = chain.map((value, k) => {
      if (k % 2 && !partial) return [0, 0];
      const h = k % 2 ? -1e-6 : 1e-6; // a phase of 1 cannot grow
      const moved = off(chain.with(k, value + h));
      const slope = [0, 1].map((axis) => ((left[axis] - moved[axis]) / h) * scale(k));
      const blocked = k % 2 && value >= 1 && slope[0] * left[0] + slope[1] * left[1] > 0;
      return blocked ? [0, 0] : slope;
    });
    let [a, b, d] = [1e-8, 0, 1e-8];
    for (const [u, v] of columns) [a, b, d] = [a + u * u, b + u * v, d + v * v];
    const det = a * d - b * b;
    const [p, q] = [(d * left[0] - b * left[1]) / det, (a * left[1] - b * left[0]) / det];
    const step = columns.map(([u, v], k) => (u * p + v * q) * scale(k));
    const part = Math.min(1, 0.3 / Math.max(...step.map(Math.abs), 1e-9));
    const better = [1, 1 / 2, 1 / 4, 1 / 8].some((half) => {
      const moved = chain.map((value, k) => value + half * part * step[k]);
      const tried = moved.map((value, k) => (k % 2 ? between(0, value, 1) : value));
      const after = off(tried);
      const nearer = Math.hypot(...after) < Math.hypot(...left);
      if (nearer) [chain, left] = [tried, after];
      return nearer;
    });
    if (!better) break;
  }
  return chain;
}

// Whether the arm can reach all actions, the object stays on the table and meets no obstacle.
function isAllowed({ object, pose, reachable, table, space }, chain) {
  const [x0, x1, y0, y1] = table ?? [-1, 1, -1, 1];
  const radius = farthest(object.outline);
  return rollOut(object, pose, chain).every(({ direction, stop, from, end: [x, y] }) => {
    if (reachable && !reachable(from[0], from[1], direction)) return false;
    if (x < x0 + radius || x > x1 - radius || y < y0 + radius || y > y1 - radius) return false;
    return !space || spare({ object, pose, space }, from, direction, stop) >= 0;
  });
}

// From here on: the drawing.

const STAR = Array.from({ length: 10 }, (_, k) =>
  beyond([0, 0], (k / 10 + 1 / 4) * TURN, k % 2 ? 0.4 : 1));
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const CHANGES = { "+": "larger", "-": "smaller", Delete: "remove" }; // buttons, by key
const AROUND = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]];
const [HIGH, LOW] = [0.1375, 0.0125]; // heights of a hand that is not seen, and fully [m]
const LETTER = 7.5; // width of a letter of a label [px]

const still = () => window.matchMedia("(prefers-reduced-motion: reduce)").matches;
const escaped = (text) =>
  String(text).replace(/[&<>"']/g, (letter) => `&#${letter.charCodeAt(0)};`);

const DISC = { corners: [[0, 0]], radius: 0.02, height: 0.06 };
const BOX = { corners: box(0.025, 0.02), radius: 0, height: 0.06 };
const shifted = (one, by) => ({ ...one, corners: one.corners.map((at) => plus(at, by)) });
const sizeKnob = (one) => cornersOf(one).toSorted((a, b) => b[0] + b[1] - (a[0] + a[1]))[0];

function resized(one, by) {
  if (one.radius) return { ...one, radius: between(0.006, one.radius * by, 0.12) };
  const middle = middleOf(one.corners);
  const resize = (at) => at.map((value, axis) => share(middle[axis], value, by));
  return { ...one, corners: one.corners.map(resize) };
}

function shape(tag, css, attributes, inside = "") {
  const said = Object.entries(attributes).map(([name, value]) => ` ${name}="${escaped(value)}"`);
  return `<${tag} class="${css}"${said.join("")}>${inside}</${tag}>`;
}

const rectangle = (css, x, y, width, height, rx) => shape("rect", css, { x, y, width, height, rx });

// state: {object, pose, goal {xy, yaw, tolerance}, steps, other (steps to compare with), obstacles,
// ring, trail, marks (what moved by itself: [from, to]), searched, since (when), sigma, swept, note
// (text in a corner), planning, live (pose, hand and lift that are shown instead)}.
// heard: {goal(xy, final), obstacles(all, final), press(key), pose(pose, final), if it is movable}.
export class Table {
  constructor(el, heard) {
    this.heard = heard;
    this.state = { pose: [0, 0, 0], goal: { xy: [0, 0], tolerance: 0.02 }, steps: [], other: [],
      obstacles: [], trail: [], marks: [], searched: [] };
    this.camera = null; // [x, y, half of the shown height]
    this.held = this.tapped = this.chosen = null;
    el.classList.add("affordlib-table");
    el.dataset.lmSuppressShortcuts = "true"; // JupyterLab's own, while this has the focus
    el.innerHTML = '<svg role="application" tabindex="0"></svg><div class="tools"></div>';
    this.svg = el.firstChild;
    this.tools(el.lastChild);
    const acts = {
      pointerdown: (event) => this.pressed(event),
      pointermove: (event) => this.held && this.move(this.place(event), false),
      pointerup: (event) => this.released(event),
      pointercancel: () => (this.held = this.tapped = null),
      keydown: (event) => this.typed(event),
    };
    for (const [name, act] of Object.entries(acts)) this.svg.addEventListener(name, act);
    new ResizeObserver(() => this.draw()).observe(this.svg);
  }

  // Buttons that add, change and remove obstacles, for mouse, touch and keyboard.
  tools(row) {
    this.acts = {
      "+ disc": () => this.add(DISC),
      "+ box": () => this.add(BOX),
      larger: () => this.change((one) => resized(one, 1.2)),
      smaller: () => this.change((one) => resized(one, 1 / 1.2)),
      remove: () => this.change(() => []),
    };
    row.innerHTML = Object.keys(this.acts).map((name) =>
      `<button type="button" aria-label="obstacle: ${name}">${name}</button>`).join("");
    row.addEventListener("click", ({ target }) => this.acts[target.textContent]?.());
  }

  // Add an obstacle between object and goal, beside those that are there.
  add(one) {
    const { obstacles, pose, goal: { xy } } = this.state;
    const [row, side] = [Math.floor(obstacles.length / 2), obstacles.length % 2 ? -1 : 1];
    const [at] = placed([[0.06 * row, 0.09 * side]], [...middleOf([pose, xy]), bearing(pose, xy)]);
    this.chosen = obstacles.length;
    this.heard.obstacles([...obstacles, shifted(one, at)], true);
  }

  // Replace the chosen obstacle by another, or by none: [].
  change(act, final = true) {
    const { obstacles } = this.state;
    if (!obstacles[this.chosen]) return;
    const all = obstacles.flatMap((one, k) => (k === this.chosen ? act(one) : one));
    if (all.length < obstacles.length) this.chosen = null;
    this.heard.obstacles(all, final);
  }

  set(changes) {
    Object.assign(this.state, changes);
    this.frame();
  }

  // Let the view follow what is to be seen; a hand that drags moves it only outwards.
  frame() {
    const { pose, goal, steps, object, obstacles, trail } = this.state;
    if (!object) return;
    const ends = steps.flatMap(({ from, end, direction }) =>
      [end, beyond(from, direction ?? 0, -0.07)]);
    const seen = [pose, goal.xy, ...ends, ...trail, ...obstacles.flatMap(cornersOf)];
    const [width, height] = this.size();
    const room = this.held ? 0.015 : farthest(object.outline) + 0.035;
    if (this.held) {
      const [x, y, half] = this.camera;
      const [w, h] = [(half * width) / height - room, half - room];
      seen.push([x - w, y - h], [x + w, y + h]);
    }
    const [[x0, x1], [y0, y1]] = [0, 1].map((axis) => {
      const values = seen.map((at) => at[axis]);
      return [Math.min(...values) - room, Math.max(...values) + room];
    });
    const half = between(0.13, Math.max(y1 - y0, ((x1 - x0) * height) / width) / 2, EXTENT);
    if (this.held && Math.abs(half - this.camera[2]) < 1e-9) return this.draw();
    const middle = middleOf([[x0, y0], [x1, y1]]);
    this.glide([...middle.map((v) => between(half - EXTENT, v, EXTENT - half)), half]);
  }

  glide(wanted) {
    cancelAnimationFrame(this.gliding);
    const [from, began] = [this.camera ?? wanted, performance.now()];
    const step = (now) => {
      const t = from === wanted || still() ? 1 : between(0, (now - began) / 250, 1);
      this.camera = from.map((value, k) => share(wanted[k], value, (1 - t) ** 3));
      this.draw();
      if (t < 1) this.gliding = requestAnimationFrame(step);
    };
    step(began);
  }

  size() {
    return [this.svg.clientWidth || 480, this.svg.clientHeight || 480];
  }

  get scale() {
    return this.size()[1] / (2 * this.camera[2]);
  }

  // Pixels of a place on the table, and back.
  at([x, y]) {
    const [width, height] = this.size();
    const [cx, cy] = this.camera;
    return [width / 2 + (x - cx) * this.scale, height / 2 - (y - cy) * this.scale];
  }

  place({ clientX, clientY }) {
    const { left, top } = this.svg.getBoundingClientRect();
    const [[width, height], [x, y]] = [this.size(), this.camera];
    const [right, down] = [clientX - left - width / 2, clientY - top - height / 2];
    return [x + right / this.scale, y - down / this.scale];
  }

  // Show a place in a motion: rows of [x, y, yaw, lift, hand's x, y, z, yaw, gap, bodies in 3-D].
  replay(rows, place, trail = true) {
    place = between(0, place, rows.length - 1); // a frame's time may lie before the start
    const [before, now] = [rows.slice(0, Math.floor(place) + 1), blend(rows, place)];
    const [x, y, yaw, lift, u, v, z, , gap] = now;
    const near = between(0, (z - HIGH) / (LOW - HIGH), 1);
    const hand = { gap, direction: before.at(-1)[7], from: [u, v], near };
    this.state.live = { pose: [x, y, yaw], lift, hand };
    this.state.trail = trail ? before : [];
    this.draw();
    return now;
  }

  // A planner's search, lines and single points, that grows in the order in which it went.
  tried() {
    const { searched, since } = this.state;
    const grown = still() ? 1 : between(0, (performance.now() - since) / GROWS, 1);
    cancelAnimationFrame(this.growing);
    if (grown < 1) this.growing = requestAnimationFrame(() => this.draw());
    const all = searched.flatMap((line) =>
      line.map((at, k) => (k ? `L${this.points([at])}` : `M${this.points([at])}z`))); // z: a dot
    return shape("path", "tried", { d: all.slice(0, Math.ceil(grown * all.length)).join("") });
  }

  points(corners) {
    return corners.map((corner) => this.at(corner).map((v) => v.toFixed(1)).join()).join(" ");
  }

  outline(pose, css, more = {}, size = 1) {
    const corners = this.state.object.outline.map((corner) => corner.map((value) => size * value));
    return shape("polygon", css, { points: this.points(placed(corners, pose)), ...more });
  }

  disc(at, css, radius, more = {}) {
    const [cx, cy, r] = [...this.at(at), radius * this.scale].map((v) => v.toFixed(1));
    return shape("circle", css, { cx, cy, r, ...more });
  }

  line(points, css) {
    return shape("polyline", css, { points: this.points(points) });
  }

  draw() {
    const { state } = this;
    if (!state.object || !this.camera) return;
    const { pose, goal, steps, other, obstacles, trail, live } = state;
    const knob = beyond(this.ahead(pose, 1.25), pose[2], 10 / this.scale);
    const end = steps.at(-1)?.end ?? pose;
    const short = apart(end, goal.xy);
    const missed = short > goal.tolerance && !state.planning;
    const standing = live?.pose ?? pose;
    const lift = live?.lift > 0.003 ? live.lift : 0;
    const swept = (state.swept ? steps : []).flatMap(({ path }) =>
      path.map((at) => `M${this.points(placed(state.object.outline, at))}Z`));
    const handle = this.heard.pose ? { "data-handle": "object" } : {};
    const shapes = [
      this.ground(),
      ...obstacles.map((one, k) => this.obstacle(one, k)),
      swept.length && shape("path", "swept", { d: swept.join("") }),
      state.searched.length && !live && this.tried(),
      ...other.flatMap(({ path, end }) => [this.line(path, "other"), this.outline(end, "other")]),
      ...state.marks.map((mark) => this.line(mark, "mark")),
      ...steps.flatMap((step, k) => [
        state.sigma && step.std && this.disc(step.end, "sigma", ENLARGED * step.std),
        this.line(step.path, "prediction"),
        this.outline(step.end, k === steps.length - 1 ? "predicted" : "ghost"),
      ]),
      trail.length && this.line(trail, "truth"),
      missed && this.line([end, goal.xy], "short"),
      this.outline(standing, lift ? "object lifted" : "object", handle, 1 + 3 * lift),
      this.line([standing, this.ahead(standing, 0.5)], "heading"),
      this.goal(end, missed),
      this.heard.pose && !live && this.knob("yaw", knob, 22 / this.scale, 6 / this.scale),
      live && this.hand(live.hand),
      ...(live || this.held ? [] : steps.map((step) => this.arrow(step))),
      shape("g", "labels", {}, this.labels(missed ? short : 0)),
      this.ruler(),
    ];
    this.svg.innerHTML = shapes.filter(Boolean).join("");
    this.svg.setAttribute("viewBox", `0 0 ${this.size().join(" ")}`);
    const [gx, gy, x, y] = [...goal.xy, ...pose].map((value) => (100 * value).toFixed(1));
    this.svg.ariaLabel =
      `Table from above. The goal is at x = ${gx}, y = ${gy} cm, the object at x = ${x}, ` +
      `y = ${y} cm. Arrow keys move the goal by 1 cm, with Shift by 1 mm; Enter runs the plan, ` +
      "Escape stops it. An obstacle that is chosen is moved by the arrow keys, resized by + " +
      "and -, removed by Delete.";
    this.svg.dataset.view = this.camera.map((v) => v.toFixed(5)).join(" ");
  }

  obstacle(one, k) {
    const chosen = k === this.chosen;
    const more = { points: this.points(cornersOf(one)), "data-handle": `obstacle ${k}` };
    const body = shape("polygon", chosen ? "obstacle chosen" : "obstacle", more);
    return chosen ? body + this.knob(`size ${k}`, sizeKnob(one), 0.012, 0.004) : body;
  }

  ground() {
    const [middle, inner, outer] = this.state.ring;
    const shapes = [this.disc([middle, 0], "reach", outer)];
    shapes.push(this.disc([middle, 0], "reach inner", inner));
    const [cx, cy, half] = this.camera;
    const [width, height] = this.size();
    const [w, step] = [(half * width) / height, 0.05];
    for (let x = Math.ceil((cx - w) / step) * step; x < cx + w; x += step) {
      for (let y = Math.ceil((cy - half) / step) * step; y < cy + half; y += step) {
        shapes.push(this.disc([x, y], "dot", 1 / this.scale));
      }
    }
    return shapes.join("");
  }

  goal(end, missed) {
    const { xy, yaw, tolerance } = this.state.goal;
    const size = between(9 / this.scale, 0.012, 15 / this.scale);
    const points = this.points(STAR.map((corner) => plus(xy, corner.map((v) => size * v))));
    return shape("g", "wanted", { "data-handle": "goal" }, [
      this.disc(xy, "grip", 28 / this.scale),
      this.outline([...xy, yaw ?? end[2]], yaw == null ? "place" : "place turned"),
      this.disc(xy, "tolerance", tolerance),
      shape("polygon", missed ? "goal missed" : "goal", { points }),
    ].join(""));
  }

  ahead(pose, part) {
    return beyond(pose, pose[2], part * farthest(this.state.object.outline));
  }

  // What turns or resizes, with the radii of what is grabbed and seen.
  knob(handle, at, grip, seen) {
    const discs = this.disc(at, "grip", grip) + this.disc(at, "turner", seen);
    return shape("g", "knob", { "data-handle": handle }, discs);
  }

  // How what is drawn around (0, 0), to the right, gets to a place and a direction.
  towards(at, direction) {
    return `translate(${this.at(at).join(" ")}) rotate(${(-direction * 360) / TURN})`;
  }

  hand({ gap, direction, from, near }) {
    const wide = Math.max(gap / 2, 0.006);
    const s = this.scale * share(1.25, 1, near);
    const part = (css, ...numbers) => rectangle(css, ...numbers.map((value) => value * s));
    const palm = part("palm", -0.05, -(wide + 0.02), 0.032, 2 * (wide + 0.02), 0.008);
    const finger = (side) => part("finger", -0.022, side - 0.009, 0.022, 0.018, 0.004);
    const about = { transform: this.towards(from, direction), opacity: near.toFixed(2) };
    return shape("g", "hand", about, palm + finger(-wide) + finger(wide));
  }

  // Where an action begins to push, outside the object.
  arrow({ direction, from }) {
    if (direction === null) return "";
    const turned = placed(this.state.object.outline, [0, 0, from[2] - direction]);
    const back = -Math.min(...turned.map(([x]) => x)) * this.scale + 4;
    const line = shape("path", "push", { d: `M${-back - 34} 0H${-back - 9}` });
    const head = shape("path", "push-head", { d: `M${-back} 0l-12 6v-12z` });
    return shape("g", "arrow", { transform: this.towards(from, direction) }, line + head);
  }

  labels(short) {
    const { steps, goal, pose, object, obstacles, sigma } = this.state;
    const taken = []; // [x, y, radius] of what they are not to cover
    const take = (places, radius) => taken.push(...places.map((at) => [...this.at(at), radius]));
    take([...placed(object.outline, pose), ...obstacles.flatMap(cornersOf)], 6);
    take(this.heard.pose ? [pose, this.ahead(pose, 1.5)] : [pose], 14);
    take([goal.xy], Math.max(18, goal.tolerance * this.scale));
    for (const { path, end, from, direction } of steps) {
      take([...path, ...placed(object.outline, end)], 5);
      const arrow = direction === null ? [] : [-0.05, -0.07, -0.09];
      take(arrow.map((far) => beyond(from, direction, far)), 8);
    }
    const texts = steps.map(({ stop, end, name }, k) =>
      [`${k + 1}: ${name ? `${name} to ` : ""}${Math.round(100 * stop)} %`, end, "step"]);
    const last = steps.at(-1);
    const cm = (100 * short).toFixed(short < 0.01 ? 1 : 0);
    if (short) texts.push([`${cm} cm short`, goal.xy, "step short-by"]);
    const mm = (1000 * last?.std).toFixed(1);
    if (sigma && last?.std) texts.push([`σ ${mm} mm (× ${ENLARGED})`, last.end, "step small"]);
    return texts.map(([text, at, css]) => this.label(text, this.at(at), css, taken)).join("");
  }

  label(text, [u, v], css, taken) {
    const [width, height] = this.size();
    const [w, h] = [(LETTER * text.length + 14) / 2, 11];
    let [x, y, room] = [0, 0, -Infinity];
    for (const gap of [12, 28, 48, 75, 110]) {
      for (const [i, j] of AROUND) {
        const a = between(w + 3, u + i * (w + gap), width - w - 3);
        const b = between(h + 3, v + j * (h + gap), height - h - 3);
        const free = taken.map(([c, d, r]) =>
          Math.hypot(Math.max(Math.abs(c - a) - w, 0), Math.max(Math.abs(d - b) - h, 0)) - r);
        const away = Math.min(...free, 3);
        if (away > room) [x, y, room] = [a, b, away];
      }
    }
    for (let dx = -w; dx <= w; dx += h) taken.push([x + dx, y, h]);
    const rim = [between(x - w, u, x + w), between(y - h, v, y + h)];
    const leader = apart(rim, [u, v]) > 45
      ? shape("path", "leader", { d: `M${rim.join(" ")}L${u} ${v}` }) : "";
    const plate = rectangle("plate", x - w, y - h, 2 * w, 2 * h, h);
    const words = shape("text", "", { x, y: y + 4.5 }, escaped(text));
    return leader + shape("g", css, {}, plate + words);
  }

  ruler() {
    const [width, height] = this.size();
    const cm = [10, 5, 2].find((value) => (value / 100) * this.scale < width / 3) ?? 2;
    const long = (cm / 100) * this.scale;
    const d = `M12 ${height - 20}v6h${long.toFixed(1)}v-6`;
    const note = shape("text", "note", { x: width - 12, y: 22 }, escaped(this.state.note ?? ""));
    return shape("path", "ruler", { d }) + note +
      shape("text", "tick", { x: 12 + long / 2, y: height - 22 }, `${cm} cm`);
  }

  // What a pointer grabs. By touch only what is marked, since a swipe elsewhere scrolls the page.
  pressed(event) {
    if (event.button || !this.camera) return;
    const at = this.place(event); // before focusing, which may scroll the drawing into view
    const handle = event.target.closest("[data-handle]")?.dataset.handle;
    this.tapped = event.pointerType === "touch" && !handle;
    if (this.tapped) return;
    this.held = handle ?? "goal";
    const { pose, obstacles } = this.state;
    const [kind, number] = this.held.split(" ");
    this.chosen = number ? Number(number) : null;
    const middle = { object: pose, obstacle: number && middleOf(obstacles[number].corners) }[kind];
    this.grip = middle ? minus(middle, at) : [0, 0]; // from the pointer to what it holds
    this.svg.setPointerCapture(event.pointerId);
    this.svg.classList.add("by-pointer"); // focused so, it needs no frame
    this.svg.focus({ preventScroll: true });
    event.preventDefault();
    this.move(at, false);
  }

  released(event) {
    if (this.tapped) Object.assign(this, { held: "goal", grip: [0, 0], last: this.place(event) });
    if (this.held) this.move(this.last, true); // the view may have moved
    this.held = this.tapped = null;
    this.frame();
  }

  move(at, final) {
    this.last = at;
    const [x, y, yaw] = this.state.pose;
    const to = plus(at, this.grip).map((value) => between(-LIMIT, value, LIMIT));
    if (this.held === "goal") this.aim(to, final);
    else if (this.held === "object") this.heard.pose([...to, yaw], final);
    else if (this.held === "yaw") this.heard.pose([x, y, bearing([x, y], at)], final);
    else this.change((one) => {
      const middle = middleOf(one.corners);
      if (this.held.startsWith("obstacle")) return shifted(one, minus(to, middle));
      return resized(one, apart(to, middle) / apart(sizeKnob(one), middle));
    }, final);
  }

  // Ask for a goal, in whole millimetres on the table.
  aim(place, final) {
    const { xy } = this.state.goal;
    const [x, y] = place.map((value) => Math.round(1000 * between(-LIMIT, value, LIMIT)) / 1000);
    if (final || x !== xy[0] || y !== xy[1]) this.heard.goal([x, y], final);
  }

  typed(event) {
    this.svg.classList.remove("by-pointer");
    const { key, shiftKey } = event;
    const { goal, pose, obstacles } = this.state;
    const one = obstacles[this.chosen];
    const by = KEYS[key]?.map((way) => way * (shiftKey ? 0.001 : 0.01));
    if (one && by) this.change(() => shifted(one, by));
    else if (one && key in CHANGES) this.acts[CHANGES[key]]();
    else if (one && key === "Escape") {
      this.chosen = null;
      this.draw();
    } else if (by) this.aim(plus(goal.xy, by), true);
    else if (this.heard.pose && "qe".includes(key)) {
      this.heard.pose([pose[0], pose[1], pose[2] + (key === "q" ? 0.0873 : -0.0873)], true);
    } else if (key === "Enter" || key === "Escape") this.heard.press(key);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}

// Move the bodies of a scene in 3-D, if the page has it: [its name, their numbers], or [].
function moveBodies([name, numbers], row) {
  const scene = globalThis.affordlib?.[name];
  for (const body of scene?.getWorld().K3DObjects.children ?? []) {
    const k = numbers.indexOf(body.K3DIdentifier);
    if (k < 0) continue;
    const [x, y, z, ...turn] = row.slice(9 + 7 * k, 16 + 7 * k);
    body.position.set(x, y, z);
    body.quaternion.fromArray(turn).normalize();
  }
  scene?.render();
}

// A view of Python's widget: while a hand drags, the browser plans; when it lets go, Python does.
function render({ model, el }) {
  let [number, chain, recorded, bodies, began, timer] = [0, [], [], [], 0, null];

  // Show what a hand changes and, unless the robot moves, a plan for it; Python hears the last.
  function draft(changes, final, ...wanted) {
    const { object, pose, goal: { xy, tolerance }, obstacles } = { ...view.state, ...changes };
    if (object && !model.get("scene").running) {
      const query = { object, pose, goal: xy, tolerance, obstacles, reachable: object.reachable };
      const [{ table }, { partial }] = [model.get("table"), model.get("scene")];
      ({ chain, steps: changes.steps } = plan({ ...query, table, partial, previous: chain, quick: true }));
    }
    view.set({ ...changes, other: [] });
    if (!final) return;
    model.set(...wanted);
    model.save_changes(); // ipywidgets sends the next one when this one has been processed
  }

  const view = new Table(el, {
    goal(xy, final) {
      number = Math.max(number, model.get("wanted")[2]) + 1;
      Object.assign(view.svg.dataset, { query: number, draft: true });
      draft({ goal: { ...view.state.goal, xy }, searched: [] }, final, "wanted", [...xy, number]);
    },
    obstacles: (all, final) => draft({ obstacles: all }, final, "obstacles", all),
    press: (key) => model.send({ press: key === "Enter" ? "run" : "stop" }),
  });
  const scrub = document.createElement("input");
  Object.assign(scrub, { type: "range", min: 0, max: 1, step: "any", hidden: true });
  scrub.setAttribute("aria-label", "Time of the last run");
  scrub.addEventListener("input", () => !timer && at(Number(scrub.value) * (recorded.length - 1)));
  el.append(scrub);

  function look() {
    const { map, ...about } = model.get("object");
    if (!map) return; // nothing has been planned yet
    const { reach, ring, seconds } = model.get("table");
    const reachable = reach && reachability(reach, map.primitive);
    chain = [];
    view.set({ object: { ...about, seconds, reachable, map: new EffectMap(map) }, ring });
  }

  function show() {
    const { answered, running, planning, ...scene } = model.get("scene");
    if (!scene.goal) return;
    const late = answered < number || Boolean(view.held); // the hand is ahead of Python
    const { goal, steps } = view.state;
    if (late) Object.assign(scene, { goal: { ...scene.goal, xy: goal.xy }, steps });
    else chain = [];
    Object.assign(view.svg.dataset, { answered, planning, draft: late });
    view.svg.setAttribute("aria-busy", planning);
    if (!running && !timer) scene.live = null;
    if (!view.held) scene.obstacles = model.get("obstacles");
    view.set({ ...scene, planning, sigma: true, swept: true, note: planning ? "planning …" : "" });
  }

  function at(place) {
    scrub.value = place / Math.max(recorded.length - 1, 1);
    moveBodies(bodies, view.replay(recorded, place));
  }

  function heard({ motions, first, bodies: others }) {
    if (first) [recorded, began, bodies] = [[], performance.now(), others];
    recorded.push(...motions);
    scrub.hidden = false;
    const frame = (now) => {
      const { pace, running } = model.get("scene");
      const last = recorded.length - 1;
      const place = still() ? last : Math.min((now - began) / (1000 * pace), last);
      at(place);
      const waits = place >= last;
      if (waits) began = now - 1000 * pace * last; // for what is simulated next
      timer = waits && !running ? null : requestAnimationFrame(frame);
      if (!timer) show();
    };
    timer ??= requestAnimationFrame(frame);
  }

  // Sliders beside the table have no names for screen readers.
  const nameSliders = () => {
    const handles = el.closest(".affordlib-picker")?.querySelectorAll("[role=slider]") ?? [];
    for (const handle of handles) {
      const label = handle.closest(".widget-slider").querySelector(".widget-label");
      handle.ariaLabel = label.textContent;
    }
  };
  new ResizeObserver(() => setTimeout(nameSliders, 500)).observe(el); // when all is there
  const searched = () => view.set({ searched: model.get("searched"), since: performance.now() });
  const acts = { object: look, scene: show, obstacles: show, searched };
  for (const [name, act] of Object.entries(acts)) model.on(`change:${name}`, act);
  model.on("msg:custom", heard); // anywidget ends all when the view ends
  look();
  show();
  searched();
  return () => cancelAnimationFrame(timer);
}

export default { render };
