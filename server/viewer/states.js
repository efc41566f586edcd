// Descriptions of a scene's states, with the possible actions in each.

const STATES = {
  awaiting_first_frame: "Waiting for its first frame",
  initialising: "Reconstructing the first frame",
  ready: "Ready",
  updating: "Updating",
  paused: "Paused",
  degraded: "Degraded",
  failed: "Failed",
};

/** Description of the scene's state and other conditions, such as archived or asleep. */
export function stateWords(status) {
  const words = [STATES[status.state] ?? status.state];
  if (status.paused && status.state !== "paused" && status.state !== "failed") words.push("pausing");
  if (status.degraded && status.state !== "degraded") words.push("degraded");
  if (status.archived) words.push("archived");
  if (status.asleep) words.push("asleep");
  return words.join(" · ");
}

/** State that determines the colour of the page's state label. */
export const stateKey = (status) =>
  (status.state === "failed" ? "failed" : status.degraded ? "degraded" : status.asleep ? "asleep" : status.state);

const path = (status) => `/v1/scenes/${status.id}`;

/** A count followed by its noun, such as "1 frame" or "2 frames". */
export const counted = (count, noun, many = `${noun}s`) => `${count} ${count === 1 ? noun : many}`;

/** Message over the view of a scene without a committed frame; see `curtain` for its fields. */
export function beforeFirstFrame(status, { resume, restore } = {}) {
  if (status.state === "failed") {
    return { title: "The scene has failed", words: status.error ?? "",
      detail: `scas4d begin-again ${status.id}`, actions: [] };
  }
  if (status.progress) return progressWords(status.progress);
  if (status.state === "initialising") return { title: "Reconstructing the first frame", words: "Reading the pictures.", share: null };
  if (status.paused && status.queued) {
    return { title: `${counted(status.queued, "frame")} waiting`, words: "The scene is paused: it accepts frames but does not reconstruct them.",
      actions: resume ? [["Resume", resume]] : [] };
  }
  if (status.queued) {
    return { title: "The first frame is queued", words: `${counted(status.queued, "frame")} received; the scene's worker is starting.`, share: null };
  }
  if (status.archived) return { title: "The scene is archived", words: "It accepts no frames and has none to show.", actions: restore ? [["Restore", restore]] : [] };
  return { title: "Waiting for the first frame",
    words: `The scene accepts frames from ${counted(status.cameras.length, "camera")}. Send frame ${status.next_frame}:`,
    detail: `PUT ${path(status)}/frames/${status.next_frame}` };
}

function progressWords({ stage, done, total, detail = {} }) {
  const { loss, seconds_left: left, seconds_at_most: most } = detail;
  const when = left !== undefined ? ` · about ${Math.ceil(left)} s left` : most ? ` · ${Math.ceil(most)} s at most` : "";
  return { title: "Reconstructing the first frame", words: stage[0].toUpperCase() + stage.slice(1),
    detail: `${done} of ${total}${loss === undefined ? "" : ` · loss ${loss.toFixed(4)}`}${when}`, share: total ? done / total : null };
}

export const NO_SCENE = { title: "No scene yet", words: "Send a capture, and it will appear here. The API page describes the requests for your own rig.",
  detail: "scas4d push samples/robot --fps 5" };
export const WAKING = { title: "Waking the scene", words: "It was idle and had no processes. The first picture is on its way.", share: null };
export const OPENING = { title: "Opening the scene", words: "The first picture is on its way.", share: null };

/** Message for a service that does not respond, or not yet, while there is no picture to keep. */
export const noService = (error) => (error.status === 503
  ? { title: "The service is starting", words: error.message, share: null }
  : { title: "No connection", words: `${error.message} The page retries every few seconds.`, detail: "scas4d serve" });
