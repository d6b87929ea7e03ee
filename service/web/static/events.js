// Events as lines of words; one that comes again soon stays one line.

const EVENT_WORDS = { start: "service started", stop: "service stops", mark: "mark", pause: "mapping paused",
  resume: "mapping resumed", reset_map: "map reset", save_map: "map saved", load_map: "map loaded",
  set_mode: "mode", edit_map: "map changed", switch_profile: "profile switched", sensor: "sensor" };
const GROUPED_S = 10; // the same event so soon again is one line
const NUMBER = /(?<![\w.])-?\d+(\.\d+)?/g;

/** An event as words, and what it is grouped by: a reason that comes again with other figures is the same. */
const wordsOf = (text) => {
  try {
    const { event, ...rest } = JSON.parse(text);
    const words = [EVENT_WORDS[event] ?? event, ...Object.values(rest).map((value) => (typeof value === "object" ? JSON.stringify(value) : value))].join(", ");
    return { words, group: event === "mapping" ? words.replace(NUMBER, "#") : words };
  } catch {
    return { words: text, group: text }; // no JSON: then it is words already
  }
};

/** Lines {stamp_s, words} of events {stamp_s, text}, given as they came; of each group the newest, with its count. */
export const eventLines = (events) => {
  const lines = [];
  for (const { stamp_s, text } of events) {
    const { words, group } = wordsOf(text);
    const k = lines.findLastIndex((line) => line.group === group && Math.abs(stamp_s - line.stamp_s) < GROUPED_S);
    const count = k < 0 ? 1 : lines.splice(k, 1)[0].count + 1;
    lines.push({ stamp_s, group, count, words: count > 1 ? `${words} (${count} times)` : words });
  }
  return lines;
};
