// States of a scene in words, and what a person can do in each of them.

const STATES = {
  awaiting_first_frame: "Waiting for its first frame",
  initialising: "Reconstructing the first frame",
  ready: "Ready",
  updating: "Updating",
  paused: "Paused",
  degraded: "Degraded",
  failed: "Failed",
};

/** The state of the scene in words, with what else holds. */
export function stateWords(status) {
  const words = [STATES[status.state] ?? status.state];
  if (status.paused && status.state !== "paused" && status.state !== "failed") words.push("pausing");
  if (status.degraded && status.state !== "degraded") words.push("degraded");
  if (status.archived) words.push("archived");
  if (status.asleep) words.push("asleep");
  return words.join(" · ");
}

/** The state that the page colours by. */
export const stateKey = (status) =>
  (status.state === "failed" ? "failed" : status.degraded ? "degraded" : status.asleep ? "asleep" : status.state);

const path = (status) => `/v1/scenes/${status.id}`;

/** A number and its noun: 1 frame, 2 frames. */
export const counted = (count, noun, many = `${noun}s`) => `${count} ${count === 1 ? noun : many}`;

/** Words over the view of a scene without a committed frame; `page.curtain` has their fields. */
export function beforeFirstFrame(status, { resume, restore } = {}) {
  if (status.state === "failed") {
    return { title: "The scene has failed", words: status.error ?? "",
      detail: `scas4d begin-again ${status.id}`, actions: [] };
  }
  if (status.progress) return progressWords(status.progress);
  if (status.state === "initialising") return { title: "Reconstructing the first frame", words: "The pictures are being read.", share: null };
  if (status.paused && status.queued) {
    return { title: `${counted(status.queued, "frame")} waiting`, words: "The scene is paused: it accepts frames and reconstructs none.",
      actions: resume ? [["Resume", resume]] : [] };
  }
  if (status.queued) {
    return { title: "The first frame is queued", words: `${counted(status.queued, "frame")} came; the worker of the scene is starting.`, share: null };
  }
  if (status.archived) return { title: "The scene is archived", words: "It accepts no frames, and has none to show.", actions: restore ? [["Restore", restore]] : [] };
  return { title: "Waiting for the first frame",
    words: `The scene accepts frames of ${counted(status.cameras.length, "camera")}. Send frame ${status.next_frame}:`,
    detail: `PUT ${path(status)}/frames/${status.next_frame}` };
}

function progressWords({ stage, done, total, detail = {} }) {
  const { loss, seconds_left: left, seconds_at_most: most } = detail;
  const when = left !== undefined ? ` · about ${Math.ceil(left)} s left` : most ? ` · ${Math.ceil(most)} s at most` : "";
  return { title: "Reconstructing the first frame", words: stage[0].toUpperCase() + stage.slice(1),
    detail: `${done} of ${total}${loss === undefined ? "" : ` · loss ${loss.toFixed(4)}`}${when}`, share: total ? done / total : null };
}

export const NO_SCENE = { title: "No scene yet", words: "Send a capture and it appears here. The API page has the calls for your own rig.",
  detail: "scas4d push samples/robot --fps 5" };
export const WAKING = { title: "Waking the scene", words: "It was idle and had no processes. The first picture is on its way.", share: null };
export const OPENING = { title: "Opening the scene", words: "The first picture is on its way.", share: null };

/** The service does not answer, or not yet, and no picture is there to be kept. */
export const noService = (error) => (error.status === 503
  ? { title: "The service is starting", words: error.message, share: null }
  : { title: "No connection", words: `${error.message} The page tries again every few seconds.`, detail: "scas4d serve" });
