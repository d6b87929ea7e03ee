// What a map needs to be read on paper: metres along its edges, an arrow to the north; and its picture as a file.

import { FONT, haloed, strokeLine, trace } from "./canvas.js";
import { element } from "./dom.js";
import { metres } from "./format.js";

const EDGE = 4, COMPASS = 22, STRIP = 26; // pixels
const BELOW = 74 + 2 * COMPASS; // from there on are the compass and the scale
const LONGEST_BAR = 140;

/** Metres where lines of the grid meet the lower and the left edge; x at the one, y at the other, as the map is turned. */
export const drawMetres = (context, camera, colours, step_m) => {
  const { x_min_m, y_min_m, x_max_m, y_max_m } = camera.seen;
  const isUpright = Math.abs(Math.cos(camera.rotation_rad)) >= Math.SQRT1_2;
  context.font = `11px ${FONT}`;
  context.fillStyle = colours.text;
  context.strokeStyle = colours.ground;
  for (const [axis, first, last] of [["x", x_min_m, x_max_m], ["y", y_min_m, y_max_m]]) {
    const isBelow = (axis === "x") === isUpright;
    context.textAlign = isBelow ? "center" : "left";
    context.textBaseline = isBelow ? "alphabetic" : "middle";
    for (let at = Math.ceil(first / step_m) * step_m; at <= last; at += step_m) {
      const [sx, sy] = edgePoint(camera, axis, at, isBelow);
      if (isBelow ? sx < 24 || sx > camera.width - 24 : sy < 8 || sy > camera.height - BELOW) continue;
      haloed(context, `${axis} ${Number(at.toFixed(3))}`, sx, sy);
    }
  }
};

/** Where the line x = at, or y = at, comes near the lower or the left edge of the screen. */
const edgePoint = (camera, axis, at, isBelow) => {
  const c = Math.cos(camera.rotation_rad), s = Math.sin(camera.rotation_rad);
  const [along, across] = axis === "x" ? [[-s, c], [c, s]] : [[c, s], [-s, c]]; // of the line, and on it, u right and v up
  const from = camera.scale * (at - (axis === "x" ? camera.x_m : camera.y_m)), [u, v] = across.map((share) => from * share);
  const t = isBelow ? (EDGE - camera.height / 2 - v) / along[1] : (EDGE - camera.width / 2 - u) / along[0];
  return [camera.width / 2 + u + t * along[0], camera.height / 2 - v - t * along[1]];
};

/** An arrow to the north, a direction in the map; null: along its y axis, for it does not lie on the earth. */
export const drawCompass = (context, camera, colours, north_rad) => {
  const turn_rad = (north_rad ?? Math.PI / 2) + camera.rotation_rad - Math.PI / 2;
  context.save();
  context.translate(EDGE + COMPASS + 10, camera.height + 8 - BELOW + COMPASS);
  context.beginPath();
  context.arc(0, 0, COMPASS, 0, 2 * Math.PI);
  context.globalAlpha = 0.85;
  context.fillStyle = colours.paper;
  context.fill();
  context.globalAlpha = 1;
  context.rotate(-turn_rad);
  context.fillStyle = colours.text;
  context.beginPath();
  trace(context, [[0, -COMPASS + 2], [5, -3], [-5, -3]]);
  context.fill();
  context.translate(0, 7);
  context.rotate(turn_rad);
  context.font = `bold 11px ${FONT}`;
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

export const drawScale = (context, camera, colours) => {
  const [x, y] = [18, camera.height - 22], power = 10 ** Math.floor(Math.log10(LONGEST_BAR / camera.scale));
  const length_m = [5, 2, 1].map((k) => k * power).find((length) => length * camera.scale <= LONGEST_BAR);
  const end = x + length_m * camera.scale;
  const words = length_m < 1 ? `${Math.round(100 * length_m)} cm` : metres(length_m).replace(".00", "");
  context.font = `13px ${FONT}`;
  context.fillStyle = colours.paper;
  context.fillRect(x - 6, y - 14, end - x + context.measureText(words).width + 20, 22);
  context.strokeStyle = context.fillStyle = colours.text;
  context.lineWidth = 2;
  strokeLine(context, [x, y - 6], [x, y], [end, y], [end, y - 6]);
  context.textAlign = "left";
  context.textBaseline = "alphabetic";
  context.fillText(words, end + 8, y + 1);
};

/** The view as it is shown, with a line of words, as a PNG file; resolves to the blob. */
export const pictureOf = async ({ canvas, camera, dpr, colours }, words) => {
  const sheet = new OffscreenCanvas(canvas.width, canvas.height + Math.round(STRIP * dpr)), context = sheet.getContext("2d");
  context.fillStyle = colours.paper;
  context.fillRect(0, 0, sheet.width, sheet.height);
  context.drawImage(canvas, 0, 0);
  context.scale(dpr, dpr);
  context.fillStyle = colours.text;
  context.font = `13px ${FONT}`;
  context.textAlign = "right";
  context.fillText(words, camera.width - 10, camera.height + STRIP - 8);
  return sheet.convertToBlob({ type: "image/png" });
};

export const savePicture = async (view, name, stamp_s) => {
  const time = new Date(1000 * stamp_s).toISOString().slice(0, 19);
  const href = URL.createObjectURL(await pictureOf(view, `${name}, ${time.replace("T", " ")} UTC`));
  element("a", { href, download: `${name}_${time.replaceAll(/[-:]/g, "")}Z.png` }).click();
  URL.revokeObjectURL(href);
};
