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
const rotated = ([x, y], angle) => {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return [c * x - s * y, s * x + c * y];
};
const placed = (outline, [x, y, yaw]) =>
  outline.map((corner) => {
    const [u, v] = rotated(corner, yaw);
    return [x + u, y + v];
  });

function decoded(text, Type) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Type(bytes.buffer);
}

// Effects of an action, ahead, to the left, turn, and their σ, over direction and phase: the cubic
// B-spline of Python's EffectMap, from its numbers.
export class EffectMap {
  constructor({ primitive, shape: [rows, columns], from, scale, coefficients }) {
    const whole = decoded(coefficients, Int16Array);
    Object.assign(this, { primitive, rows, columns, from, stride: 6 * (columns + 3) });
    this.padded = new Float64Array((rows + 3) * this.stride);
    for (let i = 0; i < rows + 3; i++) {
      for (let j = 0; j < columns + 3; j++) {
        const row = (i - 1 + rows) % rows;
        const column = columns - 1 - Math.abs(columns - 1 - Math.abs(j - 1)); // mirrored
        for (let k = 0; k < 6; k++) {
          this.padded[i * this.stride + 6 * j + k] = whole[6 * (row * columns + column) + k] * scale[k];
        }
      }
    }
    this.fine = new Float64Array(2 * FINE_DIRECTIONS * FINE_PHASES);
    this.reach = 0;
    const effect = new Float64Array(6);
    for (let i = 0; i < FINE_DIRECTIONS * FINE_PHASES; i++) {
      const [direction, phase] = this.action(i);
      this.at(direction, phase, effect);
      this.fine.set(rotated(effect, direction), 2 * i);
      this.reach = Math.max(this.reach, Math.hypot(effect[0], effect[1]));
    }
  }

  action(i) {
    const phase = share(this.from, 1, (i % FINE_PHASES) / (FINE_PHASES - 1));
    return [(Math.floor(i / FINE_PHASES) * TURN) / FINE_DIRECTIONS, phase];
  }

  at(direction, phase, out) {
    const x = ((((direction % TURN) + TURN) % TURN) * this.rows) / TURN;
    const y = ((between(this.from, phase, 1) - this.from) * (this.columns - 1)) / (1 - this.from);
    const [i, j] = [Math.min(Math.floor(x), this.rows - 1), Math.min(Math.floor(y), this.columns - 1)];
    weigh(x - i, ROW);
    weigh(y - j, COLUMN);
    out.fill(0);
    for (let a = 0; a < 4; a++) {
      for (let b = 0; b < 4; b++) {
        const weight = ROW[a] * COLUMN[b];
        const first = (i + a) * this.stride + 6 * (j + b);
        for (let k = 0; k < 6; k++) out[k] += weight * this.padded[first + k];
      }
    }
    for (let k = 3; k < 6; k++) out[k] = Math.max(out[k], 1e-6);
    return out;
  }

  // The action that ends nearest to a place beside the object.
  nearest(x, y, partial) {
    const [first, step] = partial ? [0, 1] : [FINE_PHASES - 1, FINE_PHASES];
    let [best, least] = [first, Infinity];
    for (let i = first; i < FINE_DIRECTIONS * FINE_PHASES; i += step) {
      const far = (this.fine[2 * i] - x) ** 2 + (this.fine[2 * i + 1] - y) ** 2;
      if (far < least) [best, least] = [i, far];
    }
    return this.action(best);
  }
}

const ROW = new Float64Array(4);
const COLUMN = new Float64Array(4);
const EFFECT = new Float64Array(6);
const BEFORE = new Float64Array(6);
const AFTER = new Float64Array(6);

function weigh(u, out) {
  out[0] = (1 - u) ** 3 / 6;
  out[1] = (3 * u ** 3 - 6 * u ** 2 + 4) / 6;
  out[2] = (-3 * u ** 3 + 3 * u ** 2 + 3 * u + 1) / 6;
  out[3] = u ** 3 / 6;
}

// Poses after each action of a chain [direction, phase, …] of an object at the origin, and, where
// wanted, the variance of the position: that of each action, and that of turns on later actions.
export function rollOut(map, chain, yaw = 0, uncertain = false) {
  let [x, y, turn, trace, turnVariance, cx, cy] = [0, 0, yaw, 0, 0, 0, 0];
  const poses = [];
  for (let k = 0; k < chain.length; k += 2) {
    const [direction, phase] = [chain[k], chain[k + 1]];
    const effect = map.at(direction - turn, phase, EFFECT);
    const [c, s] = [Math.cos(direction), Math.sin(direction)];
    if (uncertain) {
      map.at(direction - turn - NEARBY, phase, BEFORE);
      map.at(direction - turn + NEARBY, phase, AFTER);
      const [u, v, w] = [0, 1, 2].map((i) => (BEFORE[i] - AFTER[i]) / (2 * NEARBY));
      const [sx, sy, kept] = [c * u - s * v, s * u + c * v, 1 + w];
      trace += 2 * (cx * sx + cy * sy) + turnVariance * (sx * sx + sy * sy);
      trace += effect[3] ** 2 + effect[4] ** 2;
      [cx, cy] = [kept * (cx + turnVariance * sx), kept * (cy + turnVariance * sy)];
      turnVariance = kept ** 2 * turnVariance + effect[5] ** 2;
    }
    x += c * effect[0] - s * effect[1];
    y += s * effect[0] + c * effect[1];
    turn += effect[2];
    poses.push([x, y, turn, trace]);
  }
  return poses;
}

// The last pose alone.
function endOf(map, chain, yaw) {
  let [x, y, turn] = [0, 0, yaw];
  for (let k = 0; k < chain.length; k += 2) {
    map.at(chain[k] - turn, chain[k + 1], EFFECT);
    const [c, s] = [Math.cos(chain[k]), Math.sin(chain[k])];
    x += c * EFFECT[0] - s * EFFECT[1];
    y += s * EFFECT[0] + c * EFFECT[1];
    turn += EFFECT[2];
  }
  return [x, y, turn];
}

// Whether the arm can act at (x, y) in a direction: Python's network, from its numbers.
export function reachability({ layers, primitives, threshold }, primitive) {
  const kind = primitives.indexOf(primitive);
  if (kind < 0) return () => true;
  const read = layers.map(([inputs, text]) => [inputs, decoded(text, Float32Array)]);
  const hot = primitives.map((_, k) => Number(k === kind));
  return (x, y, direction) => {
    let values = [2 * x, 2 * y, Math.cos(direction), Math.sin(direction), ...hot];
    for (const [inputs, weights] of read) {
      const outputs = weights.length / (inputs + 1);
      const bias = inputs * outputs;
      const next = new Array(outputs);
      for (let o = 0; o < outputs; o++) {
        let sum = weights[bias + o];
        for (let i = 0; i < inputs; i++) sum += weights[o * inputs + i] * values[i];
        next[o] = outputs > 1 ? Math.tanh(sum) : sum;
      }
      values = next;
    }
    return 1 / (1 + Math.exp(-values[0])) >= threshold;
  };
}

// Corners of an obstacle {corners, radius, height}, a disc as the polygon around it.
const cornersOf = ({ corners, radius }) =>
  radius ? RING.map(([x, y]) => [corners[0][0] + radius * x, corners[0][1] + radius * y]) : corners;

const SIDES = 16;
const RING = Array.from({ length: SIDES }, (_, k) => rotated([1 / Math.cos(Math.PI / SIDES), 0], (k * TURN) / SIDES));

function normals(corners) {
  return corners.map(([ax, ay], k) => {
    const [bx, by] = corners[(k + 1) % corners.length];
    const long = Math.hypot(bx - ax, by - ay) || 1;
    return [(by - ay) / long, (ax - bx) / long];
  });
}

// Gap between an obstacle and what a shape sweeps between two poses, as in Python's FreeSpace: the
// largest separation along the normals of all; negative where they overlap, at most about FAR.
function gap(obstacle, sides, one, other) {
  let most = -Infinity;
  const along = (x, y, these, those) => {
    let [low, high] = [Infinity, -Infinity];
    for (const [u, v] of those) low = Math.min(low, u * x + v * y);
    for (const [u, v] of these) high = Math.max(high, u * x + v * y);
    most = Math.max(most, low - high);
    return most > FAR;
  };
  const hull = [...one, ...other];
  let [dx, dy] = [0, 0];
  for (let k = 0; k < one.length; k++) [dx, dy] = [dx + other[k][0] - one[k][0], dy + other[k][1] - one[k][1]];
  const long = Math.hypot(dx, dy);
  if (long > 1e-12 && along(-dy / long, dx / long, hull, obstacle)) return most;
  if (long > 1e-12 && along(dy / long, -dx / long, hull, obstacle)) return most;
  for (const [x, y] of sides) if (along(x, y, obstacle, hull)) return most;
  for (const shape of [one, other]) {
    for (const [x, y] of normals(shape)) if (along(x, y, hull, obstacle)) return most;
  }
  return most;
}

// What all actions of a plan have in common: obstacles, outline, and the margin at its start.
function spaceOf({ object, pose, obstacles }) {
  const known = obstacles.map((one) => {
    const corners = cornersOf(one);
    const middle = middleOf({ corners });
    return { corners, sides: normals(corners), middle, size: farthest(corners, middle) };
  });
  const outline = object.seen ?? object.outline;
  const here = placed(outline, pose);
  const [start, most, fullAt] = object.margins;
  const least = Math.min(start, ...known.map((one) => gap(one.corners, one.sides, here, here)));
  const margin = ([x, y]) =>
    least + (most - least) * Math.min(Math.hypot(x - pose[0], y - pose[1]) / fullAt, 1);
  return { known, outline, margin, size: farthest(outline, [0, 0]) };
}

const farthest = (corners, [x, y]) => Math.max(...corners.map(([u, v]) => Math.hypot(u - x, v - y)));

// Smallest gap minus margin of an action; the margin grows with the distance from the plan's start.
export function spare(problem, from, direction, stop, turned) {
  const { object } = problem;
  const { known, outline, margin, size: radius } = problem.space ?? spaceOf(problem);
  const path = pathOf(object.map, from, direction, stop, turned, POSES);
  const { size, grip } = object.hand;
  const box = [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([x, y]) => [x * size[0], y * size[1]]);
  const hands = grip === null
    ? [0, stop].map((phase) => {
        const [dx, dy] = rotated([handAt(object.hand, phase).along, 0], direction);
        return [from[0] + dx, from[1] + dy, direction];
      })
    : [path[0], path[POSES - 1]].map(([x, y]) => [x, y, grip + turned]);
  const sweeps = path.map((at, k) => [outline, radius, at, path[Math.min(k + 1, POSES - 1)], at]);
  sweeps.unshift([box, Math.hypot(...size), ...hands, path[0]]);
  let worst = Infinity;
  for (const [shape, long, a, b, at] of sweeps) {
    const reach = long + Math.hypot(b[0] - a[0], b[1] - a[1]) / 2;
    for (const { corners, sides, middle, size: other } of known) {
      const away = Math.hypot((a[0] + b[0]) / 2 - middle[0], (a[1] + b[1]) / 2 - middle[1]) - reach - other;
      const found = away > FAR ? FAR : gap(corners, sides, placed(shape, a), placed(shape, b));
      worst = Math.min(worst, found - margin(at));
    }
    if (worst < 0 && problem.space) return worst; // no plan needs to know by how much
  }
  return worst;
}

// Poses of the object along an action, from its pose before it.
export function pathOf(map, [x, y, yaw], direction, stop, turned, samples = PATH_SAMPLES) {
  const first = Math.min(map.from, stop);
  return Array.from({ length: samples }, (_, k) => {
    map.at(direction - turned, share(first, stop, k / (samples - 1)), EFFECT);
    const [dx, dy] = rotated(EFFECT, direction);
    return [x + dx, y + dy, yaw + EFFECT[2]];
  });
}

// Where the middle of the hand is at a phase, ahead of the object's place before the action.
export function handAt(hand, phase) {
  const at = between(0, phase, 1) * (hand.along.length - 1);
  const k = Math.min(Math.floor(at), hand.along.length - 2);
  const value = (values) => share(values[k], values[k + 1], at - k);
  return { along: value(hand.along), gap: value(hand.gap) };
}

// problem: {object: {map, outline, hand, yaw (of the object in the map's image)}, pose [x, y, yaw],
// goal [x, y], tolerance, most (actions), partial (may stop early), risk (weight of the variance),
// obstacles, reachable, table [x0, x1, y0, y1], previous (a chain), quick (a smaller search)}.
export function plan(query) {
  const problem = query.obstacles?.length ? { ...query, space: spaceOf(query) } : query;
  const { object, pose, goal, most = 3, tolerance = 0.02 } = problem;
  const target = [goal[0] - pose[0], goal[1] - pose[1]];
  const far = Math.hypot(...target);
  const fewest = Math.max(1, Math.ceil(far / Math.max(object.map.reach, 1e-4)));
  let best = null;
  for (let n = Math.min(fewest, most); n <= most && far > 1e-4; n++) {
    const found = bestChain(problem, target, n);
    if (found && !(best?.cost <= found.cost)) best = found;
    if (best && n > fewest && best.distance < tolerance) break;
  }
  const chain = best && best.distance < far ? best.chain : [];
  const steps = stepsOf(problem, chain);
  const distance = chain.length ? best.distance : far;
  return { chain, steps, distance, reached: distance <= tolerance };
}

export function stepsOf({ object, pose }, chain) {
  const yaw = pose[2] - (object.yaw ?? 0);
  const poses = rollOut(object.map, chain, yaw, true);
  let [from, turned] = [pose, yaw];
  return poses.map(([x, y, turn, trace], k) => {
    const [direction, stop] = [chain[2 * k], chain[2 * k + 1]];
    const path = pathOf(object.map, from, direction, stop, turned);
    const step = { direction, stop, from, path, std: Math.sqrt(trace) };
    [from, turned] = [[pose[0] + x, pose[1] + y, pose[2] + turn - yaw], turn];
    return { ...step, end: from };
  });
}

// Numbers in [0, 1) that fill it evenly.
function halton(i, base) {
  let [value, part] = [0, 1];
  for (let k = i; k > 0; k = Math.floor(k / base)) value += (part /= base) * (k % base);
  return value;
}

function startsOf({ object, pose, partial = true, obstacles = [], quick }, target, n) {
  const yaw = pose[2] - (object.yaw ?? 0);
  const bearing = Math.atan2(target[1], target[0]);
  const starts = [];
  for (let i = 1; i <= (obstacles.length && !quick ? 3 : 1) * STARTS; i++) {
    const spread = obstacles.length && i % 2 ? Math.PI : SPREAD; // half of them make a detour
    const chain = [];
    for (let k = 0; k < n - 1; k++) {
      const phase = partial ? 0.5 + 0.5 * halton(i, [3, 7][k % 2]) : 1;
      chain.push(bearing + spread * (2 * halton(i, [2, 5][k % 2]) - 1), phase);
    }
    const [x, y, turn] = endOf(object.map, chain, yaw);
    // A single action begins around the one that ends nearest.
    const off = n > 1 ? [0, 0] : [0.02 * (halton(i, 2) - 0.5), 0.02 * (halton(i, 3) - 0.5)];
    const left = rotated([target[0] - x + off[0], target[1] - y + off[1]], -turn);
    const [direction, phase] = object.map.nearest(...left, partial);
    starts.push([...chain, direction + turn, phase]);
  }
  return starts;
}

function bestChain(problem, target, n) {
  const { object, pose, partial = true, risk = 10, previous } = problem;
  const yaw = pose[2] - (object.yaw ?? 0);
  const weighed = (chain) => {
    const [x, y, , trace] = rollOut(object.map, chain, yaw, true).at(-1);
    const distance = Math.hypot(target[0] - x, target[1] - y);
    const cost = distance + Math.sqrt(distance ** 2 + risk * trace) + ACTION_COST * n;
    return { chain, distance, cost };
  };
  const sorted = (chains) => chains.map(weighed).sort((a, b) => a.cost - b.cost);
  const few = [];
  for (const start of sorted(startsOf(problem, target, n))) {
    if (few.length < REFINED && isAllowed(problem, start.chain)) few.push(start);
  }
  const corrected = few.map(({ chain }) => correct(object.map, target, chain, yaw, partial));
  const options = sorted([...few.map(({ chain }) => chain), ...corrected]);
  if (previous?.length === 2 * n && (partial || previous.every((v, k) => k % 2 === 0 || v === 1))) {
    const kept = weighed(correct(object.map, target, previous, yaw, partial));
    options.push({ ...kept, cost: kept.cost - LOYALTY });
    options.sort((a, b) => a.cost - b.cost);
  }
  const best = options.find(({ chain }) => isAllowed(problem, chain));
  if (!best || best.distance < NEAR_ENOUGH) return best;
  const again = options.slice(0, REFINED).map(({ chain }) => correct(object.map, target, chain, yaw, partial, 40));
  return sorted([best.chain, ...again]).find(({ chain }) => isAllowed(problem, chain));
}

// Newton's method on the end of a chain; of all solutions the smallest change.
export function correct(map, target, start, yaw, partial, rounds = CORRECTIONS) {
  let chain = start;
  const off = (other) => {
    const [x, y] = endOf(map, other, yaw);
    return [target[0] - x, target[1] - y];
  };
  let left = off(chain);
  for (let round = 0; round < rounds && Math.hypot(...left) > 1e-5; round++) {
    const columns = chain.map((value, k) => {
      if (k % 2 && !partial) return [0, 0];
      const h = k % 2 ? -1e-6 : 1e-6; // a phase of 1 cannot grow
      const moved = off(chain.with(k, value + h));
      const scale = k % 2 ? 0.5 : 1; // half the phase moves the end about as far as a radian
      const slope = [((left[0] - moved[0]) / h) * scale, ((left[1] - moved[1]) / h) * scale];
      const blocked = k % 2 && value >= 1 && slope[0] * left[0] + slope[1] * left[1] > 0;
      return blocked ? [0, 0] : slope;
    });
    let [a, b, d] = [1e-8, 0, 1e-8];
    for (const [u, v] of columns) [a, b, d] = [a + u * u, b + u * v, d + v * v];
    const det = a * d - b * b;
    const [p, q] = [(d * left[0] - b * left[1]) / det, (a * left[1] - b * left[0]) / det];
    let step = columns.map(([u, v], k) => (u * p + v * q) * (k % 2 ? 0.5 : 1));
    const longest = Math.max(...step.map(Math.abs));
    step = step.map((value) => value * Math.min(1, 0.3 / Math.max(longest, 1e-9)));
    let better = null;
    for (let half = 0; half < 4 && !better; half++, step = step.map((value) => value / 2)) {
      const tried = chain.map((value, k) => (k % 2 ? between(0, value + step[k], 1) : value + step[k]));
      const after = off(tried);
      if (Math.hypot(...after) < Math.hypot(...left)) better = [tried, after];
    }
    if (!better) break;
    [chain, left] = better;
  }
  return chain;
}

// Whether the arm can reach all actions, the object stays on the table and meets no obstacle.
function isAllowed({ object, pose, reachable, table, space }, chain) {
  const yaw = pose[2] - (object.yaw ?? 0);
  let [from, turned] = [pose, yaw];
  return rollOut(object.map, chain, yaw).every(([x, y, turn], k) => {
    const [direction, stop] = [chain[2 * k], chain[2 * k + 1]];
    const to = [pose[0] + x, pose[1] + y, pose[2] + turn - yaw];
    if (reachable && !reachable(from[0], from[1], direction)) return false;
    if (table) {
      const radius = Math.max(...object.outline.map((corner) => Math.hypot(...corner)));
      const [x0, x1, y0, y1] = table;
      if (to[0] < x0 + radius || to[0] > x1 - radius) return false;
      if (to[1] < y0 + radius || to[1] > y1 - radius) return false;
    }
    if (space && spare({ object, pose, space }, from, direction, stop, turned) < 0) return false;
    [from, turned] = [to, turn];
    return true;
  });
}

// From here on: the drawing.

const STAR = [...Array(10)].map((_, k) => {
  const radius = k % 2 ? 0.4 : 1;
  return [radius * Math.sin((k * Math.PI) / 5), radius * Math.cos((k * Math.PI) / 5)];
});
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const AROUND = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]];
const APPROACH = 0.45; // seconds that the hand takes to come down, and to leave
const LETTER = 7.5; // width of a letter of a label [px]

const moves = ({ direction }) => direction !== null;
const still = () => window.matchMedia("(prefers-reduced-motion: reduce)").matches;
const escaped = (text) =>
  String(text).replace(/[&<>"']/g, (letter) => `&#${letter.charCodeAt(0)};`);

const BOX = [[-0.025, -0.02], [0.025, -0.02], [0.025, 0.02], [-0.025, 0.02]];
const middleOf = ({ corners }) => [0, 1].map((axis) => corners.reduce((sum, at) => sum + at[axis], 0) / corners.length);
const shifted = (one, by) => ({ ...one, corners: one.corners.map((at) => at.map((v, axis) => v + by[axis])) });
const sizeKnob = (one) => cornersOf(one).reduce((best, at) => (at[0] + at[1] > best[0] + best[1] ? at : best));

function resized(one, by) {
  if (one.radius) return { ...one, radius: between(0.006, one.radius * by, 0.12) };
  const middle = middleOf(one);
  return { ...one, corners: one.corners.map((at) => at.map((v, axis) => middle[axis] + (v - middle[axis]) * by)) };
}

function shape(tag, css, attributes, inside = "") {
  const said = Object.entries(attributes).map(([name, value]) => ` ${name}="${escaped(value)}"`);
  return `<${tag} class="${css}"${said.join("")}>${inside}</${tag}>`;
}

// state: {object, pose, goal {xy, yaw, tolerance}, steps, other (steps to compare with), obstacles, ring, trail, marks (what moved by
// itself: [from, to]), sigma, swept, note (text in a corner), movable (object and obstacles can be
// moved), live (pose, hand and lift that are shown instead)}.
// heard: {goal(xy, final), pose(pose, final), obstacles(all, final), press(key)}.
export class Table {
  constructor(el, heard) {
    this.heard = heard;
    this.state = { pose: [0, 0, 0], goal: { xy: [0, 0], tolerance: 0.02 }, steps: [], obstacles: [] };
    this.camera = null; // [x, y, half of the shown height]
    this.held = this.tapped = this.clock = this.chosen = null;
    this.grip = [0, 0]; // from the pointer to the middle of what it holds
    this.svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    this.svg.setAttribute("role", "application");
    this.svg.setAttribute("tabindex", 0);
    el.classList.add("affordlib-table");
    el.dataset.lmSuppressShortcuts = "true"; // JupyterLab's own, while this has the focus
    el.append(this.svg);
    if (heard.obstacles) el.append(this.tools());
    const listen = (name, act) => this.svg.addEventListener(name, act.bind(this));
    listen("pointerdown", this.pressed);
    listen("pointermove", this.moved);
    listen("pointerup", (event) => this.released(event, false));
    listen("pointercancel", (event) => this.released(event, true));
    listen("keydown", this.typed);
    this.watch = new ResizeObserver(() => this.draw());
    this.watch.observe(this.svg);
  }

  // Buttons that add, change and remove obstacles, for mouse, touch and keyboard.
  tools() {
    const row = document.createElement("div");
    row.className = "tools";
    const [disc, box] = [{ corners: [[0, 0]], radius: 0.02 }, { corners: BOX, radius: 0 }];
    const names = { "+ disc": () => this.add(disc), "+ box": () => this.add(box), larger: () => this.resize(1.2),
      smaller: () => this.resize(1 / 1.2), remove: () => this.change(this.chosen, null) };
    for (const [name, act] of Object.entries(names)) {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: name, onclick: act });
      button.setAttribute("aria-label", `obstacle: ${name}`);
      row.append(button);
    }
    return row;
  }

  add({ corners, radius }) {
    const { obstacles, pose, goal } = this.state;
    const [x, y] = [0, 1].map((axis) => (pose[axis] + goal.xy[axis]) / 2);
    const [row, side] = [Math.floor(obstacles.length / 2), obstacles.length % 2 ? -1 : 1];
    const ahead = Math.atan2(goal.xy[1] - pose[1], goal.xy[0] - pose[0]);
    const aside = rotated([0.06 * row, 0.09 * side], ahead);
    const one = shifted({ corners, radius, height: 0.06 }, [x + aside[0], y + aside[1]]);
    this.chosen = obstacles.length;
    this.heard.obstacles([...obstacles, one], true);
  }

  resize(by) {
    const one = this.state.obstacles[this.chosen];
    if (one) this.change(this.chosen, resized(one, by));
  }

  // Replace an obstacle, or remove it.
  change(k, one, final = true) {
    const all = [...this.state.obstacles];
    if (!all[k]) return;
    all.splice(k, 1, ...(one ? [one] : []));
    if (!one) this.chosen = null;
    this.heard.obstacles(all, final);
  }

  set(changes) {
    Object.assign(this.state, changes);
    if (changes.steps || changes.pose) this.clock = null;
    this.frame();
  }

  // Let the view follow what is to be seen; a hand that drags moves it only outwards.
  frame() {
    const { pose, goal, steps, object, obstacles, trail = [] } = this.state;
    if (!object) return;
    const radius = Math.max(...object.outline.map((corner) => Math.hypot(...corner)));
    const seen = [pose, goal.xy, ...trail, ...obstacles.flatMap(cornersOf), ...steps.flatMap(({ from, end, direction }) => {
      const [dx, dy] = rotated([-0.07, 0], direction ?? 0);
      return [end, [from[0] + dx, from[1] + dy]];
    })];
    const [xs, ys] = [0, 1].map((axis) => seen.map((point) => point[axis]));
    const room = this.held ? 0.015 : radius + 0.035;
    let box = [Math.min(...xs) - room, Math.max(...xs) + room, Math.min(...ys) - room, Math.max(...ys) + room];
    if (this.held && this.camera) {
      const [x, y, half] = this.camera;
      const [width, height] = this.size();
      const [w, h] = [(half * width) / height, half];
      if (box[0] > x - w && box[1] < x + w && box[2] > y - h && box[3] < y + h) return this.draw();
      box = [Math.min(box[0], x - w), Math.max(box[1], x + w), Math.min(box[2], y - h), Math.max(box[3], y + h)];
    }
    const [width, height] = this.size();
    const tall = Math.max(box[3] - box[2], ((box[1] - box[0]) * height) / width) / 2;
    const half = between(0.13, tall, EXTENT);
    const wanted = [(box[0] + box[1]) / 2, (box[2] + box[3]) / 2].map((v) => between(half - EXTENT, v, EXTENT - half));
    this.glide([...wanted, half]);
  }

  glide(wanted) {
    cancelAnimationFrame(this.gliding);
    const from = this.camera;
    if (!from || still()) {
      this.camera = wanted;
      return this.draw();
    }
    const began = performance.now();
    const step = (now) => {
      const t = between(0, (now - began) / 250, 1);
      const eased = 1 - (1 - t) ** 3;
      this.camera = from.map((value, k) => share(value, wanted[k], eased));
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

  place(event) {
    const box = this.svg.getBoundingClientRect();
    const [width, height] = this.size();
    const [cx, cy] = this.camera;
    return [
      cx + (event.clientX - box.left - this.svg.clientLeft - width / 2) / this.scale,
      cy - (event.clientY - box.top - this.svg.clientTop - height / 2) / this.scale,
    ];
  }

  // The object's pose and the hand at a time of the execution as it is predicted.
  moment(time) {
    const { steps, object } = this.state;
    let left = time;
    for (const [k, { direction, stop, from, path }] of steps.entries()) {
      const begins = Math.min(0.9 * object.map.from, stop);
      const seconds = (stop - begins) * object.seconds;
      if (left < seconds + 2 * APPROACH || k === steps.length - 1) {
        const phase = begins + (stop - begins) * between(0, (left - APPROACH) / seconds, 1);
        const first = Math.min(object.map.from, stop);
        const at = between(0, (phase - first) / (stop - first || 1), 1) * (path.length - 1);
        const [a, b] = [path[Math.floor(at)], path[Math.ceil(at)]];
        const pose = a.map((value, axis) => share(value, b[axis], at % 1));
        const near = between(0, Math.min(left, seconds + 2 * APPROACH - left) / APPROACH, 1);
        return { pose, hand: { ...handAt(object.hand, phase), direction, from, near }, k };
      }
      left -= seconds + 2 * APPROACH;
    }
    return null;
  }

  // A moment of a motion as it was simulated: rows of [x, y, yaw, lift, hand's x, y, z, yaw, gap,
  // bodies in 3-D]. Returns it.
  replay(rows, place) {
    place = between(0, place, rows.length - 1); // a frame's time may lie before the start
    const k = Math.floor(place);
    const next = rows[Math.min(k + 1, rows.length - 1)];
    const now = rows[k].map((value, axis) => share(value, next[axis], place - k));
    const [x, y, yaw, lift, ...tool] = now;
    const near = between(0, 1.1 - 8 * tool[2], 1);
    const hand = { along: 0, gap: tool[4], direction: rows[k][7], from: tool, near };
    this.state.live = { pose: [x, y, yaw], lift, hand };
    this.state.trail = rows.slice(0, k + 1);
    this.draw();
    return now;
  }

  // Show a planner's search, lines and single points, in the order in which it went.
  search(searched) {
    const began = performance.now();
    const step = (now) => {
      this.grown = still() ? 1 : between(0, (now - began) / GROWS, 1);
      this.set({ searched });
      if (this.grown < 1) this.growing = requestAnimationFrame(step);
    };
    cancelAnimationFrame(this.growing);
    step(began);
  }

  tried() {
    let left = Math.ceil(this.grown * this.state.searched.flat().length);
    const seen = this.state.searched.map((line) => line.slice(0, Math.max(0, (left -= line.length) + line.length)));
    const d = seen.filter((line) => line.length).map((line) => `M${this.points(line).replaceAll(" ", "L")}${line[1] ? "" : "h0"}`);
    return shape("path", "tried", { d: d.join("") });
  }

  get seconds() {
    const { steps, object } = this.state;
    const each = steps.map(({ stop }) => Math.max(0, stop - Math.min(0.9 * object.map.from, stop)) * object.seconds);
    return each.reduce((sum, value) => sum + value + 2 * APPROACH, 0);
  }

  points(corners) {
    return corners.map((corner) => this.at(corner).map((v) => v.toFixed(1)).join()).join(" ");
  }

  outline(pose, css, more = {}, size = 1) {
    const corners = this.state.object.outline.map((corner) => corner.map((value) => size * value));
    return shape("polygon", css, { points: this.points(placed(corners, pose)), ...more });
  }

  disc([x, y], css, radius, more = {}) {
    const [cx, cy] = this.at([x, y]).map((v) => v.toFixed(1));
    return shape("circle", css, { cx, cy, r: (radius * this.scale).toFixed(1), ...more });
  }

  line(points, css) {
    return shape("polyline", css, { points: this.points(points) });
  }

  draw() {
    const { state, scale } = { state: this.state, scale: this.camera ? this.scale : 1 };
    if (!state.object || !this.camera) return;
    const { pose, goal, steps, obstacles, trail, marks = [], sigma, swept, movable, object, other } = state;
    const [width, height] = this.size();
    const now = state.live ?? (this.clock === null ? null : this.moment(this.clock));
    const end = steps.at(-1)?.end ?? pose;
    const shapes = [this.ground()];
    obstacles.forEach((one, k) => {
      const css = k === this.chosen ? "obstacle chosen" : "obstacle";
      shapes.push(shape("polygon", css, { points: this.points(cornersOf(one)), "data-handle": `obstacle ${k}` }));
      if (k === this.chosen) shapes.push(this.disc(sizeKnob(one), "grip", 0.012, { "data-handle": `size ${k}` }));
      if (k === this.chosen) shapes.push(this.disc(sizeKnob(one), "turner", 0.004, { "data-handle": `size ${k}` }));
    });
    if (swept && steps.length) {
      const all = steps.flatMap(({ path }) => path.map((at) => `M${this.points(placed(object.outline, at))}Z`));
      shapes.push(shape("path", "swept", { d: all.join("") }));
    }
    if (state.searched?.length && !state.live) shapes.push(this.tried());
    for (const step of other ?? []) shapes.push(this.line(step.path, "other"), this.outline(step.end, "other"));
    for (const mark of marks) shapes.push(this.line(mark, "mark"));
    steps.forEach((step, k) => {
      if (sigma && step.std) shapes.push(this.disc(step.end, "sigma", ENLARGED * step.std));
      shapes.push(this.line(step.path, "prediction"));
      shapes.push(this.outline(step.end, k === steps.length - 1 ? "predicted" : "ghost"));
    });
    if (trail?.length) shapes.push(this.line(trail, "truth"));
    const short = Math.hypot(end[0] - goal.xy[0], end[1] - goal.xy[1]);
    const missed = short > goal.tolerance && !this.state.planning;
    if (missed) shapes.push(this.line([end, goal.xy], "short"));
    const standing = now?.pose ?? pose;
    const lifted = now?.lift > 0.003 ? now.lift : 0;
    shapes.push(this.outline(standing, lifted ? "object lifted" : "object", { "data-handle": movable ? "object" : "none" }, 1 + 3 * lifted));
    shapes.push(this.line([standing, this.ahead(standing, 0.5)], "heading"), this.goal(end, missed));
    if (movable && !now) shapes.push(this.knob(pose));
    if (now) shapes.push(this.hand(now.hand));
    else if (steps.length && !this.held) shapes.push(...steps.filter(moves).map((step) => this.arrow(step)));
    shapes.push(shape("g", "labels", {}, this.labels(missed ? short : 0)));
    shapes.push(this.ruler(width, height, scale));
    this.svg.innerHTML = shapes.join("");
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const said = [...goal.xy, pose[0], pose[1]].map((value) => (100 * value).toFixed(1));
    this.svg.setAttribute(
      "aria-label",
      `Table from above. The goal is at x = ${said[0]}, y = ${said[1]} cm, the object at x = ${said[2]}, ` +
        `y = ${said[3]} cm. Arrow keys move the goal by 1 cm, with Shift by 1 mm; Enter runs the plan, ` +
        "Escape stops it. An obstacle that is chosen is moved by the arrow keys, resized by + and -, removed by Delete.",
    );
    Object.assign(this.svg.dataset, { view: this.camera.map((v) => v.toFixed(5)).join(" ") });
  }

  ground() {
    const { ring } = this.state;
    const shapes = [];
    if (ring) {
      const [x, inner, outer] = ring;
      const rims = [outer, inner].map((r) => this.disc([x, 0], r === inner ? "reach inner" : "reach", r));
      shapes.push(...rims);
    }
    const [cx, cy, half] = this.camera;
    const [width, height] = this.size();
    const [w, step] = [(half * width) / height, 0.05];
    for (let x = Math.ceil((cx - w) / step) * step; x < cx + w; x += step) {
      for (let y = Math.ceil((cy - half) / step) * step; y < cy + half; y += step) {
        const [u, v] = this.at([x, y]);
        shapes.push(shape("circle", "dot", { cx: u.toFixed(1), cy: v.toFixed(1), r: 1 }));
      }
    }
    return shapes.join("");
  }

  goal(end, missed) {
    const { goal } = this.state;
    const [u, v] = this.at(goal.xy);
    const yaw = goal.yaw ?? end[2];
    const size = between(9, 0.012 * this.scale, 15);
    const star = STAR.map(([x, y]) => `${(u + size * x).toFixed(1)},${(v - size * y).toFixed(1)}`);
    return shape("g", "wanted", { "data-handle": "goal" }, [
      shape("circle", "grip", { cx: u, cy: v, r: 28 }),
      this.outline([...goal.xy, yaw], goal.yaw == null ? "place" : "place turned"),
      this.disc(goal.xy, "tolerance", goal.tolerance),
      shape("polygon", missed ? "goal missed" : "goal", { points: star.join(" ") }),
    ].join(""));
  }

  ahead(pose, part) {
    const long = part * Math.max(...this.state.object.outline.map((corner) => Math.hypot(...corner)));
    const [dx, dy] = rotated([long, 0], pose[2]);
    return [pose[0] + dx, pose[1] + dy];
  }

  knob(pose) {
    const [a, b] = [this.at(pose), this.at(this.ahead(pose, 1.25))];
    const more = 10 / Math.hypot(b[0] - a[0], b[1] - a[1]);
    const [x, y] = b.map((value, k) => (value + (value - a[k]) * more).toFixed(1));
    return shape("g", "knob", { "data-handle": "yaw" },
      shape("circle", "grip", { cx: x, cy: y, r: 22 }) + shape("circle", "turner", { cx: x, cy: y, r: 6 }));
  }

  hand({ along, gap, direction, from, near }) {
    const wide = Math.max(gap / 2, 0.006);
    const [x, y] = this.at([from[0] + along * Math.cos(direction), from[1] + along * Math.sin(direction)]);
    const s = this.scale * share(1.25, 1, near);
    const finger = (side) => shape("rect", "finger", {
      x: -0.022 * s, y: (side * wide - 0.009) * s, width: 0.022 * s, height: 0.018 * s, rx: 0.004 * s });
    const palm = shape("rect", "palm", {
      x: -0.05 * s, y: -(wide + 0.02) * s, width: 0.032 * s, height: 2 * (wide + 0.02) * s, rx: 0.008 * s });
    const turn = `translate(${x} ${y}) rotate(${(-direction * 360) / TURN})`;
    return shape("g", "hand", { transform: turn, opacity: near.toFixed(2) }, palm + finger(-1) + finger(1));
  }

  // Where an action begins to push, outside the object.
  arrow({ direction, from }) {
    const turned = this.state.object.outline.map((corner) => rotated(corner, from[2] - direction)[0]);
    const [x, y] = this.at(from);
    const back = -Math.min(...turned) * this.scale + 4;
    const turn = `translate(${x} ${y}) rotate(${(-direction * 360) / TURN})`;
    const line = shape("path", "push", { d: `M${-back - 34} 0H${-back - 9}` });
    return shape("g", "arrow", { transform: turn }, line + shape("path", "push-head", { d: `M${-back} 0l-12 6v-12z` }));
  }

  labels(short) {
    const { steps, goal, pose, object, sigma } = this.state;
    const taken = [...placed(object.outline, pose), ...this.state.obstacles.flatMap(cornersOf)].map((at) => [...this.at(at), 6]);
    if (this.state.movable) taken.push([...this.at(this.ahead(pose, 1.5)), 14]);
    taken.push([...this.at(goal.xy), Math.max(18, goal.tolerance * this.scale)], [...this.at(pose), 14]);
    for (const { path, end, from, direction } of steps) {
      for (const at of [...path, ...placed(object.outline, end)]) taken.push([...this.at(at), 5]);
      for (const back of direction === null ? [] : [-0.05, -0.07, -0.09]) {
        const [dx, dy] = rotated([back, 0], direction);
        taken.push([...this.at([from[0] + dx, from[1] + dy]), 8]);
      }
    }
    const texts = steps.map(({ stop, end, name }, k) =>
      [`${k + 1}: ${name ? `${name} to ` : ""}${Math.round(100 * stop)} %`, end, "step"]);
    const last = steps.at(-1);
    if (short) texts.push([`${(100 * short).toFixed(short < 0.01 ? 1 : 0)} cm short`, goal.xy, "step short-by"]);
    if (sigma && last?.std) {
      texts.push([`σ ${(1000 * last.std).toFixed(1)} mm (× ${ENLARGED})`, last.end, "step small"]);
    }
    return texts.map(([text, at, css]) => this.label(text, this.at(at), css, taken)).join("");
  }

  label(text, [u, v], css, taken) {
    const [width, height] = this.size();
    const [w, h] = [(LETTER * text.length + 14) / 2, 11];
    let [best, room] = [null, -Infinity];
    for (const gap of [12, 28, 48, 75, 110]) {
      for (const [i, j] of AROUND) {
        const x = between(w + 3, u + i * (w + gap), width - w - 3);
        const y = between(h + 3, v + j * (h + gap), height - h - 3);
        const away = Math.min(...taken.map(([a, b, r]) =>
          Math.hypot(Math.max(Math.abs(a - x) - w, 0), Math.max(Math.abs(b - y) - h, 0)) - r));
        if (Math.min(away, 3) > room) [best, room] = [[x, y], Math.min(away, 3)];
      }
    }
    const [x, y] = best;
    for (let dx = -w; dx <= w; dx += h) taken.push([x + dx, y, h]);
    const rim = [between(x - w, u, x + w), between(y - h, v, y + h)];
    const leader = Math.hypot(rim[0] - u, rim[1] - v) > 45
      ? shape("path", "leader", { d: `M${rim.join(" ")}L${u} ${v}` }) : "";
    const plate = shape("rect", "plate", { x: x - w, y: y - h, width: 2 * w, height: 2 * h, rx: h });
    return leader + shape("g", css, {}, plate + shape("text", "", { x, y: y + 4.5 }, escaped(text)));
  }

  ruler(width, height, scale) {
    const cm = [10, 5, 2].find((value) => (value / 100) * scale < width / 3) ?? 2;
    const long = (cm / 100) * scale;
    const d = `M12 ${height - 20}v6h${long.toFixed(1)}v-6`;
    const note = shape("text", "note", { x: width - 12, y: 22 }, escaped(this.state.note ?? ""));
    return shape("path", "ruler", { d }) + note +
      shape("text", "tick", { x: 12 + long / 2, y: height - 22 }, `${cm} cm`);
  }

  // What a pointer grabs. By touch only what is marked, since a swipe elsewhere scrolls the page.
  pressed(event) {
    if (event.button || !this.camera) return;
    const at = this.place(event); // before focusing, which may scroll the drawing into view
    const name = event.target.closest("[data-handle]")?.dataset.handle ?? "none";
    this.tapped = event.pointerType === "touch" && name === "none";
    if (this.tapped) return;
    this.held = name === "none" ? "goal" : name;
    const { pose, obstacles } = this.state;
    const [kind, number] = this.held.split(" ");
    this.chosen = number ? Number(number) : null;
    const middle = { object: pose, obstacle: number && middleOf(obstacles[number]) }[kind];
    this.grip = middle ? [middle[0] - at[0], middle[1] - at[1]] : [0, 0];
    this.clock = null;
    this.svg.setPointerCapture(event.pointerId);
    this.svg.classList.add("by-pointer"); // focused so, it needs no frame
    this.svg.focus({ preventScroll: true });
    event.preventDefault();
    this.move(at, false);
  }

  moved(event) {
    if (this.held) this.move(this.place(event), false);
  }

  released(event, cancelled) {
    const { held, tapped } = this;
    this.held = this.tapped = null;
    if (cancelled) return;
    this.held = tapped ? "goal" : held;
    if (this.held) this.move(tapped ? this.place(event) : this.last, true); // the view may have moved
    this.held = null;
    this.frame();
  }

  move(at, final) {
    this.last = at;
    const { pose, goal, obstacles } = this.state;
    const [x, y] = at.map((value, k) => between(-LIMIT, value + this.grip[k], LIMIT));
    const [name, k] = this.held.split(" ");
    if (name === "goal") {
      const xy = [x, y].map((value) => Math.round(1000 * value) / 1000);
      if (!final && xy[0] === goal.xy[0] && xy[1] === goal.xy[1]) return;
      this.heard.goal?.(xy, final);
    } else if (name === "object") this.heard.pose?.([x, y, pose[2]], final);
    else if (name === "yaw") this.heard.pose?.([pose[0], pose[1], Math.atan2(at[1] - pose[1], at[0] - pose[0])], final);
    else {
      const [one, [u, v]] = [obstacles[k], middleOf(obstacles[k])];
      const far = ([x, y]) => Math.hypot(x - u, y - v);
      const by = name === "size" ? far([x, y]) / far(sizeKnob(one)) : 1;
      this.change(Number(k), by === 1 ? shifted(one, [x - u, y - v]) : resized(one, by), final);
    }
  }

  typed(event) {
    this.svg.classList.remove("by-pointer");
    const { goal, pose, movable } = this.state;
    const step = event.shiftKey ? 0.001 : 0.01;
    const one = this.state.obstacles[this.chosen];
    if (one && event.key in KEYS) this.change(this.chosen, shifted(one, KEYS[event.key].map((way) => way * step)));
    else if (one && event.key === "Delete") this.change(this.chosen, null);
    else if (one && "+-".includes(event.key)) this.resize(event.key === "+" ? 1.2 : 1 / 1.2);
    else if (one && event.key === "Escape") {
      this.chosen = null;
      this.draw();
    } else if (event.key in KEYS) {
      const xy = KEYS[event.key].map((way, k) => between(-LIMIT, goal.xy[k] + way * step, LIMIT));
      this.heard.goal?.(xy.map((value) => Math.round(1000 * value) / 1000), true);
    } else if (movable && (event.key === "q" || event.key === "e")) {
      this.heard.pose?.([pose[0], pose[1], pose[2] + (event.key === "q" ? 1 : -1) * 0.0873], true);
    } else if (event.key === "Enter" || event.key === "Escape") this.heard.press?.(event.key);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  destroy() {
    this.watch.disconnect();
    cancelAnimationFrame(this.gliding);
    cancelAnimationFrame(this.growing);
  }
}

// A view of Python's widget: while a hand drags, the browser plans; when it lets go, Python does.
// Move the bodies of a scene in 3-D, if the page has it: [its name, their numbers].
function move([name, numbers], row) { // [] where no view in 3-D is shown
  const scene = globalThis.affordlib?.[name];
  const shown = scene?.getWorld().K3DObjects.children ?? [];
  for (const body of shown) {
    const k = numbers.indexOf(body.K3DIdentifier);
    if (k < 0) continue;
    const [x, y, z, ...turn] = row.slice(9 + 7 * k, 16 + 7 * k);
    body.position.set(x, y, z);
    body.quaternion.fromArray(turn).normalize();
  }
  scene?.render();
}

function render({ model, el }) {
  let [number, chain, item, reachable, recorded, bodies, began, timer] = [0, [], null, null, [], [], 0, null];
  const scrub = document.createElement("input");
  Object.assign(scrub, { type: "range", min: 0, max: 1, step: "any", hidden: true });
  scrub.setAttribute("aria-label", "Time of the last run");

  function draft(xy, obstacles = view.state.obstacles) {
    const { pose, goal, running } = model.get("scene");
    if (running || !item?.map) return view.state.steps;
    const { table } = model.get("table");
    const query = { object: item, pose, goal: xy, tolerance: goal.tolerance, reachable, table, obstacles };
    const planned = plan({ ...query, previous: chain, quick: true });
    chain = planned.chain;
    return planned.steps;
  }

  const view = new Table(el, {
    goal(xy, final) {
      number = Math.max(number, model.get("wanted")[2]) + 1;
      view.svg.dataset.query = number;
      Object.assign(view.svg.dataset, { draft: true });
      view.set({ goal: { ...view.state.goal, xy }, steps: draft(xy), searched: [] });
      if (!final) return;
      model.set("wanted", [...xy, number]);
      model.save_changes(); // ipywidgets sends the next one when this one has been processed
    },
    obstacles(all, final) {
      const steps = draft(view.state.goal.xy, all);
      view.set({ obstacles: all, steps });
      if (!final) return;
      model.set("obstacles", all);
      model.save_changes();
    },
    press: (key) => model.send({ press: key === "Enter" ? "run" : "stop" }),
  });
  el.append(scrub);

  function look() {
    const { map, ...about } = model.get("object");
    item = { ...about, map: map && new EffectMap(map) };
    const { reach, ring, seconds } = model.get("table");
    reachable = reach && map ? reachability(reach, map.primitive) : null;
    chain = [];
    view.set({ object: { ...item, seconds }, ring });
  }

  function show() {
    const { answered, running, planning, ...scene } = model.get("scene");
    if (!scene.goal) return;
    const late = answered < number || view.held; // the hand is ahead of Python
    if (late) Object.assign(scene, { goal: { ...scene.goal, xy: view.state.goal.xy }, steps: view.state.steps });
    else chain = [];
    Object.assign(view.svg.dataset, { answered, planning, draft: Boolean(late) });
    view.svg.setAttribute("aria-busy", planning);
    if (!running && !timer) scene.live = null;
    if (!view.held) scene.obstacles = model.get("obstacles");
    view.set({ ...scene, planning, sigma: true, swept: true, note: planning ? "planning …" : "" });
  }

  function at(place) {
    scrub.value = place / Math.max(recorded.length - 1, 1);
    move(bodies, view.replay(recorded, place));
  }

  function heard({ motions, first, bodies: others }) {
    if (first) [recorded, began, bodies] = [[], performance.now(), others];
    recorded.push(...motions);
    scrub.hidden = false;
    if (timer) return;
    const frame = (now) => {
      const last = recorded.length - 1;
      // A frame's time may lie a little before the message's.
      const place = still() ? last : between(0, (now - began) / (1000 * model.get("scene").pace), last);
      at(place);
      const waits = place >= last;
      if (waits) began = now - 1000 * model.get("scene").pace * last; // for what is simulated next
      timer = waits && !model.get("scene").running ? null : requestAnimationFrame(frame);
      if (!timer) show();
    };
    timer = requestAnimationFrame(frame);
  }

  scrub.addEventListener("input", () => !timer && at(Number(scrub.value) * (recorded.length - 1)));
  // Sliders beside the table have no names for screen readers.
  const nameSliders = () =>
    el.closest(".affordlib-picker")?.querySelectorAll("[role=slider]").forEach((handle) => {
      handle.ariaLabel = handle.closest(".widget-slider").querySelector(".widget-label").textContent;
    });
  const naming = new ResizeObserver(() => setTimeout(nameSliders, 500)); // after the page is complete
  naming.observe(el);
  const searched = () => view.search(model.get("searched"));
  const listeners = { "change:object": look, "change:scene": show, "change:obstacles": show,
    "change:searched": searched, "msg:custom": heard };
  for (const [name, act] of Object.entries(listeners)) model.on(name, act);
  look();
  show();
  searched();
  return () => {
    cancelAnimationFrame(timer);
    naming.disconnect();
    view.destroy();
    for (const [name, act] of Object.entries(listeners)) model.off(name, act);
  };
}

export default { render };
