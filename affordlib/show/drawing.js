// A picture and, over it, handles that are dragged. A drag sets `wanted` = [name, x, y, number]; the
// handle follows the pointer immediately, everything else when Python has answered.

const NEAR = 30; // largest distance from a handle at which it can be grabbed

const between = (low, value, high) => Math.max(low, Math.min(high, value));

function render({ model, el }) {
  const image = document.createElement("img");
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  image.hidden = true;
  image.alt = "";
  svg.setAttribute("role", "img");
  el.classList.add("affordlib-drawing");
  el.append(image, svg);

  let held = null; // the handle that is being dragged
  let hand = null; // the position of a moved handle, until Python has answered
  let number = 0;

  const now = (handle) => (hand?.name === handle.name ? hand : handle);

  function placeHandle(handle) {
    const ring = svg.querySelector(`[data-handle="${handle.name}"]`);
    ring?.setAttribute("transform", `translate(${now(handle).x} ${now(handle).y ?? handle.top})`);
    ring?.classList.toggle("held", held?.name === handle.name);
  }

  function draw() {
    const { inside, box, handles, answered } = model.get("scene");
    if (!box) return;
    svg.innerHTML = inside;
    svg.setAttribute("viewBox", box);
    svg.setAttribute("aria-label", model.get("label"));
    if (answered >= number) hand = null;
    handles.forEach(placeHandle);
  }

  function drawPicture() {
    image.src = model.get("picture");
    image.hidden = !model.get("picture");
  }

  function ask(handle, x) {
    const { name, left, right, step } = handle;
    x = between(left, left + step * Math.round((x - left) / step), right);
    hand = { name, x, y: handle.y };
    placeHandle(handle);
    number = Math.max(number, model.get("wanted")[3]) + 1;
    model.set("wanted", [name, x, handle.y ?? handle.top, number]);
    model.save_changes(); // ipywidgets sends the next one when this one has been processed
  }

  function pointer(event) {
    const at = new DOMPoint(event.clientX, event.clientY);
    return at.matrixTransform(svg.getScreenCTM().inverse());
  }

  function nearest({ x, y }) {
    const away = (handle) => {
      const inside = handle.top <= y && y <= handle.bottom;
      return Math.hypot(x - handle.x, handle.y === null ? (inside ? 0 : NEAR) : y - handle.y);
    };
    const [first] = [...(model.get("scene").handles ?? [])].sort((a, b) => away(a) - away(b));
    return first && away(first) < NEAR ? first : null;
  }

  function drop() {
    const handle = held;
    held = null;
    if (handle) placeHandle(handle);
  }

  svg.addEventListener("pointerdown", (event) => {
    const at = pointer(event);
    held = event.button === 0 ? nearest(at) : null;
    if (!held) return;
    svg.setPointerCapture(event.pointerId);
    ask(held, at.x);
    event.preventDefault();
  });
  svg.addEventListener("pointermove", (event) => {
    const at = pointer(event);
    if (!held) svg.style.cursor = nearest(at) ? "" : "default";
    // Browsers may send a move event without a motion, for example after a layout change.
    else if (Math.abs(at.x - now(held).x) > held.step) ask(held, at.x);
  });
  svg.addEventListener("pointerup", drop);
  svg.addEventListener("pointercancel", drop);

  // Sliders beside a drawing have no names for screen readers.
  const nameSliders = () =>
    el.closest(".affordlib-figure")?.querySelectorAll("[role=slider]").forEach((handle) => {
      handle.ariaLabel = handle.closest(".widget-slider").querySelector(".widget-label").textContent;
    });
  new ResizeObserver(() => setTimeout(nameSliders, 500)).observe(el); // after the page is complete
  const listeners = { scene: draw, picture: drawPicture };
  for (const [name, heard] of Object.entries(listeners)) model.on(`change:${name}`, heard);
  drawPicture();
  draw();
  return () => {
    for (const [name, heard] of Object.entries(listeners)) model.off(`change:${name}`, heard);
  };
}

export default { render };
