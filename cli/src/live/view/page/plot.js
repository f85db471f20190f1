// Shared parts of all plots: limits of echoes, colours, a canvas at the screen's resolution, ticks.

/** Number of range bins beside the antenna where no echo is sought, because of leakage: that of dsp/src/detect/detections.rs. */
export const LEAKAGE_BINS = 3;
/**
 * Level over the noise of its range above which an echo stands out, dB. The power of noise is exponential: of the cells of ten
 * thousand maps one reaches 13 dB. The rest is a margin.
 */
export const STANDS_OUT_DB = 18;

const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];

/** Colours of 0 to 254 as RGBA in one number; 255 (not a number) is magenta. */
export const palette = new Uint32Array(256);
for (let i = 0; i < 255; i++) {
  const at = i / 254 * 8, k = Math.min(7, Math.floor(at)), f = at - k;
  const [r, g, b] = VIRIDIS[k].map((c, n) => Math.round(c + f * (VIRIDIS[k + 1][n] - c)));
  palette[i] = (255 << 24 | b << 16 | g << 8 | r) >>> 0;
}
palette[255] = 0xffff00ff;

/** The theme's colours, read once for each theme. */
export const theme = {};
const read = () => {
  const style = getComputedStyle(document.documentElement);
  for (const name of ['ink', 'soft', 'paper', 'card', 'line', 'empty', 'one', 'two', 'alarm', 'mark']) theme[name] = style.getPropertyValue('--' + name).trim();
};
read();
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', read);

/** Of the colours ink and card, the one with more contrast (WCAG) to a background. */
export function readable(background) {
  const luminance = colour => [1, 3, 5].map(at => parseInt(colour.slice(at, at + 2), 16) / 255)
    .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const contrast = colour => {
    const [a, b] = [luminance(colour), luminance(background)];
    return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  };
  return contrast(theme.ink) > contrast(theme.card) ? theme.ink : theme.card;
}

/** Cleared context of a canvas in CSS pixels, with its size; none while it is not shown. */
export function begin(canvas) {
  const width = canvas.clientWidth, height = canvas.clientHeight, scale = devicePixelRatio || 1;
  if (!width || !height) return null;
  const [w, h] = [Math.round(width * scale), Math.round(height * scale)];
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const g = canvas.getContext('2d');
  g.setTransform(scale, 0, 0, scale, 0, 0);
  g.clearRect(0, 0, width, height);
  g.font = '12px system-ui, sans-serif';
  g.fillStyle = theme.ink;
  return { g, width, height };
}

/** Round numbers between two values: [value, text]. */
export function ticks(from, to, most = 7) {
  if (!(to > from)) return [];
  const raw = (to - from) / most, magnitude = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(s => s * magnitude).find(s => s >= raw * 0.999);
  const digits = Math.max(0, Math.ceil(-Math.log10(step) - 1e-9));
  const out = [];
  for (let i = Math.ceil(from / step - 1e-9); i * step <= to + 1e-9 * step; i++) out.push([i * step, (i * step).toFixed(digits)]);
  return out;
}

/** Formats days, hours, minutes and seconds. */
export function clock(time, digits = 1) {
  // Rounded first, so that no second is 60.0.
  const unit = 10 ** digits, units = Math.round(Math.abs(time) * unit), sign = time < 0 && units ? '-' : '';
  const minutes = Math.floor(units / unit / 60), hours = Math.floor(minutes / 60), days = Math.floor(hours / 24);
  const seconds = ((units - 60 * unit * minutes) / unit).toFixed(digits);
  if (!minutes) return `${sign}${seconds} s`;
  const two = number => String(number).padStart(2, '0'), end = seconds.padStart(digits ? digits + 3 : 2, '0');
  if (!hours) return `${sign}${minutes}:${end}`;
  return `${sign}${days ? `${days} d ${two(hours % 24)}` : hours}:${two(minutes % 60)}:${end}`;
}

/** Limits drawing to the screen's refresh rate; draws nothing while the page is hidden. */
export function painter(draw, interval = 0) {
  let asked = false, last = 0;
  const paint = now => {
    if (now - last < interval) { requestAnimationFrame(paint); return; }
    asked = false;
    last = now;
    draw();
  };
  return () => { if (!asked) { asked = true; requestAnimationFrame(paint); } };
}
