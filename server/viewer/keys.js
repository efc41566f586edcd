// Keyboard shortcuts of the page, which work no matter which control was used last.

const MODES = { 1: "colour", 2: "depth", 3: "parts", 4: "alpha" };
const ARROWS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Home", "End", "PageUp", "PageDown"];
const TYPED = "input[type=text], input[type=password], input[type=number], textarea";

/** Whether the focused control handles a key itself. */
function isItsOwn(target, key) {
  if (target.closest("dialog") || target.matches(TYPED)) return true;
  if (target.matches("select")) return key.length > 1 || key === " "; // letters and digits are shortcuts of the page
  if (target.matches("input[type=range], .scroll") || target.closest("[role=radiogroup]")) return ARROWS.includes(key);
  if (target.matches("button, a, summary, input")) return key === " " || key === "Enter";
  return false;
}

/**
 * Registers the keyboard shortcuts of the page.
 *
 * @param view live view, which handles further keys itself
 * @param on { mode(name), step(count), live(), play(), nextCamera(), beside(), fit(), fullScreen(), snapshot() }
 * @param ready returns whether a scene is open
 */
export function listenToKeys(view, on, ready) {
  const actions = {
    ",": () => on.step(-1), ".": () => on.step(1), l: on.live, " ": on.play, c: on.nextCamera, b: on.beside, f: on.fit,
    s: on.snapshot, "\\": on.fullScreen,
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented || !ready()) return;
    if (isItsOwn(event.target, event.key)) return;
    const action = MODES[event.key] ? () => on.mode(MODES[event.key]) : actions[event.key.toLowerCase()];
    if (action) action();
    else if (!view.key(event)) return;
    event.preventDefault();
  });
  // A control that was used with a pointer loses the focus, so that space plays after a click on any button of the view.
  const stage = document.getElementById("stage");
  const back = () => document.getElementById("overlay").focus({ preventScroll: true });
  let pointer = false;
  stage.addEventListener("pointerdown", () => (pointer = true), true);
  stage.addEventListener("keydown", () => (pointer = false), true);
  stage.addEventListener("click", (event) => event.target.closest("button") && event.detail > 0 && back());
  stage.addEventListener("change", () => pointer && setTimeout(back));
}
