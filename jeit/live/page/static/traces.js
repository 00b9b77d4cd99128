// Lines of values over the last half minute, drawn in a canvas.

import { LINES } from "./colours.js";
import { round, ticks } from "./numbers.js";

const SPAN = 30;
const KEPT = 60;
// Seconds without a value, as during a pause, after which a line is interrupted.
const GAP = 1;

export class Traces {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d", { alpha: false });
    this.series = new Map();
    this.events = [];
    this.newest = 0;
  }

  // Add a value to the line named `key`; `colour`: index of the line's colour in `LINES`.
  add(key, colour, second, value) {
    if (!this.series.has(key)) this.series.set(key, { colour, points: [] });
    const { points } = this.series.get(key);
    if (points.length && second < points[points.length - 1][0]) points.length = 0;
    if (points.length && second - points.at(-1)[0] > GAP) points.push([points.at(-1)[0], NaN]);
    points.push([second, value]);
    if (points[0][0] < second - KEPT - 10) this.series.get(key).points = points.filter(([at]) => at >= second - KEPT);
    this.newest = second;
  }

  remove(key) {
    this.series.delete(key);
  }

  draw(theme, factor = 1) {
    const { canvas, pen } = this;
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const style = getComputedStyle(document.documentElement);
    const [paper, ink, faint] = ["--paper", "--faint", "--line"].map((name) => style.getPropertyValue(name).trim());
    pen.fillStyle = paper;
    pen.fillRect(0, 0, width, height);
    const plot = { left: 46, right: width - 6, top: 6, bottom: height - 18 };
    const first = this.newest - SPAN;
    const [lowest, highest] = this.range(first, factor);
    const toX = (second) => plot.left + ((second - first) / SPAN) * (plot.right - plot.left);
    const toY = (value) => plot.bottom - ((value - lowest) / (highest - lowest)) * (plot.bottom - plot.top);
    pen.font = '11px system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (const value of ticks(lowest, highest, 4)) {
      const y = Math.round(toY(value)) + 0.5;
      this.line(faint, [[plot.left, y], [plot.right, y]]);
      pen.fillStyle = ink;
      pen.fillText(round(value), plot.left - 5, y);
    }
    pen.textBaseline = "alphabetic";
    for (const ago of [30, 20, 10, 0]) {
      pen.textAlign = ago === 0 ? "right" : ago === 30 ? "left" : "center";
      pen.fillText(ago ? `−${ago} s` : "now", toX(this.newest - ago), height - 4);
    }
    pen.save();
    pen.beginPath();
    pen.rect(plot.left, 0, plot.right - plot.left, height);
    pen.clip();
    pen.setLineDash([3, 3]);
    for (const second of this.events) {
      if (second >= first) this.line(ink, [[toX(second), plot.top], [toX(second), plot.bottom]]);
    }
    pen.setLineDash([]);
    pen.lineWidth = 2;
    pen.lineJoin = "round";
    for (const { colour, points } of this.series.values()) {
      this.line(LINES[theme][colour], this.thinned(points, first, toX).map(([x, value]) => [x, toY(value * factor)]));
    }
    pen.restore();
  }

  // Lowest and highest drawn value, extended by a margin that is never zero.
  range(first, factor) {
    let [lowest, highest] = [Infinity, -Infinity];
    for (const { points } of this.series.values()) {
      for (const [second, value] of points) {
        if (second < first || Number.isNaN(value)) continue;
        lowest = Math.min(lowest, value * factor);
        highest = Math.max(highest, value * factor);
      }
    }
    if (lowest > highest) return [0, 1];
    const room = 0.08 * (highest - lowest) || 1e-5 * Math.abs(highest) || 1;
    return [lowest - room, highest + room];
  }

  // Reduce the points to the minimum and the maximum of each column of pixels; NaN is a gap.
  thinned(points, first, toX) {
    const kept = [];
    let column = null;
    for (const [second, value] of points) {
      if (second < first) continue;
      const x = Math.round(toX(second));
      if (Number.isNaN(value)) {
        column = null;
        kept.push([x, NaN]);
      } else if (column && column.x === x) {
        column.low[1] = Math.min(column.low[1], value);
        column.high[1] = Math.max(column.high[1], value);
      } else {
        column = { x, low: [x, value], high: [x, value] };
        kept.push(column.low, column.high);
      }
    }
    return kept;
  }

  line(ink, points) {
    const { pen } = this;
    let down = false;
    pen.beginPath();
    for (const [x, y] of points) {
      if (Number.isNaN(y)) {
        down = false;
        continue;
      }
      pen[down ? "lineTo" : "moveTo"](x, y);
      down = true;
    }
    pen.strokeStyle = ink;
    pen.stroke();
  }
}
