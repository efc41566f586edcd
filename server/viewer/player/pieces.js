// Compact files embedded in the page as pieces of base64, each of which is removed once decoded, so that none is in memory twice.

/** Decodes base64 into bytes. */
function decoded(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

/**
 * Passes the files on, one after the other.
 *
 * @param take (bytes, number)  @param progress (share) [0, 1]
 */
export async function takeFiles(take, progress) {
  const boxes = [...document.querySelectorAll("div.file")];
  const total = boxes.reduce((sum, box) => sum + Number(box.dataset.bytes), 0);
  let done = 0;
  for (const [number, box] of boxes.entries()) {
    const bytes = new Uint8Array(Number(box.dataset.bytes));
    let at = 0;
    for (const piece of box.querySelectorAll("script")) {
      const part = decoded(piece.textContent);
      piece.remove();
      bytes.set(part, at);
      at += part.length;
      progress((done += part.length) / total);
      await new Promise((next) => setTimeout(next));
    }
    if (at !== bytes.length) throw new Error("the file is truncated: export it again, or copy it completely");
    box.remove();
    take(bytes, number);
  }
}
