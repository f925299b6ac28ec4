// The cart and its pole on a canvas, in the colours of the page.

const WORLD = 4.8; // metres across
const POLE = 1.0; // metres

export class Drawing {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
  }

  /** Draw a state. */
  show([place, , angle]) {
    const { context, canvas } = this;
    const style = getComputedStyle(document.documentElement);
    const [ink, accent, line] = ["--ink", "--accent", "--line"].map((name) => style.getPropertyValue(name));
    const scale = canvas.width / WORLD;
    const ground = canvas.height * 0.78;
    const x = canvas.width / 2 + place * scale;
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = line;
    context.fillRect(0, ground + 0.12 * scale, canvas.width, 2);
    context.fillStyle = ink;
    context.fillRect(x - 0.25 * scale, ground - 0.12 * scale, 0.5 * scale, 0.24 * scale);
    context.strokeStyle = accent;
    context.lineWidth = 0.08 * scale;
    context.lineCap = "round";
    context.beginPath();
    context.moveTo(x, ground - 0.1 * scale);
    context.lineTo(x + POLE * scale * Math.sin(angle), ground - 0.1 * scale - POLE * scale * Math.cos(angle));
    context.stroke();
  }
}
