// Figures as people read them: units shown, the same number of decimals, a true minus.
const MINUS = "\u2212";
export const NONE = "\u2013";

export function number(value, digits, sign = false) {
  if (value === null || value === undefined || !Number.isFinite(value)) return NONE;
  const rounded = Number(value.toFixed(digits)) || 0;
  const text = Math.abs(rounded).toFixed(digits);
  return (rounded < 0 ? MINUS : sign && rounded > 0 ? "+" : "") + text;
}
export const degrees = (rad) => (rad * 180) / Math.PI;
export const deg = (rad, digits = 2) => (rad === null || rad === undefined ? NONE : `${number(degrees(rad), digits, true)}°`);
export const metres = (m, digits = 3) => `${number(m, digits)} m`;
export const px = (value, digits = 2) => `${number(value, digits, true)} px`;

export function forTime(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 60) return `${Math.floor(seconds)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ${Math.floor(seconds % 60)} s`;
  return `${Math.floor(seconds / 3600)} h ${Math.floor((seconds % 3600) / 60)} min`;
}

/** The time of day of this place, of a moment as the daemon tells it. */
export const clock = (at) => new Date(at).toLocaleTimeString("en-GB");

/** A number as people type it. */
export const figure = (text) => Number(text.trim().replace(",", ".").replace(MINUS, "-") || NaN);

/** A name of the daemon's without its unit, the unit as people read it, and how many of it one of the daemon's is. */
export function unitOf(name) {
  const units = { rad_per_s: ["°/s", 180 / Math.PI], c_per_s: ["°C/s", 1], rad: ["°", 180 / Math.PI], s: ["s", 1], px: ["px", 1] };
  const [end] = Object.keys(units).filter((one) => name.endsWith(`_${one}`)).sort((a, b) => b.length - a.length);
  return end ? [name.slice(0, -end.length - 1), ...units[end]] : [name, "", 1];
}

export const camera = (name) => name.replaceAll("_", " ");

const NUMBER = "[+\\-\u2212]?\\d+(?:\\.\\d+)?(?:e[+-]?\\d+)?";
const ANGLES = new RegExp(`(?:(?:pan|tilt) ${NUMBER}(?: to ${NUMBER})?,? (?:and )?(?:pan|tilt) ${NUMBER}(?: to ${NUMBER})?|${NUMBER}) rad(/s2?)?\\b`, "g");

/** A sentence of the daemon's with its angles as people type them here: in degrees. */
export const inDegrees = (words) => words.replace(ANGLES, (angles, per = "") =>
  angles.slice(0, -" rad".length - per.length).replace(new RegExp(NUMBER, "g"), (value) => {
    const there = degrees(figure(value));
    return `${String(Number(Math.abs(there) >= 1 ? there.toFixed(2) : there.toPrecision(3))).replace("-", MINUS)}°`;
  }) + per);

/** A sentence begins with a capital, unless with a device's name. */
export const sentence = (text) => (!text || /^\w*[_\d]/.test(text) ? text ?? "" : text[0].toUpperCase() + text.slice(1));
