// Timeline: probabilities, occupancy after delays, the truth where it is known, and the labels.

import { begin, clock, painter, readable, theme, ticks } from './plot.js';

/** Number of answers that are kept: an hour at ten per second. The fixed size lets a page stay open for months. */
const MOST = 36000;
const NAMES = ['empty', 'one', 'two'];
const LEFT = 88, RIGHT = 8, TOP = 4, BOTTOM = 18, GRIP = 9;
const NONE = 255, SPLIT = 1000;
/** Rows from the top with their fractions of the height, and the fraction between two of them. */
const ROWS = { probabilities: 50, occupied: 10, truth: 10, labels: 20 }, BETWEEN = 3;

/** Answers in the order of their time. */
export class History {
  constructor() {
    this.length = 0;
    this.time = new Float64Array(MOST);
    this.columns = ['empty', 'one', 'two', 'occupied', 'truth', 'transition', 'gap', 'label'].map(name => this[name] = new Uint8Array(MOST));
  }

  /** Adds rows whose values have the order of `Point::row` in history.rs. */
  add(rows) {
    for (const [, time, p, label, occupied, truth, transition, gap] of rows) {
      let at = this.length;
      if (at && time <= this.time[at - 1]) {
        at = this.first(time);
        if (Math.abs(this.time[at] - time) > 1e-6) at = this.shift(at, 1);
      } else at = this.shift(at, 1);
      this.time[at] = time;
      NAMES.forEach((name, i) => this[name][at] = p ? Math.round(p[i] * 250) : NONE);
      this.label[at] = label ?? NONE;
      this.occupied[at] = p ? occupied : NONE;
      this.truth[at] = truth ?? NONE;
      this.transition[at] = transition;
      this.gap[at] = gap;
    }
  }

  /**
   * Shifts entries to insert others, and returns where these belong. A full history drops its oldest entries; the newest ones
   * if others are inserted among the oldest.
   */
  shift(at, by) {
    if (this.length + by > MOST) {
      if (at >= SPLIT) {
        for (const column of [this.time, ...this.columns]) column.copyWithin(0, SPLIT, this.length);
        at -= SPLIT;
      }
      this.length -= SPLIT;
    }
    if (at < this.length) for (const column of [this.time, ...this.columns]) column.copyWithin(at + by, at, this.length);
    this.length += by;
    return at;
  }

  /** Index of the first answer at or after a time. */
  first(time) {
    let [low, high] = [0, this.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time[middle] >= time - 1e-9) high = middle; else low = middle + 1;
    }
    return low;
  }
}

export class Timeline {
  constructor(canvas, { seek, move, select }) {
    Object.assign(this, { canvas, seek, move, select, history: new History(), spans: [], open: null, window: 60, now: 0, tape: null, interval: 0.1, selected: null, drag: null, readOnly: false });
    this.draw = painter(() => this.paint(), 60);
    canvas.addEventListener('pointerdown', event => this.down(event));
    canvas.addEventListener('pointermove', event => this.over(event));
    canvas.addEventListener('pointerup', event => this.up(event));
    canvas.addEventListener('pointercancel', () => { this.drag = null; this.draw(); });
  }

  /** First and last time shown, s. */
  extent() {
    if (this.drag) return this.drag.extent;
    const first = this.tape ? this.tape.first_s : this.history.length ? this.history.time[0] : 0;
    const last = this.tape ? this.tape.last_s + this.interval : Math.max(this.now + this.interval, first + 1);
    if (!this.window || last - first <= this.window && this.tape) return [first, last];
    if (!this.tape) return [this.now + this.interval - this.window, this.now + this.interval];
    // The current time stays a little right of the middle.
    const from = Math.max(first, Math.min(last - this.window, this.now - 0.6 * this.window));
    return [from, from + this.window];
  }

  geometry() {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight, [from, to] = this.extent();
    const h = height - TOP - BOTTOM, x = t => LEFT + (t - from) / (to - from) * (width - LEFT - RIGHT);
    const time = px => from + (px - LEFT) / (width - LEFT - RIGHT) * (to - from);
    const shares = Object.entries(ROWS), unit = h / shares.reduce((sum, [, share]) => sum + share + BETWEEN, -BETWEEN), rows = {};
    let top = TOP;
    for (const [name, share] of shares) {
      rows[name] = [top, share * unit];
      top += (share + BETWEEN) * unit;
    }
    return { width, height, from, to, x, time, rows };
  }

  paint() {
    const begun = begin(this.canvas);
    if (!begun) return;
    const { g } = begun, { width, height, from, to, x, rows } = this.geometry(), { history } = this;
    g.textBaseline = 'middle';
    g.textAlign = 'right';
    for (const [name, [top, h]] of Object.entries(rows)) {
      g.fillStyle = theme.paper;
      g.fillRect(LEFT, top, width - LEFT - RIGHT, h);
      g.fillStyle = theme.soft;
      g.fillText(name, LEFT - 6, top + h / 2);
    }
    g.save();
    g.beginPath(); g.rect(LEFT, 0, width - LEFT - RIGHT, height); g.clip();
    const begin_ = Math.max(0, history.first(from) - 1), end = Math.min(history.length, history.first(to) + 1);
    const [pTop, pHeight] = rows.probabilities;
    const until = i => i + 1 < history.length && history.time[i + 1] - history.time[i] < 3 * this.interval ? history.time[i + 1] : history.time[i] + this.interval;
    // At most one column per pixel, for any window length.
    let filled = -1;
    for (let i = begin_; i < end; i++) {
      const left = Math.max(filled, Math.round(x(history.time[i]))), right = Math.round(x(until(i)));
      if (right <= left && i + 1 < end) continue;
      filled = right;
      if (history.empty[i] === NONE) continue;
      let y = pTop + pHeight;
      for (const name of NAMES) {
        const h = history[name][i] / 250 * pHeight;
        g.fillStyle = theme[name];
        g.fillRect(left, y - h, right - left, h);
        y -= h;
      }
    }
    const strip = (column, [top, h], style) => {
      for (let i = begin_; i < end;) {
        const value = history[column][i];
        let j = i;
        while (j + 1 < end && history[column][j + 1] === value && history.time[j + 1] - history.time[j] < 3 * this.interval) j++;
        const colour = style(value);
        if (colour) { g.fillStyle = colour; g.fillRect(x(history.time[i]), top, x(until(j)) - x(history.time[i]), h); }
        i = j + 1;
      }
    };
    strip('occupied', rows.occupied, v => v === 1 ? theme.ink : null);
    strip('truth', rows.truth, v => v === NONE ? null : theme[NAMES[v]]);
    strip('transition', [rows.truth[0] + rows.truth[1] * 0.6, rows.truth[1] * 0.4], v => v ? theme.card : null);
    g.fillStyle = theme.alarm;
    for (let i = begin_; i < end; i++) if (history.gap[i]) g.fillRect(x(history.time[i]) - 1, pTop, 2, pHeight);
    this.paintLabels(g, x, rows.labels);
    if (this.tape) {
      g.fillStyle = theme.ink;
      g.fillRect(x(this.now) - 1, TOP, 2, height - TOP - BOTTOM);
    }
    g.restore();
    g.fillStyle = theme.ink;
    g.textAlign = 'center';
    g.textBaseline = 'alphabetic';
    for (const [value] of ticks(from, to, Math.max(2, Math.min(10, width / 90)))) {
      const px = x(value);
      // A live window reaches back beyond the first frame; no time is negative.
      if (value > -1e-9 && px > LEFT + 14 && px < width - 18) g.fillText(clock(value, to - from > 20 ? 0 : 1), px, height - 4);
    }
  }

  paintLabels(g, x, [top, h]) {
    const all = this.spans.map(span => this.drag?.id === span.id ? { ...span, ...this.drag.span } : span);
    if (this.open) all.push({ ...this.open, end_s: Math.max(this.open.start_s, this.now + this.interval), isOpen: true });
    for (const span of all) {
      const left = x(span.start_s), w = Math.max(1, x(span.end_s) - left), isClass = NAMES.includes(span.label);
      const [y, height] = isClass ? [top, h] : [top + 0.7 * h, 0.3 * h];
      g.fillStyle = isClass ? theme[span.label] : theme.soft;
      g.globalAlpha = span.isOpen ? 0.65 : 1;
      g.fillRect(left, y, w, height);
      g.globalAlpha = 1;
      g.fillStyle = theme.card;
      g.fillRect(left, y, 1, height);
      if (!span.isOpen) g.fillRect(left + w - 1, y, 1, height);
      if (span.id === this.selected) {
        g.strokeStyle = theme.ink;
        g.lineWidth = 2;
        g.strokeRect(left + 1, y + 1, Math.max(1, w - 2), height - 2);
      }
      g.font = '600 12px system-ui, sans-serif';
      if (w > g.measureText(span.label).width + 8) {
        g.fillStyle = readable(isClass ? theme[span.label] : theme.soft);
        g.textAlign = 'left';
        g.textBaseline = 'middle';
        g.fillText(span.label, left + 5, y + height / 2);
      }
      g.font = '12px system-ui, sans-serif';
    }
  }

  /** Finds the object under the pointer: an edge of a label, a label, or a time. */
  hit(event) {
    const { x, time, rows, from, to } = this.geometry(), px = event.offsetX, [top, h] = rows.labels;
    const at = Math.max(from, Math.min(to, time(px)));
    if (event.offsetY < top - 4 || event.offsetY > top + h + 6) return { time: at };
    let best = null;
    if (!this.readOnly) for (const span of this.spans) for (const edge of ['start_s', 'end_s']) {
      const distance = Math.abs(x(span[edge]) - px);
      // Of two adjacent edges, the one of the label under the pointer wins.
      const inside = edge === 'start_s' ? px >= x(span.start_s) : px <= x(span.end_s);
      if (distance <= GRIP && (!best || distance - (inside ? 0.5 : 0) < best.distance)) best = { span, edge, distance: distance - (inside ? 0.5 : 0) };
    }
    return { time: at, edge: best, span: this.spans.find(span => at >= span.start_s && at <= span.end_s), onLabels: true };
  }

  down(event) {
    const hit = this.hit(event);
    if (hit.edge) {
      const { span, edge } = hit.edge;
      this.drag = { id: span.id, edge, span: { start_s: span.start_s, end_s: span.end_s }, extent: this.extent() };
      this.canvas.setPointerCapture(event.pointerId);
      this.select(span.id);
    } else if (hit.onLabels && hit.span) this.select(hit.span.id);
    else if (this.tape) {
      this.drag = { extent: this.extent(), seeking: true };
      this.canvas.setPointerCapture(event.pointerId);
      this.seek(hit.time);
    }
    this.draw();
  }

  over(event) {
    const hit = this.hit(event);
    this.canvas.style.cursor = hit.edge || this.drag?.edge ? 'ew-resize' : hit.onLabels ? 'default' : 'crosshair';
    if (!this.drag) return;
    if (this.drag.seeking) this.seek(hit.time);
    else {
      const { start_s, end_s } = this.drag.span;
      // The edge snaps to a frame and never crosses the other edge.
      const t = this.tape ? this.tape.first_s + Math.round((hit.time - this.tape.first_s) / this.interval) * this.interval : hit.time;
      this.drag.span = this.drag.edge === 'start_s' ? { start_s: Math.min(t, end_s - this.interval), end_s } : { start_s, end_s: Math.max(t, start_s + this.interval) };
    }
    this.draw();
  }

  up() {
    const { drag } = this;
    this.drag = null;
    const was = drag?.edge && this.spans.find(span => span.id === drag.id);
    if (was && was[drag.edge] !== drag.span[drag.edge]) {
      // Shown at the new time until the server confirms it.
      this.spans = this.spans.map(span => span === was ? { ...span, ...drag.span } : span);
      this.move(drag.id, drag.span.start_s, drag.span.end_s);
    }
    this.draw();
  }
}
