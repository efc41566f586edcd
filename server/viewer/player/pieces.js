// The compact files in the page: base64 in pieces, each decoded and then taken out, so that neither is in memory twice.

/** Bytes of base64. */
function decoded(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

/**
 * Hands out the files, one after the other.
 *
 * @param take (bytes, number)  @param progress (share) 0…1
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
    if (at !== bytes.length) throw new Error("the file is cut: export it again, or copy it whole");
    box.remove();
    take(bytes, number);
  }
}
