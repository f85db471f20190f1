// Raw chirps: one of them, the envelope of all, and codes at either end of the ADC range.

import { begin, painter, theme, ticks } from './plot.js';

const LEFT = 42, BOTTOM = 34, TOP = 8, RIGHT = 8, LARGEST = 4095;

export class ChirpsView {
  constructor(canvas, clipped) {
    Object.assign(this, { canvas, clipped });
    this.draw = painter(() => this.paint());
  }

  take(header, codes, sample_interval_s) {
    Object.assign(this, { header, codes, sample_interval_s });
    const by = header.clipped_by_rx, all = by.reduce((a, b) => a + b, 0);
    this.clipped.textContent = all ? `${all} samples clipped (by receiver: ${by.join(', ')})` : 'no sample clipped';
    this.clipped.className = all ? 'unsaved' : '';
    this.draw();
  }

  paint() {
    const begun = begin(this.canvas);
    if (!begun || !this.header) return;
    const { g, width, height } = begun, n = this.header.samples;
    const chirp = this.codes.subarray(0, n), least = this.codes.subarray(n, 2 * n), most = this.codes.subarray(2 * n, 3 * n);
    // Range of the codes, or the full range of the ADC.
    const span = this.whole ? [0, LARGEST] : [Math.min(...least), Math.max(...most)], margin = Math.max(8, 0.06 * (span[1] - span[0]));
    const low = Math.max(-40, span[0] - margin), high = Math.min(LARGEST + 40, span[1] + margin);
    const x = i => LEFT + (i + 0.5) / n * (width - LEFT - RIGHT), y = code => TOP + (1 - (code - low) / (high - low)) * (height - TOP - BOTTOM);
    g.textAlign = 'right';
    g.textBaseline = 'middle';
    g.strokeStyle = theme.line;
    for (const [code, text] of this.whole ? [0, 1024, 2048, 3072, LARGEST].map(c => [c, c]) : ticks(low, high, 5)) {
      g.fillText(text, LEFT - 5, y(code));
      g.beginPath(); g.moveTo(LEFT, y(code)); g.lineTo(width - RIGHT, y(code)); g.stroke();
    }
    g.textAlign = 'center';
    g.textBaseline = 'alphabetic';
    for (const [value, text] of ticks(0, n - 1, 8)) g.fillText(text, x(value), height - BOTTOM + 14);
    g.fillStyle = theme.soft;
    g.fillText(`sample of ${(this.sample_interval_s * 1e6).toFixed(2)} µs; receiver ${this.header.rx + 1}, chirp ${this.header.chirp}`, (LEFT + width) / 2, height - 5);
    g.textAlign = 'left';
    g.fillText('code', 4, height - 5);
    g.fillStyle = theme.mark;
    g.globalAlpha = 0.25;
    g.beginPath();
    most.forEach((c, i) => g.lineTo(x(i), y(c)));
    for (let i = n - 1; i >= 0; i--) g.lineTo(x(i), y(least[i]));
    g.fill();
    g.globalAlpha = 1;
    g.strokeStyle = theme.mark;
    g.lineWidth = 1.4;
    g.beginPath();
    chirp.forEach((c, i) => g.lineTo(x(i), y(c)));
    g.stroke();
    g.fillStyle = theme.alarm;
    for (let i = 0; i < n; i++) {
      if (least[i] === 0) g.fillRect(x(i) - 2, y(0) - 3, 4, 6);
      if (most[i] >= LARGEST) g.fillRect(x(i) - 2, y(LARGEST) - 3, 4, 6);
    }
  }
}
