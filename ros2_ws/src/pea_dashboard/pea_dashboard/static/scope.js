// <pea-scope>: plots of one window in time, fed by binary frames (see window.py).
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
    lines: [["amplitude", "amplitude", "--c-error"], ["density", "density", "--c-error"],
            ["T", "y/w", "--c-measured"], ["S", "error/w", "--c-error"]],
    kinds: {
      amplitude: ["Error spectrum", "nm", ["amplitude"]],
      density: ["Noise density", "nm/√Hz", ["density"]],
      response: ["Response", "1", ["T", "S"]],
    } },
];

const TELL_EVERY = 200;  // ms between two looks at the numbers, which nobody reads faster

const LATE = 3;  // s without a word, or without a new sample, after which a picture is old

const FRAMES = { drawn: 0, spent: 0, times: [], bytes: 0, last: null };
window.peaFrames = FRAMES;

function pressed(button, on) {
  button.classList.toggle("on", on);
  button.setAttribute("aria-pressed", on);
}

class Scope extends HTMLElement {
  connectedCallback() {
    if (this.plots) return;
    this.view = {
      span: 1, end: null, source: this.getAttribute("source") || "", axis: "", path: [],
      spectrum: "amplitude",
    };
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
      made.addEventListener("click", (event) => {
        press(made);
        if (event.detail) made.blur();  // by the keyboard its place is kept
      });
      bar.append(made);
      return made;
    };
    this.pauseButton = button("Pause", "hold the picture; the loop goes on", () => this.pause());
    this.pauseButton.dataset.act = "pause";
    const spans = picker("width of the window", (value) => this.ask({ span: +value }));
    for (const span of SPANS) spans.add(new Option(seconds(span), span));
    this.own = new Option("", "");
    this.own.hidden = true;
    spans.add(this.own);
    spans.value = this.view.span;
    this.axis = picker("axis of the recording", (axis) => this.ask({ axis }));
    this.axis.hidden = true;
    bar.append(spans, this.axis);
    this.spans = spans;
    this.autoButton = button("Autoscale", "fit the vertical axes to what is shown", () => {
      this.auto = !this.auto;
      pressed(this.autoButton, this.auto);
      this.redraw();
    });
    this.autoButton.dataset.act = "autoscale";
    pressed(this.autoButton, true);
    const limits = button("Limits", "show the voltage, and the path, up to their limits", () => {
      this.fullVoltage = !this.fullVoltage;
      pressed(limits, this.fullVoltage);
      this.redraw();
    });
    pressed(limits, false);
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
    const note = document.createElement("span");
    note.className = "note";
    note.setAttribute("role", "status");
    bar.append(note);
    this.note = text(note);
    this.grid = document.createElement("div");
    this.grid.className = "plots";
    this.plots = [...PLOTS.map((spec) => new Plot(this, spec)), new PathPlot(this)];
    this.grid.append(...this.plots.map((plot) => plot.box));
    this.append(bar, this.grid);
    const health = document.querySelector(".pea-health");
    const rest = new ResizeObserver(() => {  // what the lines above leave of the window
      const above = Math.ceil(this.getBoundingClientRect().top + window.scrollY);
      this.style.setProperty("--scope-height", `calc(100vh - ${above}px)`);
    });
    for (const each of [health, bar]) if (each) rest.observe(each);
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
    pressed(this.pauseButton, this.view.end !== null);
    const known = SPANS.includes(this.view.span);
    this.own.hidden = known;
    this.own.value = known ? "" : this.view.span;
    this.own.textContent = `${shown(this.view.span)} s`;
    this.spans.value = this.view.span;
    this.send();
  }

  open(source) {
    this.word = source ? "opening the recording" : "no samples yet";
    this.ask({ source, axis: "", end: null });
  }

  pause() {
    const none = this.frame.last === undefined;
    this.note(none && this.view.end === null ? "no samples yet: nothing to pause" : "");
    this.ask({ end: this.view.end === null && !none ? this.frame.last : null });
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
      for (const name of ["f", "amplitude", "density", "T", "S"]) {
        if (this.frame.arrays[name]) arrays[name] = this.frame.arrays[name];
      }
    }
    if (head.word) this.word = head.word;
    if (head.word && !Object.keys(arrays).length) this.clock(this.word);
    this.frame = { ...head, arrays };
    if (head.t0 !== undefined) this.grid.classList.toggle("with-path", Boolean(head.path));
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
    for (const plot of this.plots) if (plot.shown) plot.draw(frame, this.css);
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
    for (const plot of this.plots) if (plot.shown) plot.tell(frame);
    const axes = (this.view.source && frame.axes) || [];
    this.axis.hidden = axes.length < 2;
    offer(this.axis, axes, frame.axis);
    const age = this.age();
    this.classList.toggle("old", age > LATE);
    document.body.classList.toggle("pea-unheard", this.unheard() > LATE);
    if (frame.last !== undefined) this.note("");
    if (frame.last === undefined || this.socket.readyState !== WebSocket.OPEN) return;
    this.slider.min = frame.first;
    this.slider.max = frame.last;
    if (document.activeElement !== this.slider || this.view.end === null) {
      this.slider.value = this.view.end ?? frame.last;
    }
    if (age > LATE) return this.clock(`no new sample for ${Math.round(age)} s`);
    const rms = frame.rms_nm === null ? "–" : `${shown(frame.rms_nm)} nm`;
    const named = this.view.source ? `${this.view.source.split("/").pop()} · ` : "";
    this.clock(`${named}t ${Math.min(frame.t0 + frame.span, frame.last).toFixed(3)} s · rms ${rms}`);
  }
}

customElements.define("pea-scope", Scope);
