// State of the run, as a strip of words and numbers.

/** Source without folders: the last part of a path identifies it, except of a device: /dev/pts/1 is not just 1. */
export const brief = source => source.replace(/(?<!\S)(?!\/dev\/)\S*\/(?=[^/\s])/g, '');

export class HealthStrip {
  constructor(list) {
    this.list = list;
    this.items = new Map();
    this.refused = 0;
  }

  put(name, value, { bad = false, title = '' } = {}) {
    let item = this.items.get(name);
    if (value === null || value === undefined || value === '') {
      item?.remove();
      this.items.delete(name);
      return;
    }
    if (!item) {
      item = document.createElement('li');
      item.append(name + ' ', document.createElement('b'));
      this.list.append(item);
      this.items.set(name, item);
    }
    if (item.lastChild.textContent !== value) item.lastChild.textContent = value;
    item.className = bad ? 'bad' : '';
    item.title = title;
  }

  hello({ source, board, model }) {
    this.put('source', brief(source), { title: source });
    this.put('board', board ? board.name : null);
    this.put('firmware', board ? board.firmware : null, { title: board?.chip ?? '' });
    this.put('model', model);
  }

  take(health) {
    this.put('frames/s', health.frames_per_s.toFixed(1));
    this.put('frames', String(health.frames));
    const by = Object.entries(health.dropped_by_reason).filter(([, n]) => n).map(([reason, n]) => `${reason.replaceAll('_', ' ')} ${n}`);
    this.put('lost', health.dropped ? `${health.dropped} (${by.join(', ')})` : '0', { bad: health.dropped > 0 });
    this.put('latency p95', `${health.latency_p95_ms.toFixed(1)} ms`, { title: `median ${health.latency_p50_ms.toFixed(1)} ms, from the last sample to the label` });
    this.put('temperature', health.temperature_c === null ? null : `${health.temperature_c.toFixed(1)} °C`);
    this.put('clipped samples', health.saturated_samples ? String(health.saturated_samples) : null, { bad: true });
  }

  access({ refused, pages }) {
    // Browsers open connections that they do not use, so unanswered ones are not counted.
    const by = Object.entries(refused).filter(([why, n]) => n && why !== 'unanswered'), all = by.reduce((sum, [, n]) => sum + n, 0);
    this.put('pages', pages > 1 ? String(pages) : null);
    this.put('turned away', all ? String(all) : null, { title: by.map(([why, n]) => `${why.replaceAll('_', ' ')} ${n}`).join(', ') });
  }
}
