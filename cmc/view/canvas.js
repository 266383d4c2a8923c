// Draws the frames of cmc.view.picture on HTML canvases, one per panel. Loads nothing.
//
// A frame is {serial, panels, text, time, data}: `panels` is a layout whose arrays are named by
// {at, shape} in `data`, a block of float32. Only the newest frame is ever drawn.

const FONT = "13px 'DejaVu Sans', 'Segoe UI', 'Helvetica Neue', Arial, sans-serif";
const SMALL = FONT.replace("13px", "12px");
const TINY = FONT.replace("13px", "10px");
const LIGHT = { paper: "#ffffff", ink: "#333333", faint: "#999999", grid: "#e4e4e4",
  axis: "#555555", cell: 247 };
const DARK = { paper: "#1b1e23", ink: "#d6dae0", faint: "#7d8590", grid: "#3a3f47",
  axis: "#9aa2ad", cell: 40 };
const LETTERS = {
  alpha: "α", beta: "β", gamma: "γ", delta: "δ", lambda: "λ", Lambda: "Λ", mu: "μ", omega: "ω",
  Omega: "Ω", phi: "φ", pi: "π", rho: "ρ", sigma: "σ", tau: "τ", theta: "θ", Theta: "Θ",
  partial: "∂", int: "∫", cdot: "·", le: "≤", ge: "≥", times: "×", ",": " ",
};

// ---- theme: that of the page, told from the color of its text

let theme = LIGHT;

const brightness = ([r, g, b]) => 0.3 * r + 0.59 * g + 0.11 * b;

function themeOf(node) {
  const text = getComputedStyle(node).color.match(/[\d.]+/g).map(Number);
  return brightness(text) > 140 ? DARK : LIGHT;
}

// Colors too dark for a dark page become lighter.
function shown(color) {
  if (theme === LIGHT || !/^#[0-9a-f]{6}$/i.test(color ?? "")) return color;
  const parts = [1, 3, 5].map((k) => parseInt(color.slice(k, k + 2), 16));
  const share = Math.max(0, Math.min(0.85, (110 - brightness(parts)) / 90));
  return `rgb(${parts.map((c) => Math.round(c + share * (255 - c))).join(",")})`;
}

// ---- text: `$y_1$`, `$\Lambda_{11}$` as runs of plain, raised and lowered pieces

function runs(label) {
  const out = [];
  String(label).split("$").forEach((part, k) => {
    if (k % 2 === 0) {
      if (part) out.push({ text: part, shift: 0, italic: false });
      return;
    }
    const dotted = part.replace(/\\dot\s*\{?([A-Za-z])\}?/g, "$1\u0307");
    const tokens = dotted.match(/\\[A-Za-z]+|\\,|[_^]\{[^}]*\}|[_^]\S|[^\\_^]\u0307?/g) || [];
    for (const token of tokens) {
      const shift = token[0] === "_" ? 1 : token[0] === "^" ? -1 : 0;
      const body = shift ? token.slice(1).replace(/[{}]/g, "") : token;
      const text = body.replace(/\\([A-Za-z]+|,)/g, (_, name) => LETTERS[name] ?? name);
      out.push({ text, shift, italic: !shift && /^[A-Za-z]\u0307?$/.test(text) });
    }
  });
  return out;
}

const plain = (label) => runs(label).map((run) => run.text).join("");

function setRun(ctx, run, base) {
  ctx.font = (run.italic ? "italic " : "") + (run.shift ? TINY : base);
}

function textWidth(ctx, label, base = FONT) {
  let width = 0;
  for (const run of runs(label)) {
    setRun(ctx, run, base);
    width += ctx.measureText(run.text).width;
  }
  return width;
}

function drawText(ctx, label, x, y, align = "left", base = FONT) {
  const width = textWidth(ctx, label, base);
  let at = align === "center" ? x - width / 2 : align === "right" ? x - width : x;
  ctx.textAlign = "left";
  for (const run of runs(label)) {
    setRun(ctx, run, base);
    ctx.fillText(run.text, at, y + 4 * run.shift);
    at += ctx.measureText(run.text).width;
  }
}

function drawUpwards(ctx, label, x, y) {
  ctx.save();
  ctx.translate(x, y);
  ctx.rotate(-Math.PI / 2);
  drawText(ctx, label, 0, 0, "center");
  ctx.restore();
}

// ---- axes

function ticks(low, high, count) {
  const raw = (high - low) / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(raw));
  return every([1, 2, 5, 10].find((m) => m * power >= raw) * power, low, high);
}

function logTicks(low, high) {
  const decades = Math.floor(high + 1e-9) - Math.ceil(low - 1e-9);
  return decades > 0 ? every(Math.ceil(decades / 5), low, high) : ticks(low, high, 3);
}

function every(step, low, high) {
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) out.push(k * step);
  return out;
}

function tickText(value, log) {
  if (log) {
    const power = String(value).replace("-", "−");
    return Number.isInteger(value) ? `$10^{${power}}$` : (10 ** value).toPrecision(2);
  }
  if (value === 0 || Math.abs(value) < 1e-12) return "0";
  const size = Math.abs(value), short = +value.toPrecision(6);
  const text = size >= 1e6 || size < 1e-3 ? short.toExponential() : String(short);
  return text.replace("e+", "e").replaceAll("-", "−");
}

class Axes {
  constructor(panel, width, height) {
    const top = panel.title ? 32 : 14;
    this.box = { left: 62, top, right: width - 14, bottom: height - 44 };
    [this.x0, this.x1] = panel.xlim;
    [this.y0, this.y1] = panel.log ? panel.ylim.map(Math.log10) : panel.ylim;
    this.log = panel.log;
    if (panel.equal) this.makeEqual();
    this.sx = (this.box.right - this.box.left) / (this.x1 - this.x0);
    this.sy = (this.box.bottom - this.box.top) / (this.y1 - this.y0);
  }

  makeEqual() {
    const w = this.box.right - this.box.left, h = this.box.bottom - this.box.top;
    const unit = Math.max((this.x1 - this.x0) / w, (this.y1 - this.y0) / h);
    const cx = (this.x0 + this.x1) / 2, cy = (this.y0 + this.y1) / 2;
    [this.x0, this.x1] = [cx - (unit * w) / 2, cx + (unit * w) / 2];
    [this.y0, this.y1] = [cy - (unit * h) / 2, cy + (unit * h) / 2];
  }

  x(value) {
    return this.box.left + (value - this.x0) * this.sx;
  }

  y(value) {
    return this.box.bottom - ((this.log ? Math.log10(value) : value) - this.y0) * this.sy;
  }

  draw(ctx, panel) {
    const { left, top, right, bottom } = this.box;
    const xs = ticks(this.x0, this.x1, (right - left) / 55);
    const ys = this.log ? logTicks(this.y0, this.y1) : ticks(this.y0, this.y1, (bottom - top) / 45);
    ctx.strokeStyle = theme.grid;
    ctx.lineWidth = 1;
    ctx.beginPath();
    for (const v of xs) { ctx.moveTo(this.x(v), top); ctx.lineTo(this.x(v), bottom); }
    const height = (v) => bottom - (v - this.y0) * this.sy;
    for (const v of ys) { ctx.moveTo(left, height(v)); ctx.lineTo(right, height(v)); }
    ctx.stroke();
    ctx.strokeStyle = theme.axis;
    ctx.beginPath();
    ctx.moveTo(left, top); ctx.lineTo(left, bottom); ctx.lineTo(right, bottom);
    ctx.stroke();
    ctx.fillStyle = theme.ink;
    for (const v of xs) drawText(ctx, tickText(v, false), this.x(v), bottom + 16, "center", SMALL);
    for (const v of ys) drawText(ctx, tickText(v, this.log), left - 6, height(v) + 4, "right", SMALL);
    drawText(ctx, panel.x, (left + right) / 2, bottom + 35, "center");
    drawUpwards(ctx, panel.y, 15, (top + bottom) / 2);
    drawText(ctx, panel.title, left, 19);
  }
}

// ---- layers: each draws one kind; `get` fetches a named array, `cursor` is the time index

const draw = {
  lines(ctx, ax, layer, get, cursor) {
    const x = get(layer.x), y = get(layer.y);
    const [count, length] = layer.y.shape;
    const shared = layer.x.shape.length === 1;
    const animated = cursor !== null && layer.head;
    ctx.lineWidth = layer.width ?? 1.4;
    ctx.setLineDash(layer.dash ? [6, 4] : []);
    const alpha = layer.alpha ?? Math.min(0.95, Math.max(0.3, 3 / Math.sqrt(count)));
    for (let k = 0; k < count; k++) {
      const xs = shared ? x : x.subarray(k * length, (k + 1) * length);
      const ys = y.subarray(k * length, (k + 1) * length);
      ctx.globalAlpha = animated ? 0.3 * alpha : alpha;
      trace(ctx, ax, xs, ys, length);
      if (animated) {
        ctx.globalAlpha = alpha;
        trace(ctx, ax, xs, ys, Math.min(cursor + 1, length));
        ctx.globalAlpha = 1;
        const at = Math.min(cursor, length - 1);
        marker(ctx, "dot", ax.x(xs[at]), ax.y(ys[at]), 4);
      }
    }
    ctx.setLineDash([]);
  },

  points(ctx, ax, layer, get, cursor) {
    let x = get(layer.x), y = get(layer.y);
    if (layer.x.shape.length === 2) {
      const [frames, count] = layer.x.shape;
      const at = Math.min(cursor ?? frames - 1, frames - 1) * count;
      x = x.subarray(at, at + count);
      y = y.subarray(at, at + count);
    }
    ctx.globalAlpha = layer.alpha ?? 0.9;
    ctx.lineWidth = 2;
    for (let k = 0; k < x.length; k++) {
      marker(ctx, layer.marker ?? "dot", ax.x(x[k]), ax.y(y[k]), layer.radius ?? 5);
    }
  },

  band(ctx, ax, layer, get) {
    const x = get(layer.x), low = get(layer.y), high = get(layer.y2);
    ctx.globalAlpha = layer.alpha;
    ctx.beginPath();
    for (let k = 0; k < x.length; k++) ctx.lineTo(ax.x(x[k]), ax.y(low[k]));
    for (let k = x.length - 1; k >= 0; k--) ctx.lineTo(ax.x(x[k]), ax.y(high[k]));
    ctx.fill();
  },

  shade(ctx, ax, layer) {
    const { left, top, right, bottom } = ax.box, across = layer.axis === "x";
    const at = (value, edge) => (value === null ? edge : ax[layer.axis](value));
    const [low, high] = layer.span;
    const [a, b] = across ? [at(low, left), at(high, right)] : [at(high, top), at(low, bottom)];
    ctx.globalAlpha = layer.alpha;
    ctx.fillRect(...(across ? [a, top, b - a, bottom - top] : [left, a, right - left, b - a]));
  },

  rule(ctx, ax, layer, get) {
    const { left, top, right, bottom } = ax.box, at = ax[layer.axis](get(layer.value)[0]);
    ctx.lineWidth = layer.width ?? 1.3;
    ctx.setLineDash(layer.dash ? [6, 4] : []);
    segment(ctx, ...(layer.axis === "x" ? [at, top, at, bottom] : [left, at, right, at]));
    ctx.setLineDash([]);
  },
};

function segment(ctx, x0, y0, x1, y1) {
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  ctx.stroke();
}

function trace(ctx, ax, xs, ys, length) {
  let open = false, lastX = 0, lastY = 0;
  ctx.beginPath();
  for (let k = 0; k < length; k++) {
    const px = ax.x(xs[k]), py = ax.y(ys[k]);
    if (!Number.isFinite(px + py)) { open = false; continue; }
    if (!open) ctx.moveTo(px, py);
    else if (Math.abs(px - lastX) + Math.abs(py - lastY) < 0.6 && k < length - 1) continue;
    else ctx.lineTo(px, Math.max(-1e5, Math.min(1e5, py)));
    [open, lastX, lastY] = [true, px, py];
  }
  ctx.stroke();
}

function marker(ctx, shape, x, y, r) {
  if (!Number.isFinite(x + y)) return;
  ctx.beginPath();
  if (shape === "cross") {
    ctx.moveTo(x - r, y - r); ctx.lineTo(x + r, y + r);
    ctx.moveTo(x - r, y + r); ctx.lineTo(x + r, y - r);
    ctx.stroke();
    return;
  }
  ctx.arc(x, y, r, 0, 2 * Math.PI);
  if (shape === "ring") ctx.stroke();
  else ctx.fill();
}

function mix(value, limit) {
  const share = Math.max(-1, Math.min(1, value / limit)) * 0.75;
  const strong = share < 0 ? [224, 130, 20] : [94, 76, 154];
  const base = theme.cell;
  return `rgb(${strong.map((c) => Math.round(base + (c - base) * Math.abs(share))).join(",")})`;
}

function drawCells(ctx, panel, layer, get, cursor, width, height) {
  const [rows, columns] = layer.values.shape.slice(-2);
  let values = get(layer.values);
  // One scale for all times, so that a color keeps its meaning while the time runs.
  const limit =
    values.reduce((a, v) => (Number.isFinite(v) ? Math.max(a, Math.abs(v)) : a), 1e-30);
  if (layer.values.shape.length === 3) {
    const at = Math.min(cursor ?? layer.values.shape[0] - 1, layer.values.shape[0] - 1);
    values = values.subarray(at * rows * columns, (at + 1) * rows * columns);
  }
  const top = panel.title ? 34 : 8, below = panel.x ? 26 : 8, beside = panel.y ? 26 : 8;
  const side = Math.min((width - beside - 8) / columns, (height - top - below) / rows);
  const left = beside + (width - beside - 8 - side * columns) / 2;
  for (let k = 0; k < values.length; k++) {
    const x = left + side * (k % columns), y = top + side * Math.floor(k / columns);
    const none = Number.isNaN(values[k]), zero = none || Math.abs(values[k]) <= 1e-6 * limit;
    ctx.fillStyle = mix(zero ? 0 : values[k], limit);
    if (!none) ctx.fillRect(x + 1, y + 1, side - 2, side - 2);
    ctx.fillStyle = zero ? theme.faint : theme.ink;
    const written = zero ? "0" : String(+values[k].toPrecision(2)).replace("-", "−");
    const text = none ? "–" : written;
    drawText(ctx, text, x + side / 2, y + side / 2 + 4, "center");
  }
  ctx.fillStyle = theme.ink;
  drawText(ctx, panel.title, 8, 19);
  drawText(ctx, panel.x, left + side * columns / 2, top + side * rows + 18, "center");
  drawUpwards(ctx, panel.y, left - 10, top + side * rows / 2);
}

// The corner of the axes in which the fewest points lie under the legend.
function legendCorner(ax, layers, get, width, height) {
  const { left, top, right, bottom } = ax.box;
  const corners = [
    [right - width, top + 2], [left + 4, top + 2],
    [right - width, bottom - height - 4], [left + 4, bottom - height - 4],
  ];
  const hits = [0, 0, 0, 0];
  for (const layer of layers) {
    if (layer.kind !== "lines" && layer.kind !== "points") continue;
    const x = get(layer.x), y = get(layer.y);
    const step = Math.max(1, Math.floor(y.length / 2000));
    for (let k = 0; k < y.length; k += step) {
      const px = ax.x(x[k % x.length]), py = ax.y(y[k]);
      corners.forEach(([cx, cy], c) => {
        if (px > cx && px < cx + width && py > cy && py < cy + height) hits[c] += 1;
      });
    }
  }
  return corners[hits.indexOf(Math.min(...hits))];
}

function drawLegend(ctx, ax, layers, get) {
  const named = layers.filter((layer) => layer.label);
  if (!named.length) return;
  const width = Math.max(...named.map((layer) => textWidth(ctx, layer.label, SMALL))) + 34;
  const [x, y] = legendCorner(ax, layers, get, width, 18 * named.length + 4);
  ctx.globalAlpha = 0.82;
  ctx.fillStyle = theme.paper;
  ctx.fillRect(x, y, width, 18 * named.length + 4);
  ctx.globalAlpha = 1;
  named.forEach((layer, k) => {
    const cy = y + 18 * k + 11;
    ctx.fillStyle = ctx.strokeStyle = shown(layer.color);
    ctx.lineWidth = 2.2;
    if (layer.kind === "points") marker(ctx, layer.marker ?? "dot", x + 14, cy, 4);
    else if (layer.kind === "band" || layer.kind === "shade") {
      ctx.globalAlpha = 0.35; ctx.fillRect(x + 5, cy - 5, 18, 10); ctx.globalAlpha = 1;
    } else {
      ctx.setLineDash(layer.dash ? [5, 3] : []);
      segment(ctx, x + 4, cy, x + 24, cy);
      ctx.setLineDash([]);
    }
    ctx.fillStyle = theme.ink;
    drawText(ctx, layer.label, x + 29, cy + 4, "left", SMALL);
  });
}

function drawPanel(canvas, panel, get, cursor) {
  const [width, height] = panel.size;
  const ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    canvas.style.width = `${width}px`;
    canvas.style.aspectRatio = `${width} / ${height}`;
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.globalAlpha = 1;
  ctx.lineJoin = "round";
  ctx.fillStyle = theme.paper;
  ctx.fillRect(0, 0, width, height);
  const matrix = panel.layers.find((layer) => layer.kind === "cells");
  if (matrix) {
    drawCells(ctx, panel, matrix, get, cursor, width, height);
    return;
  }
  const ax = new Axes(panel, width, height);
  ax.draw(ctx, panel);
  const { left, top, right, bottom } = ax.box;
  ctx.save();
  ctx.beginPath();
  ctx.rect(left, top, right - left, bottom - top);
  ctx.clip();
  for (const layer of panel.layers) {
    ctx.fillStyle = ctx.strokeStyle = shown(layer.color);
    ctx.globalAlpha = 1;
    draw[layer.kind](ctx, ax, layer, get, cursor);
  }
  ctx.restore();
  ctx.globalAlpha = 1;
  drawLegend(ctx, ax, panel.layers, get);
}

// ---- the widget

function element(tag, name, parent) {
  const node = document.createElement(tag);
  node.className = name;
  parent.append(node);
  return node;
}

function floats(data) {
  if (!data) return new Float32Array(0);
  const start = data.byteOffset ?? 0;
  // The bytes may begin anywhere in a message, and float32 views want multiples of four.
  return new Float32Array((data.buffer ?? data).slice(start, start + data.byteLength));
}

// The handles of ipywidgets' sliders have no name of their own: the label beside them is it.
function nameHandles() {
  for (const handle of document.querySelectorAll(".widget-slider .noUi-handle:not([aria-label])")) {
    const label = handle.closest(".widget-slider").querySelector(".widget-label");
    if (label?.textContent) handle.setAttribute("aria-label", label.textContent);
  }
}

class View {
  constructor(model, el) {
    this.model = model;
    this.root = element("div", "cmc-view", el);
    this.row = element("div", "cmc-panels", this.root);
    this.controls = element("div", "cmc-time", this.root);
    this.status = element("div", "cmc-status", this.root);
    this.note = element("div", "cmc-note", this.root);
    this.alert = element("div", "cmc-error", this.root);
    this.status.setAttribute("aria-live", "polite");
    this.note.setAttribute("role", "status");
    this.alert.setAttribute("role", "alert");
    this.canvases = [];
    this.cursor = this.playing = this.requested = null;
    this.addControls();
    const request = () => this.request(), say = () => this.showError();
    this.heard = [["change:frame", request], ["change:error", say], ["change:note", say]];
    for (const [event, act] of this.heard) model.on(event, act);
    // Pages switch between light and dark by attributes of their root or body.
    this.watch = new MutationObserver(request);
    for (const node of [document.documentElement, document.body]) {
      this.watch.observe(node, { attributes: true });
    }
    requestAnimationFrame(() => this.draw());  // in the page by then, and of its colors
    this.showError();
    for (const wait of [0, 500, 3000]) setTimeout(nameHandles, wait);
  }

  addControls() {
    this.button = element("button", "cmc-play", this.controls);
    this.button.type = "button";
    this.slider = element("input", "cmc-cursor", this.controls);
    this.slider.type = "range";
    this.slider.setAttribute("aria-label", "time cursor");
    this.clock = element("span", "cmc-clock", this.controls);
    this.button.addEventListener("click", () => (this.playing ? this.stop() : this.play()));
    this.slider.addEventListener("input", () => {
      this.stop();
      this.cursor = +this.slider.value;
      this.request();
    });
    // In a notebook a bare key is a command of the notebook unless it stays here.
    this.controls.addEventListener("keydown", (event) => event.stopPropagation());
    this.stop();
  }

  play() {
    let began = null; // a repaint's time stamp may lie before the click that asked for it
    const from = this.cursor >= +this.slider.max ? 0 : this.cursor;
    const step = (now) => {
      began ??= now;
      const last = +this.slider.max;
      this.cursor = Math.min(last, Math.round(from + ((now - began) / 5000) * last));
      this.draw();
      if (this.cursor >= last) this.stop();
      else this.playing = requestAnimationFrame(step);
    };
    this.playing = requestAnimationFrame(step);
    this.button.textContent = "❚❚ pause";
  }

  stop() {
    cancelAnimationFrame(this.playing);
    this.playing = null;
    this.button.textContent = "▶ play";
  }

  request() {
    // However many frames arrive before the next repaint, the newest alone is drawn.
    this.requested ??= requestAnimationFrame(() => {
      this.requested = null;
      this.draw();
    });
  }

  draw() {
    const frame = this.model.get("frame");
    if (!frame || !frame.panels) return;
    if (this.frame !== frame) {
      this.frame = frame;
      this.data = floats(frame.data);
      this.layout(frame);
    }
    theme = themeOf(this.root);
    const get = ({ at, shape }) => this.data.subarray(at, at + shape.reduce((a, b) => a * b, 1));
    frame.panels.forEach((panel, k) => drawPanel(this.canvases[k], panel, get, this.cursor));
    if (frame.time && this.cursor !== null) {
      const t = get(frame.time)[this.cursor];
      this.slider.value = this.cursor;
      this.clock.textContent = `t = ${t.toFixed(2)} s`;
      this.slider.setAttribute("aria-valuetext", this.clock.textContent);
    }
    this.root.dataset.serial = frame.serial;
  }

  layout(frame) {
    while (this.canvases.length < frame.panels.length) {
      const canvas = element("canvas", "cmc-panel", this.row);
      canvas.setAttribute("role", "img");
      this.canvases.push(canvas);
    }
    while (this.canvases.length > frame.panels.length) this.canvases.pop().remove();
    frame.panels.forEach((panel, k) => {
      const what = panel.title ? plain(panel.title) : `${plain(panel.y)} over ${plain(panel.x)}`;
      this.canvases[k].setAttribute("aria-label", `${what}. ${this.model.get("description")}`);
    });
    if (this.status.textContent !== frame.text) this.status.textContent = frame.text;
    this.controls.hidden = !frame.time;
    this.slider.max = (frame.time?.shape[0] ?? 1) - 1;  // a motion opens at its beginning
    this.cursor = frame.time && Math.min(this.cursor ?? 0, +this.slider.max);
  }

  showError() {
    const error = this.model.get("error");
    this.alert.textContent = error;
    this.alert.hidden = !error;
    this.note.textContent = this.model.get("note") ?? "";
    const stale = this.note.textContent && !this.model.get("table")?.words;
    this.row.classList.toggle("cmc-stale", Boolean(error || stale));
  }

  remove() {
    this.stop();
    this.watch.disconnect();
    cancelAnimationFrame(this.requested);
    for (const [event, act] of this.heard) this.model.off(event, act);
    this.root.remove();
  }
}

function render({ model, el }) {
  const view = new View(model, el);
  return () => view.remove();
}

export default { initialize, render };
