// A plot of <pea-scope>: lines over time, or over something else.
"use strict";

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

// A choice with a name that is read out.
function picker(label, pick) {
  const made = document.createElement("select");
  made.title = label;
  made.setAttribute("aria-label", label);
  made.addEventListener("change", () => pick(made.value));
  return made;
}

// What may be chosen, and what is; the list is made anew where it is another one.
function offer(select, names, value) {
  if ([...select.options].map((each) => each.value).join() !== names.join()) {
    select.replaceChildren(...names.map((name) => new Option(name || "–", name)));
  }
  if (document.activeElement !== select || !names.includes(select.value)) select.value = value;
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
    if (spec.kinds) this.choose();
    this.watch = new ResizeObserver(() => this.fit());
    this.watch.observe(this.canvas);
    if (spec.x === "t") this.listen();
  }

  // One of several kinds of what stands over frequency.
  choose() {
    const { kinds, lines } = this.spec, title = this.head.querySelector("b");
    const items = [...this.head.querySelectorAll(".line")];
    const take = (kind) => {
      const [name, unit, own] = kinds[kind];
      title.textContent = `${name} (${unit})`;
      items.forEach((item, i) => { item.hidden = !own.includes(lines[i][0]); });
      this.canvas.setAttribute("aria-label", `${name} in ${unit}`);
    };
    const select = picker("what is shown over frequency", (kind) => {
      take(kind);
      this.scope.ask({ spectrum: kind });
    });
    for (const [kind, [name]] of Object.entries(kinds)) select.add(new Option(name, kind));
    this.head.append(select);
    take(Object.keys(kinds)[0]);
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

  get shown() { return true; }
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
    ctx.fillRect(0, 0, this.canvas.width, this.canvas.height);  // to its last, cut pixel
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
      if (name === "T" || name === "S") this.dots(ctx, xs, line, px, py);
      else if (dense && spec.x === "t") this.columns(ctx, xs, line, px, py);
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

  // Frequencies far apart are no line.
  dots(ctx, xs, line, px, py) {
    for (let j = 0; j < xs.length; j++) {
      if (!(line[j] > 0)) continue;
      ctx.moveTo(px(xs[j]) + 2, py(line[j]));
      ctx.arc(px(xs[j]), py(line[j]), 2, 0, 2 * Math.PI);
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
