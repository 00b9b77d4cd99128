// The page: it draws the pictures and states of the session, and executes the user's commands or sends them to the
// session.

import { LINES } from "./colours.js";
import { Connection } from "./connection.js";
import { ImageView } from "./image.js";
import { short, unitFor } from "./numbers.js";
import { element, list, showState, write } from "./panel.js";
import { drawWith, mean, MOST_REGIONS } from "./regions.js";
import { Film, savePicture } from "./saving.js";
import { Traces } from "./traces.js";

const TRACE_PERIOD = 80;
const MINUTE = 60;
const MOST_CHANNELS = 5;
// Beginnings of the session's messages that a recording could not begin.
const FAILED = ["The recording cannot begin", "There is nowhere to record to"];

const view = new ImageView(element("image"));
const traces = { regions: new Traces(element("regions-trace")), channels: new Traces(element("channels-trace")) };
const page = { paused: false, newest: null, latest: null, shown: null, rate: 0, hidden: false, tracedAt: 0, said: "", failures: null };
const channels = [];

// ---- drawing: the newest picture at each refresh of the screen; its number is then reported to the session ----

const painted = new MessageChannel();
painted.port1.onmessage = ({ data }) => {
  connection.send({ do: "drawn", number: data, hidden: page.hidden });
  page.hidden = document.hidden;
};
let asked = false;

function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(drawNow);
}

function drawNow(now) {
  asked = false;
  const picture = page.latest;
  page.latest = null;
  if (picture) view.take(picture);
  view.draw();
  if (picture) {
    page.shown = picture;
    view.canvas.dataset.number = picture.number;
    view.canvas.dataset.second = picture.second;
    showLimits();
    showAgo();
    if (!picture.past) painted.port2.postMessage(picture.number);
  }
  if (now - page.tracedAt >= TRACE_PERIOD) {
    page.tracedAt = now;
    drawTraces();
    if (page.place) showValue();
  }
  showBanner();
}

function drawTraces() {
  const size = view.scale ? Math.max(Math.abs(view.scale.lowest), Math.abs(view.scale.highest)) : 1;
  const { factor, unit } = unitFor(size, view.scene?.unit ?? "");
  write("regions-unit", view.regions.length && unit ? `mean, ${unit}` : "");
  if (view.regions.length) traces.regions.draw(view.theme, factor);
  if (channels.length) traces.channels.draw(view.theme);
}

function showBanner() {
  let text = "";
  if (page.lost) text = page.lost;
  else if (page.note && performance.now() < page.noteUntil) text = page.note;
  else if (view.stale()) text = `Refused: ${view.picture.reason}`;
  if (text !== page.said) {
    page.said = text;
    write("banner", text).hidden = !text;
  }
}

// Show a sentence over the image for some seconds.
function note(text, seconds = 4) {
  page.note = text;
  page.noteUntil = performance.now() + 1000 * seconds;
  redraw();
  setTimeout(showBanner, 1000 * seconds + 100);
}

// Show once why a recording could not begin; `failures` is null until the earlier messages are known.
function noteFailure(messages) {
  const failed = messages.filter(({ text }) => FAILED.some((beginning) => text.startsWith(beginning)));
  const newest = failed.at(-1)?.second ?? -Infinity;
  if (page.failures !== null && newest > page.failures) note(failed.at(-1).text, 8);
  page.failures = newest;
}

document.addEventListener("visibilitychange", () => {
  page.hidden = true;
  redraw();
});

// ---- messages from the session ----

function takePicture(picture) {
  if (picture.past) {
    page.latest = picture;
    redraw();
    return;
  }
  page.newest = picture;
  for (const region of view.regions) {
    traces.regions.add(region.name, region.colour, picture.second, mean(region, picture, view.scene.extent));
  }
  for (const channel of channels) {
    const value = picture.values[channel.index] ?? NaN;
    if (channel.base === null && Math.abs(value) > 0) channel.base = value;
    traces.channels.add(channel.name, channel.colour, picture.second, (100 * (value - channel.base)) / Math.abs(channel.base));
  }
  if (page.paused) return;
  page.latest = picture;
  redraw();
}

const connection = new Connection({
  found() {
    page.lost = "";
    if (page.paused) connection.send({ do: "follow", on: false });
  },
  lost(reason) {
    page.lost = reason;
    write("connection", "not connected").dataset.state = "waiting";
    redraw();
  },
  scene(scene) {
    page.failures = null;
    write("title", scene.title);
    document.title = `${scene.title} – jeit live`;
    view.setScene(scene);
    view.scale.threshold = Number(element("threshold").value) / 100;
    list("notes", scene.notes);
    element("channel-names").replaceChildren(...scene.channels.map((name) => new Option(name)));
    redraw();
  },
  picture: takePicture,
  state(state) {
    page.rate = state.rate;
    showState(state);
    noteFailure(state.messages);
    view.setHealth(state.dead, state.drifting);
    const marks = state.messages.filter(({ text }) => text.startsWith("Event")).map(({ second }) => second);
    traces.regions.events = traces.channels.events = marks;
    redraw();
  },
  answer({ to, problem }) {
    if (problem) note(`${to === "show" ? "" : `${to}: `}${problem}`);
  },
});

// ---- pausing, and stepping through the last minute ----

const span = () => Math.max(1, Math.round(MINUTE * (page.rate || 1)));

function pause(on) {
  if (page.paused === on) return;
  page.paused = on;
  element("pause").setAttribute("aria-pressed", on);
  write("pause", on ? "Go on" : "Pause");
  connection.send({ do: "follow", on: !on });
  if (!on) {
    page.latest = page.newest;
    view.scale?.forget();
    redraw();
  }
  showAgo();
}

function showAgo() {
  const ago = page.paused && page.newest && page.shown ? page.shown.second - page.newest.second : 0;
  if (document.activeElement !== element("when") || !page.paused) element("when").value = ago;
  write("ago", page.paused ? `${ago.toFixed(2).replace("-", "−")} s` : "now");
}

function step(by) {
  if (!page.shown) return;
  pause(true);
  const number = Math.max(0, page.shown.number + by);
  connection.send({ do: "show", number, direction: by < 0 ? -1 : 1 });
}

element("pause").onclick = () => pause(!page.paused);
element("back").onclick = (event) => step(event.shiftKey ? -10 : -1);
element("on").onclick = (event) => step(event.shiftKey ? 10 : 1);
element("when").oninput = ({ target }) => {
  if (!page.newest) return;
  pause(true);
  const number = Math.max(0, Math.round(page.newest.number + (Number(target.value) / MINUTE) * span()));
  connection.send({ do: "show", number, direction: Number(target.value) > -MINUTE / 2 ? -1 : 1 });
};

// ---- reference, events, recording ----

element("reference").onclick = () => {
  const count = Number(element("count").value);
  if (!Number.isInteger(count) || count < 1 || count > 10000) {
    note("New reference: the number of frames is a whole number from 1 to 10000.");
    return;
  }
  connection.send({ do: "reference", count });
  view.scale?.forget();
  for (const channel of channels) channel.base = null;
  note(`New reference: the mean of the next ${count} frames. Keep the sensor undisturbed.`);
};
element("mark").onclick = () => connection.send({ do: "mark", label: element("label").value.trim() || "event" });
element("label").addEventListener("keydown", ({ key, target }) => {
  if (key === "Enter") element("mark").click();
  if (key === "Enter" || key === "Escape") target.blur();
});
element("record").onclick = () => {
  connection.send({ do: "record", on: element("record").getAttribute("aria-pressed") !== "true" });
};

// ---- colours, smoothing, threshold, theme ----

function showLimits() {
  element("fit").setAttribute("aria-pressed", view.scale.fitted);
  const { factor, unit } = unitFor(view.scale.highest, view.scene.unit);
  write("limit-unit", unit);
  const field = element("limit");
  const text = short(view.scale.highest * factor);
  if (document.activeElement !== field && field.value !== text) field.value = text;
}

element("fit").onclick = () => {
  if (!view.scale) return;
  if (view.scale.fitted) view.scale.keep(view.scale.highest);
  else Object.assign(view.scale, { fitted: true }).forget();
  if (view.shown) view.scale.fit(view.shown.pixels, view.shown.second);
  showLimits();
  redraw();
};
element("limit").onchange = ({ target }) => {
  if (!view.scale) return;
  const { factor } = unitFor(view.scale.highest, view.scene.unit);
  const typed = target.value.replaceAll("−", "-").replace(",", ".").trim();
  if (!typed || !view.scale.keep(Number(typed) / factor)) note("Colour scale: type a number above its lowest value.");
  target.blur();
  showLimits();
  redraw();
};
element("threshold").oninput = ({ target }) => {
  if (view.scale) view.scale.threshold = Number(target.value) / 100;
  write("threshold-value", `${target.value} %`);
  redraw();
};
element("smoothing").onchange = ({ target }) => {
  view.smoothing = target.value;
  redraw();
};

const dark = matchMedia("(prefers-color-scheme: dark)");

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  view.setTheme(theme);
  showRegions();
  showChannels();
  redraw();
}

element("theme").onclick = () => setTheme(view.theme === "dark" ? "light" : "dark");
dark.onchange = () => setTheme(dark.matches ? "dark" : "light");

// ---- regions and channels to follow ----

const freeColour = (taken) => [0, 1, 2, 3, 4].find((index) => !taken.some(({ colour }) => colour === index));

function legend(id, entries, remove) {
  element(id).replaceChildren(...entries.map((entry) => {
    const item = document.createElement("li");
    const swatch = document.createElement("i");
    swatch.style.background = LINES[view.theme][entry.colour];
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = "×";
    button.className = "quiet";
    button.setAttribute("aria-label", `Stop following ${entry.name}`);
    button.onclick = () => remove(entry);
    item.append(swatch, entry.name, button);
    return item;
  }));
  element(`${id}-trace`).hidden = !entries.length;
}

function showRegions() {
  legend("regions", view.regions, (region) => {
    view.regions.splice(view.regions.indexOf(region), 1);
    traces.regions.remove(region.name);
    showRegions();
    redraw();
  });
}

function showChannels() {
  legend("channels", channels, (channel) => {
    channels.splice(channels.indexOf(channel), 1);
    traces.channels.remove(channel.name);
    showChannels();
    redraw();
  });
}

function addRegion(points) {
  const colour = freeColour(view.regions);
  if (view.regions.length >= MOST_REGIONS || colour === undefined) {
    note(`${MOST_REGIONS} regions are followed already: remove one first.`);
    return;
  }
  const region = { name: "ABCDE"[colour], colour, points };
  if (view.shown && Number.isNaN(mean(region, view.shown, view.scene.extent))) {
    note("No region: nothing of the image lies in it.");
    return;
  }
  view.regions.push(region);
  showRegions();
}

element("choose").onsubmit = (event) => {
  event.preventDefault();
  const typed = element("channel").value.trim();
  const names = view.scene?.channels ?? [];
  const count = page.newest?.values.length ?? names.length;
  const named = names.indexOf(typed);
  const index = named >= 0 ? named : /^\d+$/.test(typed) ? Number(typed) - 1 : -1;
  const colour = freeColour(channels);
  if (index < 0 || index >= count) note(`Channel: a number from 1 to ${count}, or a name of the list.`);
  else if (channels.length >= MOST_CHANNELS || colour === undefined) note("Five channels are followed already: remove one first.");
  else if (!channels.some((channel) => channel.index === index)) {
    channels.push({ index, colour, base: null, name: names[index] ?? `channel ${index + 1}` });
    element("channel").value = "";
    showChannels();
  }
};

drawWith(view, {
  add: addRegion,
  redraw,
  point(place) {
    page.place = place;
    showValue();
  },
});

// Show the value under the mouse or the cross.
function showValue() {
  if (!page.place || !view.scene) {
    write("readout", "Drag on the image to follow a region; point to read a value.");
    return;
  }
  const value = view.valueAt(page.place);
  const { factor, unit } = unitFor(Math.max(Math.abs(view.scale.highest), Math.abs(view.scale.lowest)), view.scene.unit);
  const [x, y] = page.place.map((metres) => (1000 * metres).toFixed(1).replace("-", "−"));
  const text = `x ${x} mm, y ${y} mm: ${Number.isNaN(value) ? "outside" : `${short(value * factor)} ${unit}`}`;
  const label = view.labelAt(page.place);
  write("readout", /^[+-]\d+ %$/.test(label) ? `${text}; marker: ${label.replace("-", "−")} of background` : text);
}

// ---- pictures and films ----

const film = new Film(view.canvas, (on, saved) => {
  element("film").setAttribute("aria-pressed", on);
  write("film", on ? "Stop film" : "Film");
  if (saved) note(`Saved ${saved}.`);
});
element("film").disabled = !film.possible;
if (!film.possible) element("film").title = "This browser makes no films.";
element("film").onclick = () => film.toggle();
element("save").onclick = () => {
  view.draw();
  savePicture(view.canvas, (saved) => note(saved ? `Saved ${saved}.` : "The browser could not make the picture."));
};

// ---- keys ----

element("help").onclick = () => element("keys").showModal();

function threshold(by) {
  element("threshold").value = Number(element("threshold").value) + by;
  element("threshold").dispatchEvent(new Event("input"));
}

const KEYS = {
  " ": () => pause(!page.paused),
  ArrowLeft: ({ shiftKey }) => step(shiftKey ? -10 : -1),
  ArrowRight: ({ shiftKey }) => step(shiftKey ? 10 : 1),
  n: () => element("reference").click(),
  r: () => element("record").click(),
  m: () => element("mark").click(),
  f: () => element("fit").click(),
  s: () => element("save").click(),
  v: () => element("film").click(),
  l: () => element("theme").click(),
  "[": () => threshold(-5),
  "]": () => threshold(5),
  "?": () => element("help").click(),
};

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat && !event.key.startsWith("Arrow")) return;
  if (event.target.closest("input, select, textarea, dialog") || event.target.matches("button") && event.key === " ") return;
  const action = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!action) return;
  event.preventDefault();
  action(event);
});

new ResizeObserver(() => view.resize()).observe(view.canvas);
setTheme(dark.matches ? "dark" : "light");
