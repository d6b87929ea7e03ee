// Numbers as words. A fixed count of digits, so that nothing on the page moves while they change.

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

/** No zero has a sign: it would come and go. */
const decimal = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]+$)/, "");

export const fixed = (value, digits, unit = "") => (isNumber(value) ? `${decimal(value, digits)}${unit}` : "\u2013");

/** A figure that came as text; "" means that it is not known. */
export const figure = (text, digits, unit = "") => fixed(text === undefined || text === "" ? NaN : Number(text), digits, unit);

export const degrees = (rad, digits = 1) => (isNumber(rad) ? `${decimal((rad * 180) / Math.PI, digits)}\u00b0` : "\u2013");

export const metres = (m) => {
  if (!isNumber(m)) return "\u2013";
  if (Math.abs(m) < 0.995) return `${(100 * m).toFixed(1)} cm`;
  return Math.abs(m) < 1000 ? `${m.toFixed(2)} m` : `${(m / 1000).toFixed(3)} km`;
};

export const duration = (s) => {
  if (!isNumber(s) || s < 0) return "\u2013";
  const total_s = Math.floor(s), h = Math.floor(total_s / 3600), min = Math.floor(total_s / 60) % 60;
  const two = (n) => String(n).padStart(2, "0");
  return h > 0 ? `${h}:${two(min)}:${two(total_s % 60)} h` : `${min}:${two(total_s % 60)} min`;
};

const LONGEST_UP_S = 3.2e8; // 10 years: a device clock that is farther on was set
const UNIX_END_S = 2.2e9; // 2039: one that is farther on counts from 1900, as NTP does
const NTP_UNIX_S = 2_208_988_800;

/** What a device's clock says, given in s as text: time since it began at 0, or the year that it was set to. */
export const deviceClock = (text) => {
  if (text === undefined || text === "") return "\u2013";
  const s = Number(text);
  if (s < LONGEST_UP_S && s >= 3.6e5) return `${Math.floor(s / 86_400)} d`;
  if (s < LONGEST_UP_S) return duration(Math.max(s, 0)).replace(/:\d\d h$/, " h");
  return String(new Date(1000 * (s > UNIX_END_S ? s - NTP_UNIX_S : s)).getUTCFullYear());
};

export const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

export const clockTime = (unix_s) => new Date(1000 * unix_s).toLocaleTimeString([], { hour12: false });

export const dateTime = (value) => new Date(value).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });

export const bytes = (count) => {
  const [unit, size] = [["GB", 1e9], ["MB", 1e6], ["kB", 1e3]].find(([, least]) => count >= least) ?? ["B", 1];
  return `${(count / size).toFixed(size === 1 ? 0 : 1)} ${unit}`;
};
