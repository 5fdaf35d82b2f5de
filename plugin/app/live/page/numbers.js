// Arrays as the server packs them, see `pack` in picture.py.
const KINDS = {f: Float32Array, b: Uint8Array, h: Uint16Array, u: Uint32Array};

export function unpack(packed) {
  const [[kind, text]] = Object.entries(packed), bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  return new KINDS[kind](bytes.buffer);
}
