// Touch, pointer and keyboard control of a camera.

const CLICK_PX = 4;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/**
 * Listens on a canvas: drag turns, shift-drag or another button pans, the wheel zooms; two fingers pan and zoom.
 *
 * @param orbit () => the Orbit to move, or null if there is none yet
 * @param on { moved(), click(event) }
 */
export function listenToPointer(canvas, orbit, on) {
  const fingers = new Map();
  let travelled = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    travelled = fingers.size > 1 ? Infinity : 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before || !orbit()) return;
    const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
    travelled += Math.abs(dx) + Math.abs(dy);
    const { height } = canvas.getBoundingClientRect();
    if (fingers.size === 2) pinch(orbit(), fingers, event, height);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size !== 2) {
      if (travelled < CLICK_PX) return;
      if (event.buttons & 6 || event.shiftKey) orbit().pan(-dx / height, -dy / height);
      else orbit().turn(-2.6 * dx / height, 2.6 * dy / height);
    }
    on.moved();
  });
  const lift = (event) => {
    const known = fingers.delete(event.pointerId);
    if (known && event.type === "pointerup" && event.button === 0 && travelled < CLICK_PX) on.click(event);
  };
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (!orbit()) return;
    orbit().zoom(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY / (event.deltaMode ? 10 : 500)))));
    on.moved();
  }, { passive: false });
}

function pinch(orbit, fingers, event, height) {
  const [[, other]] = [...fingers].filter(([id]) => id !== event.pointerId);
  const before = fingers.get(event.pointerId);
  const spread = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
  const now = [event.clientX, event.clientY];
  orbit.zoom(spread(before, other) / spread(now, other));
  orbit.pan(-(now[0] - before[0]) / 2 / height, -(now[1] - before[1]) / 2 / height);
}

/** Handles a key: arrows turn, shift-arrows pan, plus and minus zoom, Home resets; returns whether the key is one of these. */
export function moveByKey(orbit, event, first) {
  if (ARROWS[event.key]) {
    const [x, y] = ARROWS[event.key];
    if (event.shiftKey) orbit.pan(0.05 * x, 0.05 * y);
    else orbit.turn(0.08 * x, -0.08 * y);
  } else if (event.key === "+" || event.key === "=") orbit.zoom(0.9);
  else if (event.key === "-") orbit.zoom(1 / 0.9);
  else if (event.key === "Home" || event.key === "0") orbit.from(first);
  else return false;
  return true;
}
