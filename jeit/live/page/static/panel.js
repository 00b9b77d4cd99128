// The state of the session as text: rates, quality, reasons for refused frames, events and the recording.

import { bytes, milliseconds, percent, short } from "./numbers.js";

export const element = (id) => document.getElementById(id);

export function write(id, text) {
  const target = element(id);
  if (target.textContent !== text) target.textContent = text;
  return target;
}

// Keep each number and its percent sign on one line.
const unbroken = (text) => text.replaceAll(" %", "\u00a0%");

// Replace the lines of a list if they have changed.
export function list(id, lines, make = null) {
  const target = element(id);
  const key = JSON.stringify(lines);
  if (target.dataset.key === key) return;
  target.dataset.key = key;
  target.replaceChildren(...lines.map((line) => {
    const item = document.createElement("li");
    if (make) make(item, line);
    else item.textContent = unbroken(line);
    return item;
  }));
}

const COLOURS = { connected: "good", ended: "done" };

export function showState(state) {
  write("connection", state.connection).dataset.state = COLOURS[state.connection] ?? "waiting";
  write("rate", `${short(state.rate)} /s`);
  write("drawn", `${short(state.drawn.rate)} /s`);
  const { latency_median: median, latency_99: worst } = state.drawn;
  Object.assign(element("latency").dataset, { median, worst });
  write("latency", median === null ? "–" : `${milliseconds(median)} (99 %: ${milliseconds(worst)})`);
  write("dropped", String(state.dropped));
  write("refused", String(state.refused)).dataset.warn = state.refused > 0;
  write("noise", percent(state.noise));
  write("reciprocity", percent(state.reciprocity));
  write("dead", state.dead.join(", ") || "none").dataset.warn = state.dead.length > 0;
  write("drifting", state.drifting.join(", ") || "none").dataset.warn = state.drifting.length > 0;
  list("reasons", Object.entries(state.reasons), (item, [reason, count]) => {
    item.textContent = `${count} × ${reason}`;
  });
  list("messages", state.messages.slice().reverse(), (item, { second, text }) => {
    const time = document.createElement("time");
    time.textContent = `${second.toFixed(1)} s`;
    item.append(time, unbroken(text));
  });
  showRecording(state.recording);
}

function showRecording(recording) {
  const on = Boolean(recording?.folder);
  element("record").setAttribute("aria-pressed", on);
  write("record", on ? "Stop recording" : "Record");
  const target = element("recording");
  target.dataset.warn = Boolean(recording?.problem);
  target.title = recording?.folder ?? "";
  const sum = recording?.folder ? `${recording.frames} frames, ${bytes(recording.bytes)}` : "not recording";
  write("recording", recording?.problem ? `${sum}: ${recording.problem}` : sum);
}
