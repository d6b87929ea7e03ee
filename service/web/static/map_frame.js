// What a map needs to be read on paper: metres along its edges, an arrow to the north; and its picture as a file.

import { scaleBar } from "./map_view.js";

const EDGE = 4, COMPASS = 22; // pixels
const BELOW = 74 + 2 * COMPASS; // from there on are the compass and the scale
const FONT = "11px system-ui, sans-serif";

/** Metres where lines of the grid meet the lower and the left edge; x at the one, y at the other, as the map is turned. */
export const drawMetres = (context, camera, colours, step_m) => {
  const { x_min_m, y_min_m, x_max_m, y_max_m } = camera.seen;
  const isUpright = Math.abs(Math.cos(camera.rotation_rad)) >= Math.SQRT1_2;
  context.font = FONT;
  context.fillStyle = colours.text;
  context.strokeStyle = colours.ground;
  context.lineWidth = 3;
  for (const [axis, first, last] of [["x", x_min_m, x_max_m], ["y", y_min_m, y_max_m]]) {
    const isBelow = (axis === "x") === isUpright;
    context.textAlign = isBelow ? "center" : "left";
    context.textBaseline = isBelow ? "alphabetic" : "middle";
    for (let at = Math.ceil(first / step_m) * step_m; at <= last; at += step_m) {
      const [sx, sy] = edgePoint(camera, axis, at, isBelow);
      if (isBelow ? sx < 24 || sx > camera.width - 24 : sy < 8 || sy > camera.height - BELOW) continue;
      const words = `${axis} ${Number(at.toFixed(3))}`;
      context.strokeText(words, sx, sy);
      context.fillText(words, sx, sy);
    }
  }
};

/** Where the line x = at, or y = at, comes near the lower or the left edge of the screen. */
const edgePoint = (camera, axis, at, isBelow) => {
  const c = Math.cos(camera.rotation_rad), s = Math.sin(camera.rotation_rad);
  const [along, across] = axis === "x" ? [[-s, c], [c, s]] : [[c, s], [-s, c]]; // of the line, and on it, u right and v up
  const from = camera.scale * (at - (axis === "x" ? camera.x_m : camera.y_m));
  const [u, v] = [from * across[0], from * across[1]];
  const t = isBelow ? (EDGE - camera.height / 2 - v) / along[1] : (EDGE - camera.width / 2 - u) / along[0];
  return [camera.width / 2 + u + t * along[0], camera.height / 2 - v - t * along[1]];
};

/** An arrow to the north, or, where the map does not lie on the earth, along its y axis.
 *
 * north_rad    direction in the map, counter-clockwise from its x axis; null: not known */
export const drawCompass = (context, camera, colours, north_rad) => {
  const [x, y] = [EDGE + COMPASS + 10, camera.height + 8 - BELOW + COMPASS];
  const up = (north_rad ?? Math.PI / 2) + camera.rotation_rad;
  context.save();
  context.translate(x, y);
  context.beginPath();
  context.arc(0, 0, COMPASS, 0, 2 * Math.PI);
  context.globalAlpha = 0.85;
  context.fillStyle = colours.paper;
  context.fill();
  context.globalAlpha = 1;
  context.rotate(Math.PI / 2 - up);
  context.fillStyle = colours.text;
  context.beginPath();
  context.moveTo(0, -COMPASS + 2);
  context.lineTo(5, -3);
  context.lineTo(-5, -3);
  context.fill();
  context.translate(0, 7);
  context.rotate(up - Math.PI / 2);
  context.font = `bold ${FONT}`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(north_rad === null ? "y" : "N", 0, 0);
  context.restore();
};

/** Direction of north in the map, of what health says; null where the map does not lie on the earth. */
export const northOf = (health) => {
  const yaw = health?.statuses.map(({ values }) => values.map_yaw_enu_deg).find((text) => text !== undefined && text !== "");
  return yaw === undefined ? null : ((90 - Number(yaw)) * Math.PI) / 180;
};

/** A bar of a round length in the lower left corner. */
export const drawScale = (context, camera, colours) => {
  const bar = scaleBar(camera.scale, 140), [x, y] = [18, camera.height - 22];
  context.font = "13px system-ui, sans-serif";
  context.fillStyle = colours.paper;
  context.fillRect(x - 6, y - 14, bar.pixels + context.measureText(bar.text).width + 20, 22);
  context.strokeStyle = context.fillStyle = colours.text;
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(x, y - 6);
  context.lineTo(x, y);
  context.lineTo(x + bar.pixels, y);
  context.lineTo(x + bar.pixels, y - 6);
  context.stroke();
  context.textAlign = "left";
  context.textBaseline = "alphabetic";
  context.fillText(bar.text, x + 8 + bar.pixels, y + 1);
};

/** The view as it is shown, with a line of words, as a PNG file; resolves to the blob. */
export const pictureOf = async (view, words) => {
  const { canvas, camera, dpr, colours } = view, strip = 26;
  const sheet = new OffscreenCanvas(canvas.width, canvas.height + Math.round(strip * dpr));
  const context = sheet.getContext("2d");
  context.fillStyle = colours.paper;
  context.fillRect(0, 0, sheet.width, sheet.height);
  context.drawImage(canvas, 0, 0);
  context.scale(dpr, dpr);
  context.fillStyle = colours.text;
  context.font = "13px system-ui, sans-serif";
  context.textAlign = "right";
  context.fillText(words, camera.width - 10, camera.height + strip - 8);
  return sheet.convertToBlob({ type: "image/png" });
};

export const savePicture = async (view, name, stamp_s) => {
  const time = new Date(1000 * stamp_s).toISOString().slice(0, 19);
  const address = URL.createObjectURL(await pictureOf(view, `${name}, ${time.replace("T", " ")} UTC`));
  const link = document.createElement("a");
  link.href = address;
  link.download = `${name}_${time.replaceAll(/[-:]/g, "")}Z.png`;
  link.click();
  URL.revokeObjectURL(address);
};
