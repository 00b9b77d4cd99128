// Conversion of an image's values to colours: smoothing, threshold, and the edge of the body.

// Smooth values by a Gaussian of standard deviation `sigma`, pixels; pixels outside the body, NaN, are left out.
export function smooth(values, [height, width], sigma) {
  if (!(sigma > 0)) return values;
  const reach = Math.ceil(2.5 * sigma);
  const kernel = Array.from({ length: 2 * reach + 1 }, (_, at) => Math.exp(-((at - reach) ** 2) / (2 * sigma ** 2)));
  const along = (from, count, lines, step, jump) => {
    const to = new Float32Array(from.length).fill(NaN);
    for (let line = 0; line < lines; line += 1) {
      for (let at = 0; at < count; at += 1) {
        const here = line * jump + at * step;
        if (Number.isNaN(from[here])) continue;
        let sum = 0;
        let weight = 0;
        const last = Math.min(count - 1, at + reach);
        for (let other = Math.max(0, at - reach); other <= last; other += 1) {
          const value = from[line * jump + other * step];
          if (Number.isNaN(value)) continue;
          sum += kernel[other - at + reach] * value;
          weight += kernel[other - at + reach];
        }
        to[here] = sum / weight;
      }
    }
    return to;
  };
  return along(along(values, width, height, 1, width), height, width, width, 1);
}

// Set the pixels just outside the body to the mean of their neighbours, so that interpolation between pixels does not
// fade the image at the outline, at which the image is clipped.
export function widen(values, [height, width]) {
  let wide = values;
  for (let pass = 0; pass < 2; pass += 1) {
    const from = wide;
    wide = Float32Array.from(from);
    for (let at = 0; at < from.length; at += 1) {
      if (!Number.isNaN(from[at])) continue;
      const column = at % width;
      let sum = 0;
      let count = 0;
      for (let down = -1; down <= 1; down += 1) {
        const other = at + down * width;
        if (other < 0 || other >= from.length) continue;
        for (let right = column > 0 ? -1 : 0; right <= (column < width - 1 ? 1 : 0); right += 1) {
          const value = from[other + right];
          if (Number.isNaN(value)) continue;
          sum += value;
          count += 1;
        }
      }
      if (count) wide[at] = sum / count;
    }
  }
  return wide;
}

// Whether the colour scale hides a value, because its distance from zero (diverging scale) or from the lowest value is
// less than the fraction `threshold` of the scale.
export function hides(value, { lowest, highest, diverging, threshold }) {
  if (!(threshold > 0)) return false;
  return diverging ? Math.abs(value) < threshold * highest : value - lowest < threshold * (highest - lowest);
}

// Write the colours of values into the bytes of an image; `none`: red, green, blue of hidden values.
export function colour(values, scale, table, none, data) {
  const { lowest, highest } = scale;
  const factor = 255 / (highest - lowest || 1);
  for (let at = 0; at < values.length; at += 1) {
    const value = values[at];
    const to = 4 * at;
    if (Number.isNaN(value)) {
      data[to + 3] = 0;
      continue;
    }
    if (hides(value, scale)) {
      [data[to], data[to + 1], data[to + 2]] = none;
    } else {
      const entry = 3 * Math.min(255, Math.max(0, Math.round((value - lowest) * factor)));
      data[to] = table[entry];
      data[to + 1] = table[entry + 1];
      data[to + 2] = table[entry + 2];
    }
    data[to + 3] = 255;
  }
}

function rounded(size) {
  const power = 10 ** Math.floor(Math.log10(size));
  return power * [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10].find((step) => step * power >= size * (1 - 1e-9));
}

// A colour scale that adapts to the pictures: it grows at once, but shrinks only when less than 60 % of it has been
// used for some seconds.
export class ColourScale {
  constructor(diverging) {
    Object.assign(this, { diverging, fitted: true, threshold: 0, lowest: diverging ? -1 : 0, highest: 1 });
    this.forget();
  }

  forget() {
    Object.assign(this, { peak: -Infinity, trough: Infinity, at: null });
  }

  fit(values, second) {
    if (!this.fitted) return;
    let most = -Infinity;
    let least = Infinity;
    for (const one of values) {
      const value = this.diverging ? Math.abs(one) : one;
      if (value > most) most = value;
      if (value < least) least = value;
    }
    if (!Number.isFinite(most)) return;
    const first = this.at === null;
    const fade = first ? 0 : Math.exp(-Math.abs(second - this.at) / 3);
    this.at = second;
    this.peak = first ? most : Math.max(most, most + (this.peak - most) * fade);
    this.trough = first ? least : Math.min(least, least + (this.trough - least) * fade);
    if (this.diverging) {
      if (this.peak > 0 && (first || this.peak > this.highest || this.peak < 0.6 * this.highest)) {
        this.highest = rounded(this.peak);
        this.lowest = -this.highest;
      }
    } else {
      const span = this.highest - this.lowest;
      const within = this.trough >= this.lowest - 0.1 * span && this.peak <= this.highest;
      if (first || !within || this.peak - this.trough < 0.6 * span) {
        const fromZero = this.peak > 0 && this.trough > -0.1 * this.peak && this.trough < 0.3 * this.peak;
        const pad = 0.05 * (this.peak - this.trough) || 0.5 * Math.abs(this.peak) || 1;
        this.lowest = fromZero ? 0 : this.trough - pad;
        this.highest = fromZero ? rounded(this.peak) : this.peak + pad;
      }
    }
  }

  // Fix the highest value of the scale and, unless the colours are centred on zero, the lowest value.
  keep(highest, lowest = this.lowest) {
    const from = this.diverging ? -highest : lowest;
    if (!Number.isFinite(highest) || !Number.isFinite(from) || !(highest > from)) return false;
    Object.assign(this, { fitted: false, highest, lowest: from });
    return true;
  }
}
