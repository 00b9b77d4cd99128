// Numbers and units as text.

const PREFIXES = new Map([[-9, "n"], [-6, "µ"], [-3, "m"], [0, ""], [3, "k"], [6, "M"]]);
const PREFIXED = new Set(["S/m", "S", "m", "N", "V", "A", "Pa", "Ω", "ohm"]);

// Choose a factor and a prefixed unit that make a size a number from 1 to 1000: 0.004 S/m is 4 mS/m.
export function unitFor(size, unit) {
  if (!(size > 0) || !Number.isFinite(size)) return { factor: 1, unit };
  const power = 3 * Math.floor(Math.log10(size) / 3 + 1e-9);
  if (power === 0) return { factor: 1, unit };
  if (PREFIXED.has(unit) && PREFIXES.has(power)) return { factor: 10 ** -power, unit: PREFIXES.get(power) + unit };
  if (Math.abs(power) < 3) return { factor: 1, unit };
  const digits = String(power).replace(/[-\d]/g, (digit) => (digit === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit]));
  return { factor: 10 ** -power, unit: `10${digits}${unit ? " " + unit : ""}` };
}

// Replace hyphens by minus signs, and remove the plus sign of an exponent.
const signed = (text) => text.replace("e+", "e").replaceAll("-", "−");

export function short(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-3) return signed(value.toExponential(digits - 1));
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size) + 1e-9));
  return signed(value.toFixed(decimals));
}

export const percent = (value) => (value === null || value === undefined ? "–" : `${short(100 * value, 2)} %`);
export const milliseconds = (value) => (value === null || value === undefined ? "–" : `${short(1000 * value, 2)} ms`);

export function bytes(value) {
  if (!(value >= 1000)) return `${value ?? 0} B`;
  const power = Math.min(4, Math.floor(Math.log10(value) / 3));
  return `${short(value / 1000 ** power)} ${["B", "kB", "MB", "GB", "TB"][power]}`;
}

// The largest of 1, 2, 5, 10, 20 … that is at most a size.
export function round125(size) {
  const power = 10 ** Math.floor(Math.log10(size) + 1e-9);
  return power * [5, 2, 1].find((step) => step * power <= size * (1 + 1e-9));
}

// A round number as text, such as a tick of an axis.
export const round = (value) => signed(String(Number(value.toPrecision(3))));

// Round numbers from the lowest to the highest, with at most `most` equal steps between them.
export function ticks(lowest, highest, most = 5) {
  const span = highest - lowest;
  if (!(span > 0) || !Number.isFinite(span)) return [lowest];
  const step = [1, 2, 5, 10].map((part) => part * round125(span / most)).find((one) => span / one <= most);
  const found = [];
  for (let index = Math.ceil(lowest / step - 1e-9); index * step <= highest + 1e-9 * span; index += 1) {
    found.push(index === 0 ? 0 : index * step);
  }
  return found;
}
