// What the page lets one hear: a tone for each kind of warning, and one at the end.
export const TONES = {force: [880, 0.1], shaft: [660, 0.1], view: [330, 0.15], end: [523, 0.3]};  // [Hz], [s]
const LOUD = 0.2, EDGE = 0.005;  // of a tone, and how long it swells and fades [s]

// Plays the tone of a kind in an audio context, from a time of its on [s].
export function play(context, kind, at = context.currentTime) {
  const [pitch, length] = TONES[kind] ?? TONES.force, tone = context.createOscillator(), gain = context.createGain();
  tone.frequency.value = pitch;
  gain.gain.setValueAtTime(0, at);
  gain.gain.linearRampToValueAtTime(LOUD, at + EDGE);
  gain.gain.setValueAtTime(LOUD, at + length - EDGE);
  gain.gain.linearRampToValueAtTime(0, at + length);
  tone.connect(gain).connect(context.destination);
  tone.start(at);
  tone.stop(at + length);
}

// Returns what plays the tone of a kind while `on` says so.
export function speaker(on) {
  let context = null;
  return kind => {
    if (!on()) return;
    document.body.dataset.tone = kind;  // for those who do not hear it
    context ??= new AudioContext();
    play(context, kind);
  };
}
