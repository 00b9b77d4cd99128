// Colour maps that are straight lines in OKLab, a colour space in which equal distances look equally different, so that
// equal differences of values look equal on the whole scale. Colour-blind people distinguish blue from orange, and light
// from dark. https://bottosson.github.io/posts/oklab/

const STEPS = 256;

// Lightness, green-red coordinate and blue-yellow coordinate of each colour.
const BLUE_ORANGE = {
  light: [[0.42, -0.04, -0.14], [0.975, 0, 0], [0.52, 0.1, 0.11]],
  dark: [[0.82, -0.05, -0.12], [0.24, 0, -0.01], [0.82, 0.07, 0.135]],
};
const BLUE_YELLOW = [[0.24, -0.012, -0.09], [0.93, -0.012, 0.14]];

// Lines, regions and contacts; after Okabe and Ito, Color universal design, 2008.
export const LINES = {
  light: ["#0072b2", "#d55e00", "#007a5e", "#a8487f", "#8a6d00", "#3f3f3f"],
  dark: ["#56b4e9", "#e69f00", "#2bc49a", "#e08fbd", "#f0e442", "#d0d0d0"],
};

function rgb([lightness, greenRed, blueYellow]) {
  const l = (lightness + 0.3963377774 * greenRed + 0.2158037573 * blueYellow) ** 3;
  const m = (lightness - 0.1055613458 * greenRed - 0.0638541728 * blueYellow) ** 3;
  const s = (lightness - 0.0894841775 * greenRed - 1.291485548 * blueYellow) ** 3;
  return [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ].map((part) => {
    const kept = Math.min(1, Math.max(0, part));
    return Math.round(255 * (kept <= 0.0031308 ? 12.92 * kept : 1.055 * kept ** (1 / 2.4) - 0.055));
  });
}

// Compute the colours of a map, as bytes red, green, blue, for 256 values from the lowest to the highest.
export function colourMap(diverging, theme) {
  const stops = diverging ? BLUE_ORANGE[theme] : BLUE_YELLOW;
  const table = new Uint8Array(3 * STEPS);
  for (let step = 0; step < STEPS; step += 1) {
    const place = (step / (STEPS - 1)) * (stops.length - 1);
    const lower = Math.min(stops.length - 2, Math.floor(place));
    const part = place - lower;
    table.set(rgb(stops[lower].map((value, axis) => value * (1 - part) + stops[lower + 1][axis] * part)), 3 * step);
  }
  return table;
}
