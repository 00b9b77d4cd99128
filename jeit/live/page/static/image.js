// The image of the body: pixels, outline, electrodes, contacts and their paths, regions, scale bar and colour bar.

import { colourMap, LINES } from "./colours.js";
import { round, round125, ticks, unitFor } from "./numbers.js";
import { colour, ColourScale, hides, smooth, widen } from "./pixels.js";

const PATH_SECONDS = 5;
const STALE_SECONDS = 0.3;

const bounds = (curves, extent) => {
  const box = [...extent];
  for (const curve of curves) {
    for (const [x, y] of curve) {
      box[0] = Math.min(box[0], x);
      box[1] = Math.max(box[1], x);
      box[2] = Math.min(box[2], y);
      box[3] = Math.max(box[3], y);
    }
  }
  return box;
};

export class ImageView {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d", { alpha: false });
    this.small = document.createElement("canvas");
    this.fixed = document.createElement("canvas");
    Object.assign(this, { theme: "light", smoothing: "0", regions: [], lasso: null, cross: null, paths: new Map() });
    Object.assign(this, { dead: [], drifting: [], picture: null, shown: null, scene: null });
  }

  setScene(scene) {
    this.scene = scene;
    this.box = bounds([...scene.outline, ...scene.electrodes], scene.extent);
    // A colour scale that the user chose remains when the connection is opened again.
    if (this.scale?.diverging !== scene.diverging || this.unit !== scene.unit) this.scale = new ColourScale(scene.diverging);
    this.unit = scene.unit;
    this.shown = this.picture = null;
    this.paths.clear();
    this.setTheme(this.theme);
  }

  setTheme(theme) {
    this.theme = theme;
    const style = getComputedStyle(document.documentElement);
    const read = (name) => style.getPropertyValue(name).trim();
    this.inks = { paper: read("--paper"), ink: read("--ink"), faint: read("--faint"), body: read("--body") };
    this.inks.warn = read("--warn");
    this.inks.none = [1, 3, 5].map((at) => parseInt(this.inks.body.slice(at, at + 2), 16));
    if (this.scene) this.table = colourMap(this.scene.diverging, theme);
    this.resize();
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.canvas.width = this.fixed.width = Math.max(1, Math.round(width * ratio));
    this.canvas.height = this.fixed.height = Math.max(1, Math.round(height * ratio));
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    Object.assign(this, { width, height, ratio });
    if (!this.scene) return;
    const { box } = this;
    const bar = width < 520 ? 62 : 84;
    const [left, top, right, bottom] = [26, 44, width - bar, height - 34];
    const metre = Math.max(1e-9, Math.min((right - left) / (box[1] - box[0]), (bottom - top) / (box[3] - box[2])));
    this.metre = metre;
    this.origin = [
      (left + right) / 2 - (metre * (box[0] + box[1])) / 2,
      (top + bottom) / 2 + (metre * (box[2] + box[3])) / 2,
    ];
    this.bar = { x: width - bar + 20, y: top + 8, width: 14, height: Math.max(40, bottom - top - 16) };
    this.drawFixed();
    this.draw();
  }

  toCanvas = ([x, y]) => [this.origin[0] + this.metre * x, this.origin[1] - this.metre * y];

  toBody = (x, y) => [(x - this.origin[0]) / this.metre, (this.origin[1] - y) / this.metre];

  // Mark the electrodes that are dead or drift, given by name.
  setHealth(dead, drifting) {
    if (String(dead) === String(this.dead) && String(drifting) === String(this.drifting)) return;
    Object.assign(this, { dead, drifting });
    if (this.scene) this.drawFixed();
  }

  // Store a picture to be drawn. A `past` picture, of the last minute, is not added to the paths of contacts.
  take(picture) {
    this.picture = picture;
    if (picture.pixels) {
      this.shown = picture;
      if (picture.past) this.scale.forget();
      this.scale.fit(picture.pixels, picture.second);
    }
    if (picture.past) return;
    for (const [x, y, , , track] of picture.markers) {
      if (track === null || track === undefined) continue;
      if (!this.paths.has(track)) this.paths.set(track, []);
      this.paths.get(track).push({ x, y, second: picture.second });
    }
    for (const [track, path] of this.paths) {
      while (path.length && path[0].second < picture.second - PATH_SECONDS) path.shift();
      if (!path.length) this.paths.delete(track);
    }
  }

  // Value of the displayed picture at a position on the body, or NaN.
  valueAt([x, y]) {
    const { shown, scene } = this;
    if (!shown?.pixels) return NaN;
    const [rows, columns] = shown.shape;
    const column = Math.floor(((x - scene.extent[0]) / (scene.extent[1] - scene.extent[0])) * columns);
    const row = Math.floor(((scene.extent[3] - y) / (scene.extent[3] - scene.extent[2])) * rows);
    return column >= 0 && column < columns && row >= 0 && row < rows ? shown.pixels[row * columns + column] : NaN;
  }

  // Label of the displayed marker near a position on the body, or "".
  labelAt(place) {
    const [left, top] = this.toCanvas(place);
    const near = ([x, y]) => Math.hypot(this.toCanvas([x, y])[0] - left, this.toCanvas([x, y])[1] - top) < 12;
    return this.picture?.markers.find(near)?.[2] ?? "";
  }

  draw() {
    const { pen, scene, inks } = this;
    pen.fillStyle = inks?.paper ?? "#ffffff";
    pen.fillRect(0, 0, this.width, this.height);
    if (!scene) return;
    this.drawPixels();
    const { lowest, highest, threshold } = this.scale;
    if (this.drawn !== String([lowest, highest, threshold])) this.drawFixed();
    pen.drawImage(this.fixed, 0, 0, this.width, this.height);
    this.drawRegions();
    if (this.picture) this.drawMarkers();
    this.drawWords();
  }

  curve(pen, points, closed = true) {
    points.forEach((point, at) => pen[at ? "lineTo" : "moveTo"](...this.toCanvas(point)));
    if (closed) pen.closePath();
  }

  drawPixels() {
    const { pen, scene, shown } = this;
    const clipped = scene.outline.length > 0;
    pen.save();
    if (clipped) {
      pen.beginPath();
      for (const curve of scene.outline) this.curve(pen, curve);
      pen.fillStyle = this.inks.body;
      pen.fill("evenodd");
      pen.clip("evenodd");
    }
    if (shown) {
      const [rows, columns] = shown.shape;
      if (this.small.width !== columns || this.small.height !== rows || !this.buffer) {
        this.small.width = columns;
        this.small.height = rows;
        this.buffer = new ImageData(columns, rows);
      }
      const between = this.smoothing !== "pixels";
      const values = between ? smooth(shown.pixels, shown.shape, Number(this.smoothing)) : shown.pixels;
      colour(clipped ? widen(values, shown.shape) : values, this.scale, this.table, this.inks.none, this.buffer.data);
      this.small.getContext("2d").putImageData(this.buffer, 0, 0);
      const [x, y] = this.toCanvas([scene.extent[0], scene.extent[3]]);
      const [right, bottom] = this.toCanvas([scene.extent[1], scene.extent[2]]);
      pen.imageSmoothingEnabled = between;
      pen.globalAlpha = this.stale() ? 0.25 : 1;
      pen.drawImage(this.small, x, y, right - x, bottom - y);
    }
    pen.restore();
  }

  // Whether the displayed image is older than the newest frame, because the newest frame was refused.
  stale() {
    return Boolean(this.picture && !this.picture.pixels && this.picture.second - this.shown?.second > STALE_SECONDS);
  }

  // Draw the outline, electrodes, scale bar and colour bar, which most pictures share.
  drawFixed() {
    const pen = this.fixed.getContext("2d");
    const { scene, inks, box } = this;
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.lineJoin = pen.lineCap = "round";
    pen.strokeStyle = inks.ink;
    pen.lineWidth = 1.5;
    for (const curve of scene.outline) {
      pen.beginPath();
      this.curve(pen, curve);
      pen.stroke();
    }
    const centre = this.toCanvas([(box[0] + box[1]) / 2, (box[2] + box[3]) / 2]);
    const named = this.room(scene.electrodes.length);
    scene.electrodes.forEach((curve, index) => this.drawElectrode(pen, curve, scene.names[index], centre, named));
    const length = round125(Math.min((box[1] - box[0]) / 3, 150 / this.metre));
    const [x, y] = [14, this.height - 12];
    pen.strokeStyle = pen.fillStyle = inks.ink;
    pen.lineWidth = 2;
    pen.lineCap = "butt";
    pen.beginPath();
    pen.moveTo(x, y - 4);
    pen.lineTo(x, y);
    pen.lineTo(x + length * this.metre, y);
    pen.lineTo(x + length * this.metre, y - 4);
    pen.stroke();
    pen.font = this.font(12);
    pen.textAlign = "left";
    pen.textBaseline = "alphabetic";
    const [number, unit] = length >= 1 ? [length, "m"] : [length * 1000, "mm"];
    pen.fillText(`${round(number)} ${unit}`, x, y - 7);
    this.drawBar(pen);
    this.drawn = String([this.scale.lowest, this.scale.highest, this.scale.threshold]);
  }

  // Whether there is room for a name at every electrode.
  room(count) {
    return count > 0 && (Math.PI * this.metre * (this.box[1] - this.box[0])) / count > 14;
  }

  font(size, weight = "") {
    return `${weight} ${size}px system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif`;
  }

  drawElectrode(pen, curve, name, centre, named) {
    const dead = this.dead.includes(name);
    const drifts = this.drifting.includes(name);
    const points = curve.map(this.toCanvas);
    const middle = [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
    // Discs lie on the image, so that a rim in the colour of the background separates them from the image's colours.
    const disc = Math.hypot(points[0][0] - points.at(-1)[0], points[0][1] - points.at(-1)[1]) < 2;
    for (const [ink, line] of [[this.inks.paper, disc ? 8 : 0], [dead || drifts ? this.inks.warn : this.inks.ink, 5]]) {
      if (!line) continue;
      pen.strokeStyle = ink;
      pen.lineWidth = line;
      pen.beginPath();
      this.curve(pen, curve, false);
      pen.stroke();
      pen.fillStyle = ink;
      if (disc) pen.fill();
    }
    const away = [middle[0] - centre[0], middle[1] - centre[1]];
    const distance = Math.hypot(...away) || 1;
    const above = Math.max(...points.map(([, y]) => middle[1] - y)) + 13;
    const at = disc ? [middle[0], middle[1] - above] : [0, 1].map((axis) => middle[axis] + (15 * away[axis]) / distance);
    pen.lineWidth = 2.5;
    if (dead) {
      pen.beginPath();
      for (const [x, y] of [[-6, -6], [-6, 6]]) {
        pen.moveTo(middle[0] + x, middle[1] + y);
        pen.lineTo(middle[0] - x, middle[1] - y);
      }
      pen.stroke();
    } else if (drifts) {
      pen.beginPath();
      [[0, -8], [8, 6], [-8, 6]].forEach(([x, y], index) => {
        pen[index ? "lineTo" : "moveTo"](middle[0] + x, middle[1] + y);
      });
      pen.closePath();
      pen.fillStyle = this.inks.paper;
      pen.fill();
      pen.stroke();
    }
    if (!name || !(named || dead || drifts)) return;
    pen.font = this.font(12, dead || drifts ? "bold" : "");
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    this.halo(name, ...at, dead || drifts ? this.inks.warn : disc ? this.inks.ink : this.inks.faint, pen);
  }

  drawRegions() {
    const { pen } = this;
    pen.font = this.font(13, "bold");
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    const shapes = this.lasso ? [...this.regions, { points: this.lasso, colour: 5, name: "" }] : this.regions;
    for (const { points, colour: index, name } of shapes) {
      pen.beginPath();
      this.curve(pen, points);
      pen.lineWidth = 4;
      pen.strokeStyle = this.inks.paper;
      pen.stroke();
      pen.lineWidth = 2;
      pen.strokeStyle = LINES[this.theme][index];
      pen.stroke();
      const middle = [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
      this.halo(name, ...this.toCanvas(middle), LINES[this.theme][index]);
    }
    if (!this.cross) return;
    const [x, y] = this.toCanvas(this.cross);
    pen.lineWidth = 2;
    pen.strokeStyle = this.inks.ink;
    pen.beginPath();
    for (const [right, down] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(x + 4 * right, y + 4 * down);
      pen.lineTo(x + 12 * right, y + 12 * down);
    }
    pen.stroke();
  }

  halo(text, x, y, ink, pen = this.pen) {
    pen.lineWidth = 4;
    pen.lineJoin = "round";
    pen.strokeStyle = this.inks.paper;
    pen.strokeText(text, x, y);
    pen.fillStyle = ink;
    pen.fillText(text, x, y);
  }

  drawMarkers() {
    const { pen, picture, inks } = this;
    if (!picture.past) {
      for (const path of this.paths.values()) {
        pen.beginPath();
        path.forEach(({ x, y }, at) => pen[at ? "lineTo" : "moveTo"](...this.toCanvas([x, y])));
        pen.lineWidth = 4;
        pen.strokeStyle = inks.paper;
        pen.stroke();
        pen.lineWidth = 2;
        pen.strokeStyle = inks.ink;
        pen.stroke();
      }
    }
    pen.font = this.font(13, "bold");
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    for (const [x, y, label, radius] of picture.markers) {
      const at = this.toCanvas([x, y]);
      if (radius > 0) {
        pen.beginPath();
        pen.arc(...at, radius * this.metre, 0, 2 * Math.PI);
        pen.setLineDash([5, 4]);
        pen.lineWidth = 1.5;
        pen.strokeStyle = inks.ink;
        pen.stroke();
        pen.setLineDash([]);
      }
      pen.beginPath();
      pen.arc(...at, 5, 0, 2 * Math.PI);
      pen.fillStyle = inks.ink;
      pen.fill();
      pen.lineWidth = 2;
      pen.strokeStyle = inks.paper;
      pen.stroke();
      if (label) this.halo(label.replace(/^-(?=\d)/, "−"), at[0] + 10, at[1] - 10, inks.ink);
    }
  }

  // Draw the colour bar with ticks at round values of the colour scale.
  drawBar(pen) {
    const { bar, scale, inks, scene } = this;
    const { factor, unit } = unitFor(Math.max(Math.abs(scale.highest), Math.abs(scale.lowest)), scene.unit);
    const span = scale.highest - scale.lowest;
    for (let row = 0; row < bar.height; row += 1) {
      const part = 1 - (row + 0.5) / bar.height;
      const entry = 3 * Math.min(255, Math.floor(256 * part));
      const hidden = hides(scale.lowest + part * span, scale);
      pen.fillStyle = hidden ? inks.body : `rgb(${this.table.subarray(entry, entry + 3).join(",")})`;
      pen.fillRect(bar.x, bar.y + row, bar.width, 1);
    }
    pen.lineWidth = 1;
    pen.strokeStyle = inks.faint;
    pen.strokeRect(bar.x + 0.5, bar.y + 0.5, bar.width - 1, bar.height - 1);
    pen.font = this.font(12);
    pen.textBaseline = "middle";
    pen.textAlign = "left";
    pen.fillStyle = inks.ink;
    for (const value of ticks(scale.lowest * factor, scale.highest * factor, bar.height > 240 ? 8 : 4)) {
      const y = bar.y + bar.height * (1 - (value / factor - scale.lowest) / span);
      pen.fillRect(bar.x + bar.width, Math.round(y), 4, 1);
      pen.fillText(round(value), bar.x + bar.width + 7, y);
    }
    pen.textAlign = "right";
    pen.textBaseline = "alphabetic";
    pen.fillText(`${scene.quantity}${unit ? ` / ${unit}` : ""}`, this.width - 8, 20);
  }

  drawWords() {
    const { pen, picture, inks } = this;
    if (!picture) return;
    pen.font = this.font(13, "bold");
    pen.textAlign = "left";
    pen.textBaseline = "alphabetic";
    pen.fillStyle = inks.ink;
    pen.fillText(`${picture.second.toFixed(picture.past ? 2 : 1)} s`, 12, 20);
  }
}
