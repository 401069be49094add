// The path of two axes with the error magnified, and a third axis as a bar.
"use strict";

const MAGNIFIED = [1, 10, 100, 1000, 10000];

const BESIDE = 96;  // px of the bar with its numbers

class PathPlot extends Plot {
  constructor(scope) {
    super(scope, {
      id: "path", title: "Path", unit: "µm", x: "path",
      lines: [["w0", "wanted", "--c-desired", [6, 4]], ["y0", "measured", "--c-measured"]],
    });
    this.factor = 1;
    this.picks = ["axis across", "axis up", "axis of the bar"].map(
      (label, i) => picker(label, (axis) => this.pick(i, axis)));
    const factors = picker("factor of the error", (factor) => {
      this.factor = +factor;
      this.scope.redraw();
      this.tell(this.scope.frame);
    });
    for (const factor of MAGNIFIED) factors.add(new Option(`error × ${factor}`, factor));
    this.head.append(...this.picks, factors);
  }

  get shown() { return this.scope.grid.classList.contains("with-path"); }

  // An axis that is shown elsewhere gives its place for the one that was here.
  pick(i, axis) {
    const path = [...this.scope.frame.path];
    const other = path.indexOf(axis);
    if (other >= 0 && other !== i) path[other] = path[i];
    path[i] = axis;
    this.scope.ask({ path: path.filter(Boolean) });
  }

  // What is drawn of axis i: where it shall be, and from there the error times the factor.
  magnified(arrays, i) {
    const w = arrays[`w${i}`], y = arrays[`y${i}`], { factor } = this;
    return factor === 1 ? y : y.map((v, j) => w[j] + factor * (v - w[j]));
  }

  // The square that is shown: its lower left corner and its side.
  square(frame, lines) {
    const areas = this.scope.fullVoltage ? this.corners(frame) : [];
    const ends = [0, 1].map((i) => this.extent(
      [frame.arrays[`w${i}`], lines[i], areas.map((corner) => corner[i])], false));
    if (!ends[0] || !ends[1]) return null;
    const side = Math.max(...ends.map(([low, high]) => high - low));
    return [...ends.map(([low, high]) => (low + high - side) / 2), side];
  }

  // Corners of the area in which the first two axes may be.
  corners(frame) {
    const [first, second] = frame.axes, told = frame.permitted || [], found = [];
    const at = [first, second].map((axis) => frame.path.indexOf(axis));
    if (Math.max(...at) > 1 || Math.min(...at) < 0) return found;
    for (let j = 0; j + 1 < told.length; j += 2) {
      const corner = [];
      corner[at[0]] = told[j];
      corner[at[1]] = told[j + 1];
      found.push(corner);
    }
    return found;
  }

  draw(frame, css) {
    if (!this.width) return this.fit();
    const { ctx } = this, { arrays, path } = frame;
    const ratio = window.devicePixelRatio || 1;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.fillStyle = css("--c-card");
    ctx.fillRect(0, 0, this.canvas.width, this.canvas.height);  // to its last, cut pixel
    const beside = path && path.length > 2 ? BESIDE : 0;
    const room = this.width - this.left - 8 - beside;
    const size = Math.min(room, this.height - this.top - this.bottom);
    if (size < 40) return;
    if (!path || !arrays.y0 || !arrays.y0.length) return this.nothing(ctx, css);
    const lines = [0, 1].map((i) => this.magnified(arrays, i));
    const key = `${path} ${this.factor}`;
    const square = this.square(frame, lines);
    if (!square) return this.nothing(ctx, css);
    if (this.scope.auto || !this.range || this.key !== key) this.range = square;
    this.key = key;
    const [x0, y0, side] = this.range;
    const left = this.left + (room - size) / 2, { top } = this;
    const px = (v) => left + (v - x0) / side * size;
    const py = (v) => top + size - (v - y0) / side * size;
    this.grid(ctx, css, path, [left, top, size]);
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, top, size, size);
    ctx.clip();
    this.area(ctx, css, frame, px, py);
    const dense = arrays.y0.length > 2 * size;
    this.trace(ctx, arrays.w0, arrays.w1, px, py, css("--c-desired"), dense ? [] : [6, 4]);
    this.trace(ctx, ...lines, px, py, css("--c-measured"), []);
    const last = arrays.y0.length - 1;
    this.spot(ctx, px(arrays.w0[last]), py(arrays.w1[last]), 7, css("--c-ink"), false);
    this.spot(ctx, px(arrays.y0[last]), py(arrays.y1[last]), 4, css("--c-error"), true);
    ctx.restore();
    this.scale(ctx, css, [left, top, size]);
    if (beside) this.bar(ctx, css, frame, left + size + 28, [top, size]);
  }

  trace(ctx, xs, ys, px, py, colour, dash) {
    let pen = false;
    ctx.strokeStyle = colour;
    ctx.lineWidth = 1.2;
    ctx.setLineDash(dash);
    ctx.beginPath();
    for (let j = 0; j < xs.length; j++) {
      if (!Number.isFinite(xs[j] + ys[j])) { pen = false; continue; }
      if (pen) ctx.lineTo(px(xs[j]), py(ys[j])); else ctx.moveTo(px(xs[j]), py(ys[j]));
      pen = true;
    }
    ctx.stroke();
    ctx.setLineDash([]);
  }

  spot(ctx, x, y, radius, colour, full) {
    if (!Number.isFinite(x + y)) return;
    ctx.beginPath();
    ctx.arc(x, y, radius, 0, 2 * Math.PI);
    ctx.lineWidth = 1.6;
    ctx[full ? "fillStyle" : "strokeStyle"] = colour;
    if (full) ctx.fill(); else ctx.stroke();
  }

  area(ctx, css, frame, px, py) {
    const corners = this.corners(frame);
    if (!corners.length) return;
    ctx.beginPath();
    for (const [x, y] of corners) ctx.lineTo(px(x), py(y));
    ctx.closePath();
    ctx.lineWidth = 1;
    ctx.setLineDash([3, 3]);
    ctx.strokeStyle = css("--c-limit");
    ctx.stroke();
    ctx.setLineDash([]);
  }

  // The same step on both axes: a square is a square.
  grid(ctx, css, path, [left, top, size]) {
    const [x0, y0, side] = this.range;
    ctx.font = css("--f-axis");
    ctx.lineWidth = 1;
    ctx.strokeStyle = css("--c-grid");
    ctx.fillStyle = css("--c-dim");
    ctx.beginPath();
    const count = Math.max(3, size / 60);
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    const [ys, digits] = steps(y0, y0 + side, count);
    for (const v of ys) {
      const y = top + size - (v - y0) / side * size;
      ctx.moveTo(left, y);
      ctx.lineTo(left + size, y);
      ctx.fillText(v.toFixed(digits), left - 6, y);
    }
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    const [xs, precise] = steps(x0, x0 + side, count);
    for (const v of xs) {
      const x = left + (v - x0) / side * size;
      ctx.moveTo(x, top);
      ctx.lineTo(x, top + size);
      ctx.fillText(v.toFixed(precise), x, top + size + 6);
    }
    ctx.stroke();
    ctx.strokeRect(left, top, size, size);
    ctx.fillStyle = css("--c-ink");
    ctx.textAlign = "right";
    ctx.textBaseline = "bottom";
    ctx.fillText(`${path[0]} (µm) →`, left + size - 6, top + size - 4);
    ctx.textAlign = "left";
    ctx.fillText(`↑ ${path[1]} (µm)`, left + 6, top + size - 4);
  }

  // What the factor makes of a length.
  scale(ctx, css, [left, top, size]) {
    ctx.font = css("--f-axis");
    let told = `error × ${this.factor}`;
    const more = `${told}: 1 µm here is ${1000 / this.factor} nm of error`;
    if (this.factor > 1 && ctx.measureText(more).width < size - 14) told = more;
    ctx.textAlign = "left";
    ctx.textBaseline = "top";
    ctx.fillStyle = css("--c-card");
    ctx.fillRect(left + 3, top + 2, ctx.measureText(told).width + 8, 18);
    ctx.fillStyle = css("--c-ink");
    ctx.fillText(told, left + 7, top + 5);
  }

  bar(ctx, css, frame, left, [top, size]) {
    const { w2, y2 } = frame.arrays, range = this.extent([w2, y2], false);
    if (!range) return;
    const [low, high] = range, last = y2.length - 1;
    const py = (v) => top + size - (v - low) / (high - low) * size;
    const own = this.extent([y2], false) || range;
    const [, digits] = steps(low, high, 4);
    ctx.fillStyle = css("--c-select");
    ctx.fillRect(left, py(own[1]), 14, py(own[0]) - py(own[1]));
    ctx.strokeStyle = css("--c-grid");
    ctx.strokeRect(left, top, 14, size);
    for (const [v, colour, width] of [[w2[last], "--c-ink", 1.6], [y2[last], "--c-error", 4]]) {
      if (!Number.isFinite(v)) continue;
      ctx.strokeStyle = css(colour);
      ctx.lineWidth = width;
      ctx.beginPath();
      ctx.moveTo(left - 4, py(v));
      ctx.lineTo(left + 18, py(v));
      ctx.stroke();
    }
    ctx.fillStyle = css("--c-dim");
    ctx.textAlign = "left";
    for (const [v, base] of [[high, "top"], [low, "bottom"]]) {
      ctx.textBaseline = base;
      ctx.fillText(v.toFixed(digits + 1), left + 22, py(v));
    }
    ctx.fillStyle = css("--c-ink");
    ctx.textBaseline = "top";
    ctx.fillText(`${frame.path[2]} (µm)`, left - 4, top + size + 6);
  }

  tell(frame) {
    const { axes, path, arrays } = frame;
    if (!path) return;
    this.picks.forEach((pick, i) => {
      pick.hidden = i > 1 && axes.length < 3;
      offer(pick, i > 1 ? [...axes, ""] : axes, path[i] || "");
    });
    ["w", "y"].forEach((name, j) => {
      const now = path.map((_, i) => (arrays[`${name}${i}`] || []).at(-1));
      this.told[j](now.map(shown).join(", "));
    });
    const label = `Path of ${path[1]} over ${path[0]} in µm, error times ${this.factor}`
      + (path[2] ? `, ${path[2]} as a bar` : "");
    if (this.label !== label) this.canvas.setAttribute("aria-label", this.label = label);
  }
}
