// A picture with handles: points, and lines without a y, that the mouse drags along the phase.
// A drag sets `dragged` = [name, phase, number]. Until Python has drawn the figure anew a dot
// shows where the hand is.

const NEAR_PX = 30;

function render({ model, el }) {
  const box = document.createElement("div");
  const image = document.createElement("img");
  const dot = document.createElement("span");
  box.className = "affordlib-figure";
  dot.className = "affordlib-hand";
  dot.hidden = true;
  image.alt = "Drag what is marked in the figure, or move the controls above it.";
  image.draggable = false;
  box.append(image, dot);
  el.append(box);

  let held = null;
  let url = null;
  let number = 0;

  function draw() {
    const bytes = model.get("value");
    if (!bytes?.byteLength) return;
    const old = url;
    url = URL.createObjectURL(new Blob([bytes], { type: "image/png" }));
    image.onload = () => old && URL.revokeObjectURL(old);
    image.src = url;
    image.style.width = `${model.get("width")}px`;
    box.dataset.answered = model.get("dragged")[2];
  }

  // Handles are told in shares of the picture's width and height.
  function placed(event) {
    const { left, top, width, height } = image.getBoundingClientRect();
    return { x: event.clientX - left, y: event.clientY - top, width, height };
  }

  function nearest(event) {
    const { x, y, width, height } = placed(event);
    let best = null;
    let least = NEAR_PX;
    for (const handle of model.get("handles")) {
      const { top, bottom } = handle;
      const inside = y >= top * height && y <= bottom * height;
      const dy = handle.y === null ? (inside ? 0 : Infinity) : y - handle.y * height;
      const away = Math.hypot(x - handle.x * width, dy);
      if (away < least) [best, least] = [handle, away];
    }
    return best;
  }

  function follow(event) {
    const { x, y, width, height } = placed(event);
    const share = (x / width - held.left) / (held.right - held.left);
    const phase = Math.round(100 * Math.max(0, Math.min(1, share))) / 100;
    dot.hidden = false;
    dot.style.left = `${(held.left + phase * (held.right - held.left)) * width}px`;
    dot.style.top = `${held.y === null ? y : held.y * height}px`;
    if (phase === held.phase) return;
    held.phase = phase;
    number = Math.max(number, model.get("dragged")[2]) + 1;
    model.set("dragged", [held.name, phase, number]);
    model.save_changes(); // ipywidgets sends the next one when this one has been dealt with
  }

  image.addEventListener("pointerdown", (event) => {
    const handle = event.button === 0 ? nearest(event) : null;
    if (!handle) return;
    held = { ...handle, phase: null };
    image.setPointerCapture(event.pointerId);
    event.preventDefault();
    follow(event);
  });
  image.addEventListener("pointermove", (event) => {
    if (held) follow(event);
    else image.style.cursor = nearest(event) ? "ew-resize" : "default";
  });
  for (const end of ["pointerup", "pointercancel"])
    image.addEventListener(end, () => {
      held = null;
      dot.hidden = true;
    });

  model.on("change:value", draw);
  draw();
  return () => {
    model.off("change:value", draw);
    if (url) URL.revokeObjectURL(url);
  };
}

export default { render };
