// A recorded motion of the robot in 3-D, with a time line, where k3d's script is on the page.
(async function play(el, { last, height }, text) {
  if (document.readyState === "loading") await new Promise((done) => addEventListener("DOMContentLoaded", done));
  if (!globalThis.k3d || !document.createElement("canvas").getContext("webgl2")) return;
  const made = (tag, more) => Object.assign(document.createElement(tag), more);
  const box = made("div", { style: `height:${height}px;position:relative` });
  const button = made("button", { type: "button", textContent: "▶", ariaLabel: "Play", style: "width:3em" });
  const time = made("input", { type: "range", min: 0, max: last, step: "any", value: 0, ariaLabel: "Time" });
  const speed = made("select", { ariaLabel: "Speed", innerHTML: "<option value=1>1×<option value=0.5>½×" });
  const row = made("div", { style: "display:flex;gap:10px;margin:6px 0" });
  time.style.flex = "1";
  row.append(button, time, speed);
  el.replaceChildren(box, row);
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const view = await k3d.CreateK3DAndLoadBinarySnapshot(bytes, box);
  let [frame, before] = [null, 0];
  const show = (value) => view.setTime(Number((time.value = value)));
  const stop = () => {
    cancelAnimationFrame(frame);
    frame = null;
    button.textContent = "▶";
  };
  const step = (now) => {
    const next = Number(time.value) + ((now - before) / 1000) * 30 * Number(speed.value);
    before = now;
    show(Math.min(next, last));
    if (next < last) frame = requestAnimationFrame(step);
    else stop();
  };
  button.addEventListener("click", () => {
    if (frame) return stop();
    if (Number(time.value) >= last) time.value = 0;
    button.textContent = "❚❚";
    before = performance.now();
    frame = requestAnimationFrame(step);
  });
  time.addEventListener("input", () => {
    stop();
    show(time.value);
  });
})