/* Plots over time, reduced to the least and the most of each column of pixels. */
"use strict";
var mp4dsPlots = (() => {
  const BLOCK = 32, SAMPLED = 20000;
  const LEFT = 58, RIGHT = 8, TOP = 8, BOTTOM = 20;

  /** Minimum and maximum of any range of a series, by a pyramid of blocks; NaN is ignored. */
  class Reduction {
    constructor(values) {
      this.levels = [[values, values]];
      while (this.levels.at(-1)[0].length > BLOCK) {
        const [least, most] = this.levels.at(-1), size = Math.ceil(least.length / BLOCK);
        const low = new Float64Array(size).fill(Infinity), high = new Float64Array(size).fill(-Infinity);
        for (let i = 0; i < least.length; i++) {
          const at = (i / BLOCK) | 0;
          if (least[i] < low[at]) low[at] = least[i];
          if (most[i] > high[at]) high[at] = most[i];
        }
        this.levels.push([low, high]);
      }
    }

    /** [minimum, maximum] of the entries from `from` up to but excluding `to`. */
    range(from, to) {
      let least = Infinity, most = -Infinity;
      for (let level = 0; from < to; level++) {
        const [low, high] = this.levels[level];
        const take = (first, end) => {
          for (let i = first; i < end; i++) {
            if (low[i] < least) least = low[i];
            if (high[i] > most) most = high[i];
          }
        };
        if (level === this.levels.length - 1) { take(from, to); break; }
        const up = Math.min(to, Math.ceil(from / BLOCK) * BLOCK);
        take(from, up);
        if (up === to) break;
        const down = Math.floor(to / BLOCK) * BLOCK;
        take(down, to);
        from = up / BLOCK;
        to = down / BLOCK;
      }
      return [least, most];
    }
  }

  /** The 0.5 and 99.5 percentiles of a series, from a sample of it. */
  function usualRange(values) {
    const every = Math.max(1, Math.floor(values.length / SAMPLED)), found = [];
    for (let i = 0; i < values.length; i += every) if (!Number.isNaN(values[i])) found.push(values[i]);
    if (!found.length) return [Infinity, -Infinity];
    found.sort((a, b) => a - b);
    return [found[Math.floor(0.005 * (found.length - 1))], found[Math.ceil(0.995 * (found.length - 1))]];
  }

  /** A canvas at the screen's pixel density: [context, width, height] in CSS pixels. */
  function prepare(canvas, height) {
    const width = Math.max(1, canvas.clientWidth), ratio = window.devicePixelRatio || 1;
    if (height) canvas.style.height = `${height}px`;
    height = height || canvas.clientHeight;
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = "11px system-ui, sans-serif";
    return [context, width, height];
  }

  const theme = () => {
    const style = getComputedStyle(document.documentElement);
    const value = name => style.getPropertyValue(name).trim();
    return {line: value("--line"), text: value("--muted"), strong: value("--text"), accent: value("--accent"), warn: value("--warn")};
  };

  /** Round steps that divide a range into about `count` parts. */
  function ticks(from, to, parts) {
    const rough = (to - from) / Math.max(1, parts);
    if (!(rough > 0) || !Number.isFinite(rough)) return [from];
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map(part => part * power).find(part => part >= rough * 0.999);
    const found = [];
    for (let n = Math.ceil(from / step); n * step <= to + step * 1e-9 && found.length < 100; n++) found.push(n * step);
    return found;
  }

  const digitsOf = values => {
    const step = values.length > 1 ? Math.abs(values[1] - values[0]) : 1;
    return Math.max(0, Math.min(9, -Math.floor(Math.log10(step) + 1e-9)));
  };

  /** Seconds as 12.5 s or 1:02:03. */
  function timeText(seconds, digits) {
    if (Math.abs(seconds) < 120) return `${seconds.toFixed(digits)} s`;
    const whole = Math.floor(seconds), two = value => String(value).padStart(2, "0");
    const part = digits ? (seconds - whole).toFixed(digits).slice(1) : "";
    const hours = Math.floor(whole / 3600), minutes = Math.floor(whole / 60) % 60;
    return `${hours ? `${hours}:${two(minutes)}` : minutes}:${two(whole % 60)}${part}`;
  }

  function numberText(value) {
    if (!Number.isFinite(value)) return "–";
    const size = Math.abs(value);
    if (size >= 1e6 || (size && size < 1e-3)) return value.toExponential(2);
    return value.toFixed(size >= 1000 ? 0 : size >= 100 ? 1 : size >= 1 ? 2 : 3);
  }

  /** The visible range of time, shared by all plots and the timeline; nanoseconds. */
  class View {
    constructor(end) { this.end = end; this.from = 0; this.to = end; this.listeners = []; }
    set(from, to) {
      const least = Math.min(1e6, this.end), span = Math.min(this.end, Math.max(least, to - from));
      this.from = Math.max(0, Math.min(from, this.end - span));
      this.to = this.from + span;
      for (const listener of this.listeners) listener();
    }
    all() { this.set(0, this.end); }
    zoom(at, factor) { this.set(at - (at - this.from) * factor, at + (this.to - at) * factor); }
  }

  class Axes {
    constructor(width, height, low, high) {
      Object.assign(this, {width, height, low, high, left: LEFT, right: width - RIGHT, top: TOP, bottom: height - BOTTOM});
    }
    y(value) { return this.bottom - (value - this.low) / (this.high - this.low) * (this.bottom - this.top); }
    clamped(value) { return Math.max(this.top, Math.min(this.bottom, this.y(value))); }
    draw(context, colours, xTicks, xOf, xText, unit) {
      context.lineWidth = 1;
      context.textBaseline = "middle";
      context.textAlign = "right";
      const values = ticks(this.low, this.high, 4), digits = digitsOf(values);
      for (const value of values) {
        const y = Math.round(this.y(value)) + 0.5;
        context.strokeStyle = colours.line;
        context.beginPath(); context.moveTo(this.left, y); context.lineTo(this.right, y); context.stroke();
        context.fillStyle = colours.text;
        context.fillText(Math.abs(value) >= 1e6 ? value.toExponential(1) : value.toFixed(digits), this.left - 6, y);
      }
      context.textAlign = "center";
      for (const value of xTicks) context.fillText(xText(value), xOf(value), this.height - 8);
      context.textAlign = "left";
      context.fillText(unit, 2, this.height - 8);
    }
  }

  /** A plot of series over time: {name, colour, x, y, shown()}, x never decreasing. */
  class TimePlot {
    constructor(canvas, label, view, {unit, stems = false, onTime}) {
      Object.assign(this, {canvas, label, view, unit, stems, series: [], isFull: false, cursor: null, now: 0});
      view.listeners.push(() => this.request());
      this.listen(onTime);
    }

    add(series) {
      series.reduction = new Reduction(series.y);
      series.usual = usualRange(series.y);
      this.series.push(series);
    }

    request() {
      if (this.pending) return;
      this.pending = requestAnimationFrame(() => { this.pending = 0; this.draw(); });
    }

    listen(onTime) {
      const canvas = this.canvas, timeAt = event => {
        const box = canvas.getBoundingClientRect(), {from, to} = this.view;
        const part = (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
        return from + Math.max(0, Math.min(1, part)) * (to - from);
      };
      let pressed = null;
      canvas.addEventListener("pointerdown", event => {
        pressed = {x: event.clientX, time: timeAt(event)};
        canvas.setPointerCapture(event.pointerId);
      });
      canvas.addEventListener("pointermove", event => {
        this.cursor = timeAt(event);
        this.selection = pressed && Math.abs(event.clientX - pressed.x) > 4 ? [pressed.time, this.cursor] : null;
        this.request();
      });
      canvas.addEventListener("pointerup", event => {
        const selection = this.selection;
        if (selection) this.view.set(Math.min(...selection), Math.max(...selection));
        else if (pressed) onTime(timeAt(event));
        pressed = this.selection = null;
      });
      canvas.addEventListener("pointerleave", () => { this.cursor = null; this.request(); });
      canvas.addEventListener("dblclick", () => this.view.all());
      canvas.addEventListener("wheel", event => {
        if (!event.ctrlKey && !event.shiftKey) return;  // otherwise the page scrolls
        event.preventDefault();
        this.view.zoom(timeAt(event), Math.exp((event.deltaY || event.deltaX) / 300));
      }, {passive: false});
    }

    /** Visible entries of a series: [first, end]. */
    seen(series) {
      const {from, to} = this.view, last = mp4dsColumns.lastAtMost;
      const first = Math.max(0, last(series.x, from - 0.5));
      return [first, Math.min(series.x.length, last(series.x, to) + 2)];
    }

    range() {
      let low = Infinity, high = -Infinity;
      for (const series of this.series) {
        if (!series.shown()) continue;
        let [least, most] = series.reduction.range(...this.seen(series));
        if (!this.isFull && !this.stems) {
          const [usualLeast, usualMost] = series.usual, margin = Math.max(usualMost - usualLeast, 1e-3);
          least = Math.max(least, Math.min(most, usualLeast - margin));
          most = Math.min(most, Math.max(least, usualMost + margin));
        }
        low = Math.min(low, least);
        high = Math.max(high, most);
      }
      if (this.stems) { low = Math.min(low, 0); high = Math.max(high, 1); }
      if (!(low <= high)) return [0, 1];
      const pad = (high - low) * 0.06 || Math.max(Math.abs(high) * 0.01, 0.001);
      return [low - pad, high + pad];
    }

    draw() {
      const [context, width, height] = prepare(this.canvas), colours = theme();
      const axes = new Axes(width, height, ...this.range()), {from, to} = this.view;
      const xOf = time => LEFT + (time - from) / (to - from || 1) * (axes.right - LEFT);
      const marks = ticks(from / 1e9, to / 1e9, width / 110), digits = digitsOf(marks);
      axes.draw(context, colours, marks, value => xOf(value * 1e9), value => timeText(value, digits), this.unit);
      context.save();
      context.beginPath();
      context.rect(LEFT, 0, axes.right - LEFT, axes.bottom + 1);
      context.clip();
      const shown = this.series.filter(series => series.shown());
      context.globalAlpha = shown.length > 1 ? 0.75 : 1;  // so that no series hides the others
      for (const series of shown) this.drawSeries(context, axes, series, xOf);
      context.globalAlpha = 1;
      this.drawCursor(context, axes, colours, xOf);
      context.restore();
      this.tell();
    }

    drawSeries(context, axes, series, xOf) {
      const [first, end] = this.seen(series), {x, y} = series;
      context.strokeStyle = context.fillStyle = series.colour;
      context.lineWidth = 1.2;
      context.beginPath();
      if (this.stems || end - first > 2 * (axes.right - LEFT)) {
        const columns = this.columns(series, axes.right - LEFT);
        for (const [column, least, most] of columns) {
          const px = LEFT + column + 0.5;
          if (this.stems && !least && !most) continue;
          const [low, high] = this.stems ? [Math.min(0, least), Math.max(0, most)] : [least, most];
          context.moveTo(px, axes.clamped(low) + 0.5);
          context.lineTo(px, axes.clamped(high) - 0.5);
        }
        context.stroke();
        if (this.stems) for (const [column, least, most] of columns) {
          if (!least && !most) continue;
          context.beginPath();
          context.arc(LEFT + column + 0.5, axes.clamped(most > 0 ? most : least), 2.5, 0, 7);
          context.fill();
        }
        return;
      }
      let isDown = false;
      for (let i = first; i < end; i++) {
        if (Number.isNaN(y[i])) { isDown = false; continue; }
        context[isDown ? "lineTo" : "moveTo"](xOf(x[i]), axes.clamped(y[i]));
        isDown = true;
      }
      context.stroke();
      if (end - first < (axes.right - LEFT) / 6) {
        for (let i = first; i < end; i++) {
          if (Number.isNaN(y[i])) continue;
          context.beginPath(); context.arc(xOf(x[i]), axes.clamped(y[i]), 2, 0, 7); context.fill();
        }
      }
    }

    /** [column, minimum, maximum] of each pixel column that has entries. */
    columns(series, width) {
      const {from, to} = this.view, found = [], last = mp4dsColumns.lastAtMost;
      const count = Math.max(1, Math.floor(width));
      let first = last(series.x, from - 0.5) + 1;
      for (let column = 0; column < count && first < series.x.length; column++) {
        const edge = column === count - 1 ? to : from + (to - from) * (column + 1) / count - 0.5;
        const end = last(series.x, edge) + 1;
        if (end > first) {
          const [least, most] = series.reduction.range(first, end);
          if (least <= most) found.push([column, least, most]);
        }
        first = Math.max(first, end);
      }
      return found;
    }

    drawCursor(context, axes, colours, xOf) {
      const line = (time, colour, widthOf) => {
        context.strokeStyle = colour;
        context.lineWidth = widthOf;
        context.beginPath(); context.moveTo(xOf(time), axes.top); context.lineTo(xOf(time), axes.bottom); context.stroke();
      };
      line(this.now, colours.accent, 1.5);
      if (this.cursor !== null) line(this.cursor, colours.text, 0.75);
      if (this.selection) {
        const [a, b] = this.selection.map(xOf);
        context.globalAlpha = 0.15;
        context.fillStyle = colours.accent;
        context.fillRect(Math.min(a, b), axes.top, Math.abs(b - a), axes.bottom - axes.top);
        context.globalAlpha = 1;
      }
    }

    /** Writes the values at the cursor, or at the current time. */
    tell() {
      const time = this.cursor ?? this.now;
      const values = this.series.filter(series => series.shown()).map(series => {
        const at = mp4dsColumns.lastAtMost(series.x, time);
        return at < 0 ? "–" : numberText(series.y[at]);
      });
      this.label.textContent = values.length ? `${values.slice(0, 6).join("  ·  ")} ${this.unit}` : "";
    }
  }

  /** A histogram of series {name, colour, y, shown()}. */
  class Histogram {
    constructor(canvas, label, {unit}) {
      Object.assign(this, {canvas, label, unit, series: [], bins: 61});
    }

    add(series) {
      const sorted = Float64Array.from(series.y.filter(value => !Number.isNaN(value))).sort();
      series.reach = sorted.length
        ? Math.max(-sorted[Math.floor(0.005 * (sorted.length - 1))], sorted[Math.ceil(0.995 * (sorted.length - 1))]) : 0;
      this.series.push(series);
      this.counted = null;
    }

    request() { requestAnimationFrame(() => this.draw()); }

    /** Share of values in each bin from -reach to reach; values outside are not counted. */
    count() {
      const reach = Math.max(1e-3, ...this.series.filter(s => s.shown()).map(s => s.reach)) * 1.1;
      this.reach = reach;
      for (const series of this.series) {
        series.shares = new Float64Array(this.bins);
        let total = 0;
        for (const value of series.y) {
          if (Number.isNaN(value)) continue;
          total++;
          const bin = Math.floor((value + reach) / (2 * reach) * this.bins);
          if (bin >= 0 && bin < this.bins) series.shares[bin]++;
        }
        series.shares = series.shares.map(share => total ? 100 * share / total : 0);
      }
    }

    draw() {
      this.count();
      const [context, width, height] = prepare(this.canvas), colours = theme();
      const shown = this.series.filter(series => series.shown());
      const high = Math.max(1, ...shown.map(series => Math.max(...series.shares))) * 1.06;
      const axes = new Axes(width, height, 0, high), {reach, bins} = this;
      const xOf = value => LEFT + (value + reach) / (2 * reach) * (axes.right - LEFT);
      const marks = ticks(-reach, reach, width / 80), digits = digitsOf(marks);
      axes.draw(context, colours, marks, xOf, value => value.toFixed(digits), "%");
      for (const series of shown) {
        context.strokeStyle = series.colour;
        context.lineWidth = 1.4;
        context.beginPath();
        context.moveTo(LEFT, axes.bottom);
        series.shares.forEach((share, bin) => {
          const [a, b] = [bin, bin + 1].map(edge => LEFT + edge / bins * (axes.right - LEFT));
          context.lineTo(a, axes.y(share));
          context.lineTo(b, axes.y(share));
        });
        context.lineTo(axes.right, axes.bottom);
        context.stroke();
      }
      this.label.textContent = `% of intervals, ${this.unit}`;
    }
  }

  return {Reduction, View, TimePlot, Histogram, prepare, theme, ticks, digitsOf, timeText, numberText};
})();
