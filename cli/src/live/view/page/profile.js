// Range profile: the strongest cell of each range, and the noise floor.

import { begin, painter, theme, ticks } from './plot.js';

const LEFT = 42, BOTTOM = 34, TOP = 8, RIGHT = 8;

export class ProfileView {
  constructor(canvas) {
    this.canvas = canvas;
    this.draw = painter(() => this.paint());
  }

  take(header, bytes, floor, hold) {
    const { range, doppler, low_db: low, step_db: step } = header;
    const peak = new Float32Array(range).fill(-Infinity);
    for (let i = 0; i < range * doppler; i++) {
      const r = i % range;
      if (bytes[i] !== 255 && low + step * bytes[i] > peak[r]) peak[r] = low + step * bytes[i];
    }
    this.held = hold ? this.held?.length === range ? this.held.map((v, r) => Math.max(v, peak[r])) : peak.slice() : null;
    Object.assign(this, { header, peak, floor });
    const finite = Array.from(floor).filter(Number.isFinite);
    const wants = [Math.min(...finite) - 4, Math.max(...(this.held ?? peak).subarray(2), Math.min(...finite) + 40) + 3];
    if (!this.scale || this.isNew || Math.abs(this.scale[0] - wants[0]) > 30) this.scale = wants;
    else this.scale = this.scale.map((v, i) => v + (i && wants[i] > v ? 0.5 : 0.05) * (wants[i] - v));
    this.isNew = false;
    this.draw();
  }

  none() { this.header = null; this.draw(); }
  forget() { this.held = null; this.isNew = true; }

  paint() {
    const begun = begin(this.canvas);
    if (!begun || !this.header) return;
    const { g, width, height } = begun, { range, range_step_m } = this.header, [low, high] = this.scale;
    const x = r => LEFT + (r + 0.5) / range * (width - LEFT - RIGHT);
    const y = v => TOP + (1 - (v - low) / (high - low)) * (height - TOP - BOTTOM);
    g.strokeStyle = theme.line;
    g.fillStyle = theme.ink;
    g.textAlign = 'right';
    g.textBaseline = 'middle';
    for (const [value, text] of ticks(low, high, 5)) {
      g.fillText(text, LEFT - 5, y(value));
      g.beginPath(); g.moveTo(LEFT, y(value)); g.lineTo(width - RIGHT, y(value)); g.stroke();
    }
    g.textAlign = 'center';
    g.textBaseline = 'alphabetic';
    for (const [value, text] of ticks(0, (range - 1) * range_step_m, Math.max(3, Math.min(8, width / 60)))) g.fillText(text, x(value / range_step_m), height - BOTTOM + 14);
    g.fillStyle = theme.soft;
    g.fillText('range, m', (LEFT + width) / 2, height - 5);
    g.textAlign = 'left';
    g.fillText('dBFS', 4, height - 5);
    g.save();
    g.beginPath(); g.rect(LEFT, TOP, width - LEFT - RIGHT, height - TOP - BOTTOM); g.clip();
    const line = (values, colour, dash) => {
      g.strokeStyle = colour;
      g.lineWidth = 1.6;
      g.setLineDash(dash);
      g.beginPath();
      values.forEach((v, r) => Number.isFinite(v) && g.lineTo(x(r), y(v)));
      g.stroke();
    };
    g.fillStyle = theme.line;
    g.globalAlpha = 0.6;
    g.beginPath();
    g.moveTo(x(0), height);
    this.floor.forEach((v, r) => Number.isFinite(v) && g.lineTo(x(r), y(v)));
    g.lineTo(x(range - 1), height);
    g.fill();
    g.globalAlpha = 1;
    line(this.floor, theme.soft, [5, 4]);
    if (this.held) line(this.held, theme.two, [2, 2]);
    line(this.peak, theme.mark, []);
    g.restore();
    g.textAlign = 'right';
    g.fillStyle = theme.mark;
    g.fillText('strongest', width - RIGHT - 4, TOP + 12);
    g.fillStyle = theme.soft;
    g.fillText('noise floor', width - RIGHT - 4, TOP + 27);
    if (this.held) { g.fillStyle = theme.two; g.fillText('held', width - RIGHT - 4, TOP + 42); }
  }
}
