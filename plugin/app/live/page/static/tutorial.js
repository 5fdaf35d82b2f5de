// The tutorial: what the hand can do, one thing after another, on a liver, without clock and limits.
import {t} from "./texts.js";

const FAR = 0.008, TURN = 0.35, LIGHT = 0.05, LEAST = 1200;  // [m], [rad], [N], of a step [ms]
// Each with what helps, and how far it is done, of how the tip has moved (right, up, back), its turn and force.
const STEPS = [
  ["Move the tip to the right", "drag, or the arrow keys", ({way}) => way[0] / FAR],
  ["Move it back to the left", "drag, or the arrow keys", ({way}) => -way[0] / FAR],
  ["Move it up", "drag, or the arrow keys", ({way}) => way[1] / FAR],
  ["Move it down", "drag, or the arrow keys", ({way}) => -way[1] / FAR],
  ["Go deeper, away from you", "the wheel, two fingers, or Q", ({way}) => -way[2] / FAR],
  ["Come back towards you", "the wheel, two fingers, or E", ({way}) => way[2] / FAR],
  ["Roll the instrument", "Shift and drag, or Z and X", ({turn}) => turn / TURN],
  ["Touch the organ gently and watch the force", "the wheel, two fingers, or Q", ({force}) => force > LIGHT],
  ["Let go of it", "the wheel, two fingers, or E", ({force}) => force < 0.01],
];
export const PRACTICE = {type: "practice", organ: "liver", mesh: "250 nodes", instrument: "probe", scheme: "implicit", step: 1, left: ""};

export class Tutorial {
  constructor() {
    this.at = 0;
    this.from = null;
  }

  // Takes how the tip is now; returns what to do, and how much of it is done.
  look(head, {mat}) {
    if (this.at === STEPS.length) return [t("Well done. Needle drivers turn their wrist too, with Shift. Go on as you like, or press Stop and begin with the first exercise"), 1];
    this.from ??= {head, since: performance.now()};
    const {head: first, since} = this.from, step = ["x", "y", "z"].map(axis => head[`tip_${axis}`] - first[`tip_${axis}`]);
    const way = [0, 1, 2].map(j => mat[j] * step[0] + mat[3 + j] * step[1] + mat[6 + j] * step[2]);
    const same = ["w", "x", "y", "z"].reduce((sum, k) => sum + head[`tip_q${k}`] * first[`tip_q${k}`], 0);
    const [text, how, done] = STEPS[this.at], share = Number(done({way, turn: 2 * Math.acos(Math.min(Math.abs(same), 1)), force: head.force}));
    if (share >= 1 && performance.now() - since > LEAST) {
      this.at++;
      this.from = null;
    }
    return [`${t("Step {0} of {1}", this.at + (share < 1), STEPS.length)}: ${t(text)} (${t(how)})`, (this.at + Math.min(Math.max(share, 0), 1) * (share < 1)) / STEPS.length];
  }
}
