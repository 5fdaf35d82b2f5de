// Curves against time, as wide as their canvases.
const SPAN = 300;  // frames in a plot

export class Plot {
  constructor(name) {
    this.canvas = document.getElementById(`plot-${name}`);
    this.text = document.getElementById(`text-${name}`);
    this.values = [];
    this.size = [0, 0];
    new ResizeObserver(() => this.size = [this.canvas.clientWidth, this.canvas.clientHeight]).observe(this.canvas);
  }

  push(value) {
    this.values.push(value);
    if (this.values.length > SPAN) this.values.shift();
  }

  clear() {
    this.values.length = 0;
  }

  // `least` is what the axis spans at least.
  draw(limit, digits = 2, least = 1e-3) {
    const {canvas, values, size: [width, height]} = this, pen = canvas.getContext("2d"), scale = devicePixelRatio || 1;
    if (!width) return;
    if (canvas.width !== Math.round(width * scale)) {
      [canvas.width, canvas.height] = [Math.round(width * scale), Math.round(height * scale)];
    }
    const most = Math.max(...values, 1.2 * (limit ?? 0), least);
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    const y = value => height - 4 - (height - 18) * value / most;
    const line = (colour, points) => {
      pen.strokeStyle = colour;
      pen.lineWidth = 1.5;
      pen.beginPath();
      points.forEach(([a, b]) => pen.lineTo(a, b));
      pen.stroke();
    };
    pen.setLineDash([6, 4]);
    if (limit) line("#e8833a", [[0, y(limit)], [width, y(limit)]]);
    pen.setLineDash([]);
    line("#7cc7f2", values.map((value, i) => [width * i / SPAN, y(value)]));
    pen.fillStyle = "#b4c0c6";
    pen.font = "12px system-ui, sans-serif";
    pen.fillText(short(most, digits), 4, 12);
    this.text.textContent = values.length ? short(values.at(-1), digits) : "";
  }
}

export const short = (value, digits) => value >= 100 ? Math.round(value).toLocaleString("en") : value.toFixed(digits);
