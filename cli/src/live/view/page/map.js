// A range-Doppler map: range to the right, velocity upwards, dB as colour.

import { LEAKAGE_BINS, STANDS_OUT_DB, begin, palette, painter, theme, ticks } from './plot.js';

const LEFT = 42, BOTTOM = 34, RIGHT = 52, TOP = 6;

export class MapView {
  constructor(canvas, echo, pointed) {
    Object.assign(this, { canvas, echo, pointed, hold: false, overFloor: false, low: null, high: null });
    this.image = document.createElement('canvas');
    this.draw = painter(() => this.paint());
    this.auto = null;
    this.cross = null;
    canvas.addEventListener('pointermove', event => this.point(event.offsetX, event.offsetY));
    canvas.addEventListener('pointerleave', () => { this.cross = null; this.draw(); });
    canvas.addEventListener('blur', () => { this.cross = null; this.draw(); });
    canvas.addEventListener('keydown', event => this.key(event));
  }

  /** Takes a new map: header, bytes, and the noise floor by range. */
  take(header, bytes, floor) {
    const { range, doppler, low_db: low, step_db: step } = header;
    const cells = range * doppler;
    if (!this.db || this.db.length !== cells || this.shape !== `${range} ${doppler}`) {
      this.shape = `${range} ${doppler}`;
      this.db = new Float32Array(cells);
      this.held = null;
    }
    for (let i = 0; i < cells; i++) this.db[i] = bytes[i] === 255 ? NaN : low + step * bytes[i];
    if (this.overFloor) for (let i = 0; i < cells; i++) this.db[i] -= floor[i % range];
    if (this.hold) {
      if (!this.held) this.held = this.db.slice();
      else for (let i = 0; i < cells; i++) if (!(this.held[i] >= this.db[i])) this.held[i] = this.db[i];
    } else this.held = null;
    this.header = header;
    this.floor = floor;
    this.strongest = this.find();
    // The scale changes slowly, so that an empty room is dark and does not flicker.
    const sorted = Array.from(floor).filter(Number.isFinite).sort((a, b) => a - b);
    const middle = this.overFloor ? 0 : sorted[sorted.length >> 1] ?? 0;
    const wants = [middle - 2, Math.max(middle + 38, this.strongest ? this.strongest.db + 2 : -Infinity)];
    if (!this.auto || this.isNew || Math.abs(this.auto[0] - wants[0]) > 30) this.auto = wants;
    else this.auto = this.auto.map((v, i) => v + (wants[i] > v && i ? 0.5 : 0.05) * (wants[i] - v));
    this.isNew = false;
    this.draw();
  }

  /** Discards the held maxima and the scale of the previous selection. */
  forget() { this.held = null; this.isNew = true; }

  none(text) { this.header = null; this.message = text; this.strongest = null; this.draw(); }

  /** Finds the cell with the highest level over the noise of its range. */
  find() {
    const { range } = this.header;
    let best = -Infinity, at = -1;
    for (let i = 0; i < this.db.length; i++) {
      const r = i % range;
      if (r < LEAKAGE_BINS) continue;
      const over = this.overFloor ? this.db[i] : this.db[i] - this.floor[r];
      if (over > best) { best = over; at = i; }
    }
    return at < 0 ? null : { ...this.cell(at), over: best };
  }

  /** The strongest cell, if it stands out of the noise. */
  found() { return this.strongest?.over > STANDS_OUT_DB ? this.strongest : null; }

  cell(index) {
    const { range, doppler, range_step_m, velocity_step_m_per_s } = this.header;
    const d = Math.floor(index / range), r = index % range;
    return { range_m: r * range_step_m, velocity_m_per_s: (d - Math.floor(doppler / 2)) * velocity_step_m_per_s, db: this.db[index], index };
  }

  point(x, y) {
    if (!this.header) return;
    const { range, doppler } = this.header, box = this.box();
    const r = Math.floor((x - LEFT) / box.width * range), d = doppler - 1 - Math.floor((y - TOP) / box.height * doppler);
    this.cross = r >= 0 && r < range && d >= 0 && d < doppler ? [r, d] : null;
    this.draw();
  }

  key(event) {
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!move || !this.header || event.shiftKey) return;
    const { range, doppler } = this.header, [r, d] = this.cross ?? [Math.floor(range / 4), Math.floor(doppler / 2)];
    this.cross = [Math.min(range - 1, Math.max(0, r + move[0])), Math.min(doppler - 1, Math.max(0, d + move[1]))];
    event.preventDefault();
    event.stopPropagation();
    this.draw();
  }

  box() { return { width: this.canvas.clientWidth - LEFT - RIGHT, height: this.canvas.clientHeight - BOTTOM - TOP }; }

  paint() {
    const begun = begin(this.canvas);
    if (!begun) return;
    const { g, width, height } = begun, box = this.box();
    if (!this.header) {
      g.textAlign = 'center';
      g.fillText(this.message ?? 'no frame yet', width / 2, height / 2);
      this.echo.textContent = '';
      return;
    }
    const { range, doppler, range_step_m, velocity_step_m_per_s } = this.header;
    const low = this.low ?? this.auto[0], high = Math.max(low + 1, this.high ?? this.auto[1]);
    const shown = this.held ?? this.db, { image } = this;
    if (image.width !== range || image.height !== doppler) { image.width = range; image.height = doppler; this.pixels = null; }
    const context = image.getContext('2d');
    this.pixels ??= context.createImageData(range, doppler);
    const out = new Uint32Array(this.pixels.data.buffer), scale = 254 / (high - low);
    for (let d = 0; d < doppler; d++) for (let r = 0; r < range; r++) {
      const v = (shown[d * range + r] - low) * scale;
      out[(doppler - 1 - d) * range + r] = palette[v !== v ? 255 : v < 0 ? 0 : v > 254 ? 254 : v | 0];
    }
    context.putImageData(this.pixels, 0, 0);
    g.imageSmoothingEnabled = false;
    g.drawImage(image, LEFT, TOP, box.width, box.height);

    const bar = g.createLinearGradient(0, TOP + box.height, 0, TOP);
    for (let i = 0; i <= 8; i++) {
      const c = palette[Math.round(i * 254 / 8)];
      bar.addColorStop(i / 8, `rgb(${c & 255},${c >> 8 & 255},${c >> 16 & 255})`);
    }
    g.fillStyle = bar;
    g.fillRect(width - RIGHT + 8, TOP, 10, box.height);
    g.fillStyle = theme.ink;
    g.textBaseline = 'middle';
    g.textAlign = 'left';
    for (const [value, text] of ticks(low, high)) g.fillText(text, width - RIGHT + 22, Math.max(7, TOP + (1 - (value - low) / (high - low)) * box.height));
    g.fillText(this.overFloor ? 'dB over' : 'dBFS', width - RIGHT + 4, height - 10);
    g.textAlign = 'right';
    const y = row => TOP + (1 - (row + 0.5) / doppler) * box.height, zero = Math.floor(doppler / 2);
    for (const [value, text] of ticks(-zero * velocity_step_m_per_s, (doppler - 1 - zero) * velocity_step_m_per_s)) g.fillText(text, LEFT - 5, y(value / velocity_step_m_per_s + zero));
    g.textAlign = 'center';
    g.textBaseline = 'alphabetic';
    const x = bin => LEFT + (bin + 0.5) / range * box.width;
    for (const [value, text] of ticks(0, (range - 1) * range_step_m, Math.max(3, Math.min(10, box.width / 60)))) g.fillText(text, x(value / range_step_m), height - BOTTOM + 14);
    g.fillStyle = theme.soft;
    g.fillText('range, m', LEFT + box.width / 2, height - 5);
    g.textAlign = 'left';
    g.fillText('m/s', 4, height - 5);
    g.strokeStyle = '#fff';
    const found = this.found();
    if (found) {
      const [r, d] = [found.index % range, Math.floor(found.index / range)];
      g.globalAlpha = 0.8;
      g.beginPath();
      g.arc(x(r), y(d), 9, 0, 7);
      g.stroke();
      g.globalAlpha = 1;
    }
    if (this.cross) {
      const [r, d] = this.cross;
      g.beginPath();
      g.moveTo(x(r), TOP); g.lineTo(x(r), TOP + box.height);
      g.moveTo(LEFT, y(d)); g.lineTo(LEFT + box.width, y(d));
      g.stroke();
    }
    this.read();
  }

  read() {
    const unit = this.overFloor ? 'dB over noise' : 'dBFS';
    const words = c => {
      const v = c.velocity_m_per_s, way = Math.abs(v) < 0.05 ? 'still' : v > 0 ? 'receding' : 'approaching';
      return `${c.range_m.toFixed(2)} m, ${v > 0 ? '+' : ''}${v.toFixed(2)} m/s (${way}), ${c.db.toFixed(0)} ${unit}`;
    };
    const found = this.found();
    this.echo.textContent = found ? `strongest echo: ${words(found)}` : 'no echo stands out of the noise';
    if (this.pointed) this.pointed.textContent = this.cross ? `· pointed at: ${words({ ...this.cell(this.cross[1] * this.header.range + this.cross[0]) })}` : '';
  }
}
