// Regions drawn on the image with mouse, finger or keyboard, and the mean of a picture over each region.

export const MOST_REGIONS = 5;
const LEAST_DRAG = 8;
// A drag counts as the diagonal of a rectangle if it encloses less than this fraction of the square of its length.
const STRAIGHT = 0.05;

function inside(points, x, y) {
  let within = false;
  for (let at = 0, before = points.length - 1; at < points.length; before = at, at += 1) {
    const [ax, ay] = points[at];
    const [bx, by] = points[before];
    if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) within = !within;
  }
  return within;
}

export function circle([x, y], radius) {
  return Array.from({ length: 36 }, (_, at) => {
    const angle = (2 * Math.PI * at) / 36;
    return [x + radius * Math.cos(angle), y + radius * Math.sin(angle)];
  });
}

// Mean of the pixels whose centres lie in a region; NaN without a picture, or for a region without pixels.
export function mean(region, picture, [left, right, lower, upper]) {
  if (!picture.pixels) return NaN;
  const [rows, columns] = picture.shape;
  if (region.shape !== String(picture.shape)) {
    region.shape = String(picture.shape);
    region.pixels = [];
    for (let row = 0; row < rows; row += 1) {
      for (let column = 0; column < columns; column += 1) {
        const x = left + ((column + 0.5) / columns) * (right - left);
        const y = upper - ((row + 0.5) / rows) * (upper - lower);
        if (inside(region.points, x, y)) region.pixels.push(row * columns + column);
      }
    }
  }
  let sum = 0;
  let count = 0;
  for (const at of region.pixels) {
    if (Number.isNaN(picture.pixels[at])) continue;
    sum += picture.pixels[at];
    count += 1;
  }
  return count ? sum / count : NaN;
}

// Area of a polygon.
function area(points) {
  return Math.abs(points.reduce((sum, [x, y], at) => {
    const [nextX, nextY] = points[(at + 1) % points.length];
    return sum + (x * nextY - nextX * y) / 2;
  }, 0));
}

// The rectangle with two given opposite corners, but with no side shorter than `least`.
function rectangle([ax, ay], [bx, by], least) {
  const [x, y] = [(ax + bx) / 2, (ay + by) / 2];
  const [right, up] = [Math.max(least, Math.abs(bx - ax)) / 2, Math.max(least, Math.abs(by - ay)) / 2];
  return [[x - right, y - up], [x + right, y - up], [x + right, y + up], [x - right, y + up]];
}

// Let the user draw regions on the image. `add` is called with the points of a new region, `point` with the position of
// the pointer or of the cross, or null.
export function drawWith(view, { add, point, redraw }) {
  const { canvas } = view;
  let start = null;
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const small = () => 0.05 * (view.box[1] - view.box[0]);
  canvas.addEventListener("pointerdown", (event) => {
    if (!view.scene || event.button) return;
    canvas.setPointerCapture(event.pointerId);
    start = place(event);
    view.cross = null;
    view.lasso = [view.toBody(...start)];
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!view.scene) return;
    const at = place(event);
    point(view.toBody(...at));
    if (!start) return;
    view.lasso.push(view.toBody(...at));
    redraw();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (!start) return;
    const [first] = view.lasso;
    const away = ([x, y]) => Math.hypot(x - first[0], y - first[1]);
    const farthest = view.lasso.reduce((one, other) => (away(other) > away(one) ? other : one));
    const reach = away(farthest);
    if (reach * view.metre < LEAST_DRAG) add(circle(view.toBody(...place(event)), small()));
    else if (area(view.lasso) < STRAIGHT * reach ** 2) add(rectangle(first, farthest, small()));
    else add(view.lasso);
    start = view.lasso = null;
    redraw();
  });
  canvas.addEventListener("pointercancel", () => {
    start = view.lasso = null;
    redraw();
  });
  canvas.addEventListener("pointerleave", () => !start && point(view.cross));
  canvas.addEventListener("blur", () => {
    view.cross = null;
    point(null);
    redraw();
  });
  canvas.addEventListener("keydown", (event) => {
    if (!view.scene || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const [left, right, lower, upper] = view.scene.extent;
    if (step) {
      const size = ((event.shiftKey ? 10 : 1) * (right - left)) / 100;
      const [x, y] = view.cross ?? [(left + right) / 2, (lower + upper) / 2];
      view.cross = [
        Math.min(right, Math.max(left, x + step[0] * size)),
        Math.min(upper, Math.max(lower, y + step[1] * size)),
      ];
    } else if (event.key === "Enter" && view.cross) {
      add(circle(view.cross, small()));
    } else if (event.key === "Escape") {
      view.cross = null;
      canvas.blur();
    } else {
      return;
    }
    event.preventDefault();
    event.stopPropagation();
    point(view.cross);
    redraw();
  });
}
