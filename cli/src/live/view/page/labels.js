// List of labels: their storage, and each label with editable times.

import { clock } from './plot.js';

const NAMES = ['empty', 'one', 'two'];

export class LabelList {
  constructor({ list, count, state, send, goTo, select }) {
    Object.assign(this, { list, count, state, send, goTo, select, selected: null, rows: new Map(), readOnly: false });
  }

  take({ spans, open, place, saved, fault }) {
    this.isExportOnly = !place && (spans.length || open) && !this.readOnly;
    this.count.textContent = `(${spans.length}${open ? ', one goes on' : ''})`;
    this.state.className = fault || !saved && !place ? 'unsaved' : '';
    this.state.textContent = this.readOnly ? 'labels are read-only here' : fault ? `not saved: ${fault}`
      : place ? saved ? `saved in ${place}` : `saving in ${place} …`
      : spans.length || open ? 'kept by this page’s program only while it runs: export them' : 'label what you see by the buttons or keys 0, 1 and 2';
    const active = document.activeElement;
    const focused = [...this.list.children].findIndex(element => element.contains(active));
    const kept = new Map();
    for (const { id } of spans) kept.set(id, this.rows.get(id) ?? this.row(id));
    for (const [id, row] of this.rows) if (!kept.has(id)) row.element.remove();
    this.rows = kept;
    spans.forEach((span, index) => {
      const row = kept.get(span.id);
      row.update(span);
      if (this.list.children[index] !== row.element) this.list.insertBefore(row.element, this.list.children[index] ?? null);
    });
    if (focused >= 0 && document.activeElement !== active) {
      // A row that is moved loses the focus. That of a deleted label goes to its neighbour, or to the title of the empty list.
      const neighbour = this.list.children[Math.min(focused, spans.length - 1)];
      const next = neighbour?.querySelector('button:not([hidden]), input') ?? this.list.closest('details').querySelector('summary');
      (this.list.contains(active) ? active : next).focus();
    }
  }

  /** Says of labels that no file holds that they have ended with the program. */
  end() {
    if (!this.isExportOnly) return;
    this.state.className = 'unsaved';
    this.state.textContent = 'the program has ended: labels that were not exported are lost';
  }

  mark(id) {
    this.rows.get(this.selected)?.element.classList.remove('selected');
    this.selected = id;
    this.rows.get(id)?.element.classList.add('selected');
  }

  row(id) {
    const element = document.createElement('li');
    const make = (tag, attributes) => Object.assign(element.appendChild(document.createElement(tag)), attributes);
    const go = make('button', { type: 'button', textContent: 'go to' });
    const start = make('input', { type: 'number', step: 'any' });
    element.append('to');
    const end = make('input', { type: 'number', step: 'any' });
    element.append('s');
    const label = make('select');
    for (const name of NAMES) label.add(new Option(name));
    const who = make('span', {});
    const remove = make('button', { type: 'button', textContent: 'delete' });
    let span = null;
    const move = () => {
      const [a, b] = [start, end].map(input => Number(input.value));
      if (start.value !== '' && end.value !== '' && (a !== span.start_s || b !== span.end_s)) this.send({ do: 'move', id, start_s: a, end_s: b });
      else this.rows.get(id)?.update(span);
    };
    start.addEventListener('change', move);
    end.addEventListener('change', move);
    label.addEventListener('change', () => this.send({ do: 'relabel', id, occupancy: label.value }));
    remove.addEventListener('click', () => this.send({ do: 'delete', id }));
    go.addEventListener('click', () => this.goTo(span.start_s));
    element.addEventListener('focusin', () => this.select(id));
    const update = now => {
      span = now;
      element.dataset.label = span.label;
      const isClass = NAMES.includes(span.label);
      if (!isClass && label.options[0].value !== span.label) label.prepend(new Option(span.label));
      label.value = span.label;
      for (const [input, value, edge] of [[start, span.start_s, 'start'], [end, span.end_s, 'end']]) {
        if (document.activeElement !== input || Number(input.value) !== value) input.value = Number(value.toFixed(6));
        input.setAttribute('aria-label', `${edge} of ${span.label} at ${clock(span.start_s)}, seconds`);
      }
      for (const control of [start, end, label]) control.disabled = this.readOnly;
      remove.hidden = this.readOnly;
      label.setAttribute('aria-label', `class from ${clock(span.start_s)} to ${clock(span.end_s)}`);
      remove.setAttribute('aria-label', `delete ${span.label} from ${clock(span.start_s)} to ${clock(span.end_s)}`);
      go.setAttribute('aria-label', `go to ${clock(span.start_s)}`);
      go.hidden = !this.goTo;
      who.textContent = span.who ?? '';
    };
    return { element, update };
  }
}
