// Velocity over time: for each velocity, the echo with the highest level over the noise of its range.

import { LEAKAGE_BINS, begin, clock, painter, palette, theme, ticks } from './plot.js';

/** Number of columns that are kept. */
const COLUMNS = 480;
/** dB over noise that the colours span: an exponential's tail over a hundred ranges is 7. */
const LOW = 6, HIGH = 36;
const LEFT = 42, BOTTOM = 20, TOP = 6;

export class DopplerView {
  constructor(canvas) {
    this.canvas = canvas;
    this.ring = document.createElement('canvas');
    this.times = new Float64Array(COLUMNS);
    this.count = this.valid = 0;
    this.draw = painter(() => this.paint(), 60);
  }

  take(header, bytes, floor, time_s) {
    const { range, doppler, low_db: low, step_db: step } = header;
    if (this.doppler !== doppler || this.step !== header.velocity_step_m_per_s) {
      Object.assign(this, { doppler, step: header.velocity_step_m_per_s, count: 0, valid: 0 });
      this.ring.width = COLUMNS;
      this.ring.height = doppler;
      this.column = new ImageData(1, doppler);
    }
    const last = () => this.times[(this.count - 1 + COLUMNS) % COLUMNS];
    if (this.valid && time_s === last()) return;
    // After a backward seek, later columns are removed.
    while (this.valid && time_s <= last()) { this.count--; this.valid--; }
    const out = new Uint32Array(this.column.data.buffer);
    for (let d = 0; d < doppler; d++) {
      let over = -Infinity;
      for (let r = LEAKAGE_BINS; r < range; r++) {
        const byte = bytes[d * range + r], v = low + step * byte - floor[r];
        if (byte !== 255 && v > over) over = v;
      }
      out[doppler - 1 - d] = palette[Math.max(0, Math.min(254, Math.round((over - LOW) / (HIGH - LOW) * 254)))];
    }
    this.ring.getContext('2d').putImageData(this.column, this.count % COLUMNS, 0);
    this.times[this.count % COLUMNS] = time_s;
    this.count++;
    this.valid = Math.min(COLUMNS, this.valid + 1);
    this.draw();
  }

  forget() { this.count = this.valid = 0; }

  paint() {
    const begun = begin(this.canvas);
    if (!begun || !this.valid) return;
    const { g, width, height } = begun, w = width - LEFT - 4, h = height - TOP - BOTTOM, { doppler, step } = this;
    g.imageSmoothingEnabled = false;
    const shown = this.valid, per = w / Math.min(COLUMNS, Math.max(160, shown)), start = (this.count - shown) % COLUMNS, x0 = LEFT + w - shown * per;
    // The ring is drawn from its oldest column on, in two pieces if it has wrapped around.
    const first = Math.min(shown, COLUMNS - start);
    g.drawImage(this.ring, start, 0, first, doppler, x0, TOP, first * per, h);
    if (first < shown) g.drawImage(this.ring, 0, 0, shown - first, doppler, x0 + first * per, TOP, (shown - first) * per, h);
    g.fillStyle = theme.ink;
    g.textAlign = 'right';
    g.textBaseline = 'middle';
    const zero = Math.floor(doppler / 2);
    for (const [value, text] of ticks(-zero * step, (doppler - 1 - zero) * step, 5)) g.fillText(text, LEFT - 5, TOP + (1 - (value / step + zero + 0.5) / doppler) * h);
    g.textAlign = 'center';
    g.textBaseline = 'alphabetic';
    for (let i = shown - 1, every = Math.ceil(90 / per); i >= 0; i -= every) {
      const x = Math.min(x0 + (i + 0.5) * per, width - 24);
      if (x > LEFT + 16) g.fillText(clock(this.times[(this.count - shown + i) % COLUMNS]), x, height - 5);
    }
    g.fillStyle = theme.soft;
    g.textAlign = 'left';
    g.fillText('m/s', 4, height - 5);
  }
}
