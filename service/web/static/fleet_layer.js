// Draws the vehicles of a site, each with its name; one that is not well has another colour and says why.

const LENGTH_PIXELS = 22;

export class FleetLayer {
  constructor() {
    this.vehicles = []; // {name, x_m, y_m, theta_rad, is_well, state}
  }

  put({ vehicles }) {
    this.vehicles = vehicles;
  }

  /** In pixels of the screen. */
  draw(context, camera, colours) {
    context.font = "13px system-ui, sans-serif";
    context.textBaseline = "middle";
    for (const { name, x_m, y_m, theta_rad, is_well, state } of this.vehicles) {
      const [x, y] = camera.toScreen(x_m, y_m);
      const [ahead, beside] = camera.toScreen(x_m + Math.cos(theta_rad), y_m + Math.sin(theta_rad));
      context.save();
      context.translate(x, y);
      context.rotate(Math.atan2(beside - y, ahead - x));
      context.beginPath();
      for (const [forward, left] of [[0.6, 0], [-0.4, -0.35], [-0.2, 0], [-0.4, 0.35]]) {
        context.lineTo(LENGTH_PIXELS * forward, LENGTH_PIXELS * left);
      }
      context.closePath();
      context.fillStyle = is_well ? colours.vehicle : colours.stale;
      context.fill();
      context.strokeStyle = colours.paper;
      context.lineWidth = 1.5;
      context.stroke();
      context.restore();
      const words = is_well ? name : `${name}: ${state}`;
      context.lineWidth = 3;
      context.strokeStyle = colours.paper;
      context.strokeText(words, x + LENGTH_PIXELS, y);
      context.fillStyle = colours.text;
      context.fillText(words, x + LENGTH_PIXELS, y);
    }
  }
}
