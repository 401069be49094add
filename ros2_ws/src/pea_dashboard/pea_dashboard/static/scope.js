// <pea-scope>: six plots of one window in time, fed by binary frames (see window.py).
"use strict";

const SPANS = [0.02, 0.1, 0.5, 1, 2, 5, 10, 60];
const PLOTS = [
  { id: "displacement", title: "Displacement", unit: "µm", x: "t",
    lines: [["w", "desired", "--c-desired", [6, 4]], ["y", "measured", "--c-measured"]] },
  { id: "error", title: "Error y − w", unit: "nm", x: "t",
    lines: [["e", "error", "--c-error"], ["rms", "running rms", "--c-rms"]] },
  { id: "voltage", title: "Voltage", unit: "V", x: "t", limits: true,
    lines: [["u_applied", "applied", "--c-truth", [6, 4]], ["u", "commanded", "--c-voltage"]] },
  { id: "eps", title: "Unknown input", unit: "V", x: "t",
    lines: [["eps", "true ε", "--c-truth", [6, 4]], ["eps_hat", "estimate ε̂", "--c-estimate"]] },
  { id: "loop", title: "Hysteresis loop", unit: "µm", x: "u_applied", xunit: "V",
    lines: [["y", "measured over applied voltage", "--c-measured"]] },
  { id: "spectrum", title: "Error spectrum", unit: "nm", x: "f", xunit: "Hz", log: true,
    lines: [["amplitude", "amplitude", "--c-error"]] },
];

const TELL_EVERY = 200;  // ms between two looks at the numbers, which nobody reads faster

const LATE = 3;  // s without a word, or without a new sample, after which a picture is old

const FRAMES = { drawn: 0, spent: 0, times: [], bytes: 0, last: null };
window.peaFrames = FRAMES;

function seconds(s) {
  return s < 1 ? `${Math.round(s * 1e3)} ms` : `${s} s`;
}

// A text node of its own: writing to it is cheap, while replacing it has the page looked through.
function text(box) {
  const node = document.createTextNode("");
  box.append(node);
  return (told) => { if (node.data !== told) node.data = told; };
}

function shown(value) {
  if (value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(2);
  return value.toFixed(size >= 100 ? 1 : size >= 10 ? 2 : 3);
}

function steps(low, high, count) {
  const raw = (high - low) / Math.max(count, 1);
  const unit = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * unit).find((s) => s >= raw) || raw;
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) found.push(i * step);
  return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
}

class Plot {
  constructor(scope, spec) {
    this.scope = scope;
    this.spec = spec;
    this.range = null;
    this.box = document.createElement("section");
    this.box.className = "plot";
    this.box.dataset.plot = spec.id;
    this.head = document.createElement("header");
    this.canvas = document.createElement("canvas");
    this.ctx = this.canvas.getContext("2d", { alpha: false });
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `${spec.title} in ${spec.unit}`);
    this.box.append(this.head, this.canvas);
    const title = document.createElement("b");
    title.textContent = `${spec.title} (${spec.unit})`;
    this.head.append(title);
    this.told = spec.lines.map(([, label, colour, dash]) => {
      const item = document.createElement("span");
      item.className = "line";
      const key = document.createElement("i");
      key.style.borderTopColor = `var(${colour})`;
      key.style.borderTopStyle = dash ? "dashed" : "solid";
      const value = document.createElement("em");
      item.append(key, `${label} `, value);
      this.head.append(item);
      return text(value);
    });
    this.watch = new ResizeObserver(() => this.fit());
    this.watch.observe(this.canvas);
    if (spec.x === "t") this.listen();
  }

  fit() {
    const ratio = window.devicePixelRatio || 1;
    const { width, height } = this.canvas.getBoundingClientRect();
    this.width = width;
    this.height = height;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.scope.restyle();  // a wall screen has larger letters
    if (width) this.draw(this.scope.frame, this.scope.css);  // now: it is blank
  }

  listen() {
    const at = (event) => {
      const x = event.offsetX - this.left;
      return Math.min(Math.max(x / (this.width - this.left - this.right), 0), 1);
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      this.scope.drag = { plot: this, from: at(event), to: at(event) };
    });
    this.canvas.addEventListener("pointermove", (event) => {
      this.scope.cursor = at(event);
      if (this.scope.drag) this.scope.drag.to = at(event);
      this.scope.redraw();
      this.scope.tell();
    });
    this.canvas.addEventListener("pointerup", () => {
      const drag = this.scope.drag;
      this.scope.drag = null;
      if (drag && Math.abs(drag.to - drag.from) > 0.01) this.scope.zoom(drag.from, drag.to);
      this.scope.redraw();
    });
    this.canvas.addEventListener("pointerleave", () => {
      this.scope.cursor = null;
      this.scope.redraw();
    });
    this.canvas.addEventListener("dblclick", () => this.scope.home());
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const factor = event.deltaY > 0 ? 1.25 : 0.8;
      const where = at(event);
      this.scope.zoom(where - where * factor, where + (1 - where) * factor);
    }, { passive: false });
  }

  get left() { return 58; }
  get right() { return 26; }
  get top() { return 8; }
  get bottom() { return 24; }

  extent(values, log) {
    let low = Infinity, high = -Infinity;
    for (const line of values) {
      if (!line) continue;
      for (const v of line) {
        if (!Number.isFinite(v) || (log && v <= 0)) continue;
        if (v < low) low = v;
        if (v > high) high = v;
      }
    }
    if (low > high) return null;
    if (log) {
      low = Math.log10(low); high = Math.log10(high);
      return [Math.max(Math.floor(low), high - 6), Math.ceil(high)];
    }
    const margin = (high - low) * 0.06 || Math.abs(high) * 0.05 || 1;
    return [low - margin, high + margin];
  }

  draw(frame, css) {
    if (!this.width) return this.fit();
    const { spec, ctx } = this;
    const ratio = window.devicePixelRatio || 1;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.fillStyle = css("--c-card");
    ctx.fillRect(0, 0, this.width, this.height);
    const inner = [this.width - this.left - this.right, this.height - this.top - this.bottom];
    if (inner[0] < 20 || inner[1] < 20) return;
    const arrays = frame.arrays;
    const xs = arrays[spec.x];
    const lines = spec.lines.map(([name]) => arrays[name]);
    if (!xs || !xs.length) return this.nothing(ctx, css);
    const x = spec.x === "t" ? [0, frame.span] : this.extent([xs], spec.log);
    const limits = spec.limits && frame.limits;
    let y = this.extent(lines, spec.log);
    if (!x || !y) return this.nothing(ctx, css);
    if (limits && this.scope.fullVoltage) y = this.extent([...lines, limits]);
    if (this.scope.auto || !this.range) this.range = y; else y = this.range;
    const px = (v) => this.left + ((spec.log ? Math.log10(v) : v) - x[0]) / (x[1] - x[0]) * inner[0];
    const py = (v) => this.top + inner[1] - ((spec.log ? Math.log10(v) : v) - y[0]) / (y[1] - y[0]) * inner[1];
    this.axes(ctx, css, frame, x, y, px, py);
    ctx.save();
    ctx.beginPath();
    ctx.rect(this.left, this.top, ...inner);
    ctx.clip();
    if (limits) {
      for (const limit of limits) this.level(ctx, py(limit), css("--c-limit"));
    }
    for (const [name, , colour, dash] of spec.lines) {
      const line = arrays[name];
      if (!line) continue;
      ctx.strokeStyle = css(colour);
      const dense = xs.length > 2 * inner[0];
      ctx.lineWidth = name === "rms" ? 2 : dense ? 1 : 1.4;  // hairlines are drawn much faster
      ctx.setLineDash(dense ? [] : dash || []);
      ctx.beginPath();
      if (dense && spec.x === "t") this.columns(ctx, xs, line, px, py);
      else this.points(ctx, xs, line, px, py);
      ctx.stroke();
    }
    ctx.setLineDash([]);
    ctx.restore();
    if (spec.x === "t") this.mark(ctx, css, inner);
  }

  points(ctx, xs, line, px, py) {
    let pen = false;
    for (let j = 0; j < xs.length; j++) {
      const v = line[j];
      if (!Number.isFinite(v) || (this.spec.log && (v <= 0 || xs[j] <= 0))) { pen = false; continue; }
      if (pen) ctx.lineTo(px(xs[j]), py(v)); else ctx.moveTo(px(xs[j]), py(v));
      pen = true;
    }
  }

  // Of each column of pixels the least and the greatest value, in their order.
  columns(ctx, xs, line, px, py) {
    let pen = false;
    for (let j = 0; j < xs.length;) {
      const column = Math.floor(px(xs[j]));
      let low = -1, high = -1;
      for (; j < xs.length && Math.floor(px(xs[j])) === column; j++) {
        if (!Number.isFinite(line[j])) continue;
        if (low < 0 || line[j] < line[low]) low = j;
        if (high < 0 || line[j] > line[high]) high = j;
      }
      if (low < 0) { pen = false; continue; }
      for (const at of low === high ? [low] : [Math.min(low, high), Math.max(low, high)]) {
        if (pen) ctx.lineTo(px(xs[at]), py(line[at])); else ctx.moveTo(px(xs[at]), py(line[at]));
        pen = true;
      }
    }
  }

  level(ctx, y, colour) {
    ctx.strokeStyle = colour;
    ctx.setLineDash([3, 3]);
    ctx.beginPath();
    ctx.moveTo(this.left, y);
    ctx.lineTo(this.width - this.right, y);
    ctx.stroke();
    ctx.setLineDash([]);
  }

  // The cursor, and what is being selected.
  mark(ctx, css, inner) {
    const { cursor, drag } = this.scope;
    if (cursor !== null) {
      const x = this.left + cursor * inner[0];
      ctx.strokeStyle = css("--c-dim");
      ctx.beginPath();
      ctx.moveTo(x, this.top);
      ctx.lineTo(x, this.top + inner[1]);
      ctx.stroke();
    }
    if (drag) {
      const [a, b] = [drag.from, drag.to].sort((p, q) => p - q);
      ctx.fillStyle = css("--c-select");
      ctx.fillRect(this.left + a * inner[0], this.top, (b - a) * inner[0], inner[1]);
    }
  }

  // The values at the cursor, or else the newest that are all there.
  tell(frame) {
    const { spec, scope } = this;
    if (spec.x !== "t") return;
    const xs = frame.arrays.t || [];
    const known = spec.lines.map(([name]) => frame.arrays[name])
      .filter((line) => line && line.some(Number.isFinite));
    let j = xs.length - 1;
    while (j > 0 && !known.every((line) => Number.isFinite(line[j]))) j--;
    if (scope.cursor !== null) {
      const t = scope.cursor * frame.span;
      j = 0;
      while (j < xs.length - 1 && xs[j] < t) j++;
    }
    spec.lines.forEach(([name], i) => {
      const line = frame.arrays[name];
      this.told[i](line && xs.length ? shown(line[j]) : "");
    });
  }

  axes(ctx, css, frame, x, y, px, py) {
    const { spec } = this;
    ctx.font = css("--f-axis");
    ctx.lineWidth = 1;
    ctx.strokeStyle = css("--c-grid");
    ctx.fillStyle = css("--c-dim");
    const height = this.height - this.top - this.bottom;
    const power = (range) => {
      const found = [];
      for (let p = Math.ceil(range[0]); p <= range[1]; p++) found.push(10 ** p);
      return [found, 0];
    };
    const [ys, digits] = spec.log ? power(y) : steps(y[0], y[1], Math.max(3, height / 32));
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    ctx.beginPath();
    for (const v of ys) {
      ctx.moveTo(this.left, py(v));
      ctx.lineTo(this.width - this.right, py(v));
      ctx.fillText(spec.log ? `${+v.toPrecision(1)}` : v.toFixed(digits), this.left - 6, py(v));
    }
    const start = spec.x === "t" ? frame.t0 : 0;
    const [ts, precise] = spec.log ? power(x)
      : steps(x[0] + start, x[1] + start, Math.max(2, (this.width - this.left) / 110));
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    for (const v of ts) {
      const at = px(spec.log ? v : v - start);
      ctx.moveTo(at, this.top);
      ctx.lineTo(at, this.height - this.bottom);
      const unit = spec.x === "t" ? "s" : spec.xunit;
      const told = !spec.log ? v.toFixed(precise) : v < 1000 ? `${v}` : `${v / 1000} k`;
      ctx.fillText(spec.log && v >= 1000 ? told + unit : `${told} ${unit}`, at, this.height - this.bottom + 6);
    }
    ctx.stroke();
  }

  nothing(ctx, css) {
    ctx.font = css("--f-axis");
    ctx.fillStyle = css("--c-dim");
    ctx.textAlign = "center";
    ctx.fillText(this.scope.word, this.width / 2, this.height / 2);
  }
}

class Scope extends HTMLElement {
  connectedCallback() {
    if (this.plots) return;
    this.view = { span: 1, end: null, source: this.getAttribute("source") || "" };
    this.auto = true;
    this.fullVoltage = false;
    this.cursor = null;
    this.drag = null;
    this.frame = { arrays: {}, span: 1 };
    this.word = "no samples yet";
    this.heard = performance.now();
    this.silent = 0;
    this.build();
    this.connect();
    this.tell();
    setInterval(() => this.tell(), TELL_EVERY);
    window.peaScope = this;
  }

  build() {
    const bar = document.createElement("nav");
    const button = (text, title, press) => {
      const made = document.createElement("button");
      made.type = "button";
      made.textContent = text;
      made.title = title;
      made.addEventListener("click", () => { press(made); made.blur(); });
      bar.append(made);
      return made;
    };
    this.pauseButton = button("Pause", "hold the picture; the loop goes on", () => this.pause());
    this.pauseButton.dataset.act = "pause";
    const spans = document.createElement("select");
    spans.title = "width of the window";
    spans.setAttribute("aria-label", spans.title);
    for (const span of SPANS) spans.add(new Option(seconds(span), span));
    this.own = new Option("", "");
    this.own.hidden = true;
    spans.add(this.own);
    spans.value = this.view.span;
    spans.addEventListener("change", () => { this.ask({ span: +spans.value }); spans.blur(); });
    bar.append(spans);
    this.spans = spans;
    this.autoButton = button("Autoscale", "fit the vertical axes to what is shown", () => {
      this.auto = !this.auto;
      this.autoButton.classList.toggle("on", this.auto);
      this.redraw();
    });
    this.autoButton.dataset.act = "autoscale";
    this.autoButton.classList.add("on");
    const limits = button("Limits", "show the voltage up to its limits", () => {
      this.fullVoltage = !this.fullVoltage;
      limits.classList.toggle("on", this.fullVoltage);
      this.redraw();
    });
    button("Reset zoom", "1 s, the newest samples (double click)", () => this.home());
    this.slider = document.createElement("input");
    this.slider.type = "range";
    this.slider.step = "any";
    this.slider.title = "look back";
    this.slider.setAttribute("aria-label", this.slider.title);
    this.slider.addEventListener("input", () => this.ask({ end: +this.slider.value }));
    bar.append(this.slider);
    const clock = document.createElement("span");
    clock.className = "clock";
    bar.append(clock);
    this.clock = text(clock);
    const grid = document.createElement("div");
    grid.className = "plots";
    this.plots = PLOTS.map((spec) => new Plot(this, spec));
    grid.append(...this.plots.map((plot) => plot.box));
    this.append(bar, grid);
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { this.word = "no samples yet"; this.send(); };
    socket.onmessage = (event) => this.take(event.data);
    socket.onclose = () => {
      this.word = "the dashboard does not answer; the loop goes on without it";
      this.clock(this.word);
      setTimeout(() => this.connect(), 1000);
    };
    this.socket = socket;
  }

  send() {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(this.view));
  }

  ask(change) {
    Object.assign(this.view, change);
    this.pauseButton.textContent = this.view.end === null ? "Pause" : "Live";
    this.pauseButton.classList.toggle("on", this.view.end !== null);
    const known = SPANS.includes(this.view.span);
    this.own.hidden = known;
    this.own.value = known ? "" : this.view.span;
    this.own.textContent = `${shown(this.view.span)} s`;
    this.spans.value = this.view.span;
    this.send();
  }

  open(source) {
    this.word = source ? "opening the recording" : "no samples yet";
    this.ask({ source, end: null });
  }

  pause() {
    this.ask({ end: this.view.end === null && this.frame.last ? this.frame.last : null });
  }

  home() { this.ask({ span: 1, end: null }); }

  zoom(from, to) {
    const { t0, span } = this.frame;
    if (t0 === undefined) return;
    const [a, b] = [Math.min(from, to), Math.max(from, to)];
    const width = Math.min(Math.max((b - a) * span, 5e-4), 600);
    this.ask({ span: width, end: t0 + a * span + width });
  }

  take(data) {
    const size = new DataView(data).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
    this.heard = performance.now();
    this.silent = head.beat ?? 0;
    if (head.beat !== undefined) return;  // nothing new
    let at = 4 + size;
    const arrays = {};
    for (const [name, count] of Object.entries(head.arrays)) {
      arrays[name] = new Float32Array(data, at, count);
      at += 4 * count;
    }
    if (!arrays.f && this.frame.arrays.f && head.run === this.frame.run) {
      arrays.f = this.frame.arrays.f;
      arrays.amplitude = this.frame.arrays.amplitude;
    }
    if (head.word) this.word = head.word;
    if (head.word && !Object.keys(arrays).length) this.clock(this.word);
    this.frame = { ...head, arrays };
    FRAMES.bytes += data.byteLength;
    this.redraw();
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.draw();
    });
  }

  get darkNow() { return document.body.classList.contains("body--dark"); }

  restyle() {
    const style = getComputedStyle(this), known = {};
    this.dark = this.darkNow;
    this.css = (name) => (known[name] ??= style.getPropertyValue(name).trim());
  }

  draw() {
    if (this.dark !== this.darkNow) this.restyle();
    const frame = this.frame, began = performance.now();
    for (const plot of this.plots) plot.draw(frame, this.css);
    FRAMES.spent += performance.now() - began;
    if (frame !== FRAMES.last) {
      FRAMES.last = frame;
      FRAMES.drawn++;
      const now = performance.now();
      FRAMES.times.push(now);
      while (FRAMES.times[0] < now - 5000) FRAMES.times.shift();
    }
  }

  // Seconds since the dashboard has said anything, and since the newest sample came.
  unheard() { return (performance.now() - this.heard) / 1e3; }

  age() {
    const silent = this.view.source || this.frame.last === undefined ? 0 : this.silent;
    return Math.max(this.unheard(), silent);
  }

  // What is read rather than watched: numbers, the clock, the slider's ends; another theme.
  tell() {
    const frame = this.frame;
    if (this.dark !== this.darkNow) this.redraw();
    for (const plot of this.plots) plot.tell(frame);
    const age = this.age();
    this.classList.toggle("old", age > LATE);
    document.body.classList.toggle("pea-unheard", this.unheard() > LATE);
    if (frame.last === undefined || this.socket.readyState !== WebSocket.OPEN) return;
    this.slider.min = frame.first;
    this.slider.max = frame.last;
    if (document.activeElement !== this.slider || this.view.end === null) {
      this.slider.value = this.view.end ?? frame.last;
    }
    if (age > LATE) return this.clock(`no new sample for ${Math.round(age)} s`);
    const rms = frame.rms_nm === null ? "–" : `${shown(frame.rms_nm)} nm`;
    this.clock(`t ${Math.min(frame.t0 + frame.span, frame.last).toFixed(3)} s · rms ${rms}`);
  }
}

customElements.define("pea-scope", Scope);
