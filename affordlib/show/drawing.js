// A picture and, over it, an SVG drawing with handles that are dragged. A drag, or on a drawing with
// `keyboard` an arrow key, sets `wanted` = [name, x, y, number]; the number identifies the request.
// The handle follows the pointer immediately, everything else when Python has answered.

const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const NEAR = 30; // largest distance from a handle at which it can be grabbed

const between = (low, value, high) => Math.max(low, Math.min(high, value));

function render({ model, el }) {
  const image = document.createElement("img");
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  image.hidden = true;
  image.alt = "";
  svg.setAttribute("role", model.get("keyboard") ? "application" : "img");
  if (model.get("keyboard")) svg.setAttribute("tabindex", 0);
  // JupyterLab's own shortcuts (arrow keys move between cells) are disabled while this has focus.
  el.dataset.lmSuppressShortcuts = "true";
  el.classList.add("affordlib-drawing");
  el.append(image, svg);

  let held = null; // the handle that is being dragged
  let tapped = null; // the handle that a tap, if it is one, will move
  let hand = null; // the position of a moved handle, until Python has answered
  let number = 0;
  let playing = null;
  let timer = null;

  const now = (handle) => (hand?.name === handle.name ? hand : handle);

  function place(what, x, y, degrees = 0) {
    const at = `translate(${x} ${y}) rotate(${degrees})`;
    svg.querySelector(what)?.setAttribute("transform", at);
  }

  function placeHandle(handle) {
    const what = `[data-handle="${handle.name}"]`;
    place(what, now(handle).x, now(handle).y ?? handle.top);
    svg.querySelector(what)?.classList.toggle("held", held?.name === handle.name);
  }

  function draw() {
    const { inside, box, handles, answered, running, draft, planning } = model.get("scene");
    if (!box) return;
    svg.innerHTML = inside;
    svg.setAttribute("viewBox", box);
    svg.setAttribute("aria-label", model.get("label"));
    svg.setAttribute("aria-busy", Boolean(planning));
    Object.assign(svg.dataset, { answered, draft, planning });
    if (answered >= number) hand = null;
    handles.forEach(placeHandle);
    if (!running) playing = null;
    if (playing) show(performance.now());
  }

  function drawPicture() {
    image.src = model.get("picture");
    image.hidden = !model.get("picture");
  }

  function show(time) {
    const { poses, seconds, began } = playing;
    const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    const share = still || !seconds ? 1 : between(0, (time - began) / (1000 * seconds), 1);
    const last = Math.round(share * (poses.length - 1));
    place(".object", ...poses[last]);
    const path = poses.slice(0, last + 1).map(([x, y]) => `${x},${y}`);
    svg.querySelector(".trail").setAttribute("points", path.join(" "));
    return share < 1;
  }

  function play() {
    if (!model.get("playback").poses?.length) return;
    playing = { ...model.get("playback"), began: performance.now() };
    cancelAnimationFrame(timer);
    const frame = (time) => {
      if (playing && show(time)) timer = requestAnimationFrame(frame);
    };
    timer = requestAnimationFrame(frame);
  }

  function ask(handle, x, y) {
    const { name, left, right, top, bottom, step } = handle;
    const rounded = (value, from) => from + step * Math.round((value - from) / step);
    x = between(left, rounded(x, left), right);
    y = between(top, handle.y === null ? y : rounded(y, top), bottom);
    hand = { name, x, y };
    placeHandle(handle);
    number = Math.max(number, model.get("wanted")[3]) + 1;
    svg.dataset.asked = number;
    model.set("wanted", [name, x, y, number]);
    model.save_changes(); // ipywidgets sends the next one when this one has been processed
  }

  function pointer(event) {
    const at = new DOMPoint(event.clientX, event.clientY);
    return at.matrixTransform(svg.getScreenCTM().inverse());
  }

  function nearest({ x, y }) {
    const away = ({ anywhere, ...handle }) => {
      if (anywhere) return 0;
      const inside = handle.top <= y && y <= handle.bottom;
      return Math.hypot(x - handle.x, handle.y === null ? (inside ? 0 : NEAR) : y - handle.y);
    };
    const [first] = [...model.get("scene").handles].sort((a, b) => away(a) - away(b));
    return first && away(first) < NEAR ? first : null;
  }

  function drop() {
    const handle = held;
    held = null;
    if (handle) placeHandle(handle);
  }

  svg.addEventListener("pointerdown", (event) => {
    const at = pointer(event); // before focusing, which may scroll the drawing into view
    held = event.button === 0 ? nearest(at) : null;
    tapped = null;
    if (held?.anywhere && event.pointerType === "touch" && !event.target.closest("[data-handle]")) {
      [tapped, held] = [held, null]; // a swipe scrolls the page, a tap moves the handle
    }
    if (!held) return;
    svg.setPointerCapture(event.pointerId);
    ask(held, at.x, at.y);
    svg.focus({ preventScroll: true });
    event.preventDefault();
  });
  svg.addEventListener("pointermove", (event) => {
    const { x, y } = pointer(event);
    if (!held) svg.style.cursor = nearest({ x, y }) ? "" : "default";
    // Browsers may send a move event without a motion, for example after a layout change.
    else if (Math.abs(x - now(held).x) + Math.abs(y - now(held).y) > held.step) ask(held, x, y);
  });
  svg.addEventListener("pointerup", (event) => {
    const { x, y } = pointer(event);
    if (tapped) ask(tapped, x, y);
    tapped = null;
    drop();
  });
  svg.addEventListener("pointercancel", () => {
    tapped = null;
    drop();
  });
  svg.addEventListener("keydown", (event) => {
    if (!model.get("keyboard")) return;
    const [goal] = model.get("scene").handles;
    const steps = event.shiftKey ? 1 : 10;
    const { x, y } = now(goal);
    const [dx, dy] = (KEYS[event.key] ?? []).map((way) => way * steps * goal.step);
    if (event.key in KEYS) ask(goal, x + dx, y + dy);
    else if (event.key === "Enter") model.send({ press: "run" });
    else if (event.key === "Escape") model.send({ press: "stop" });
    else return;
    event.preventDefault();
    event.stopPropagation();
  });

  // Sliders beside a drawing have no names for screen readers.
  const nameSliders = () =>
    el.closest(".affordlib-picker, .affordlib-figure")?.querySelectorAll("[role=slider]").forEach((handle) => {
      handle.ariaLabel = handle.closest(".widget-slider").querySelector(".widget-label").textContent;
    });
  new ResizeObserver(() => setTimeout(nameSliders, 500)).observe(el); // after the page is complete
  const listeners = { scene: draw, picture: drawPicture, playback: play };
  for (const [name, heard] of Object.entries(listeners)) model.on(`change:${name}`, heard);
  drawPicture();
  draw();
  return () => {
    cancelAnimationFrame(timer);
    for (const [name, heard] of Object.entries(listeners)) model.off(`change:${name}`, heard);
  };
}

export default { render };
