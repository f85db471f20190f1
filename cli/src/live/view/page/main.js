// Page: passes messages of the link to the views, and input of the user to the link.

import { ChirpsView } from './chirps.js';
import { DopplerView } from './doppler.js';
import { HealthStrip, brief } from './health.js';
import { LabelList } from './labels.js';
import { Link, floats, words } from './link.js';
import { MapView } from './map.js';
import { clock } from './plot.js';
import { ProfileView } from './profile.js';
import { History, Timeline } from './timeline.js';

const $ = id => document.getElementById(id);
// Browsers may refuse to store anything; choices then last as long as the page.
const stored = key => { try { return localStorage.getItem(key); } catch { return null; } };
const store = (key, value) => { try { localStorage.setItem(key, value); } catch { /* It is not kept. */ } };
const page = window.radome = { pictures: 0, header: null, hello: null, labels: null, playback: null, last: null };

const map = new MapView($('map'), $('echo'), $('pointed'));
const partner = new MapView($('partner'), $('partner-echo'), null);
const profile = new ProfileView($('profile'));
const doppler = new DopplerView($('doppler'));
const chirps = new ChirpsView($('chirps'), $('clipped'));
const health = new HealthStrip($('health'));
const timeline = new Timeline($('timeline'), {
  seek: time => seek(time),
  move: (id, start_s, end_s) => send({ do: 'move', id, start_s, end_s }),
  select: id => select(id),
});
const list = new LabelList({
  list: $('labels-list'), count: $('labels-count'), state: $('labels-state'),
  send: request => send(request), goTo: time => seek(time), select: id => select(id),
});
Object.assign(page, { map, partner, profile, doppler, chirps, timeline, send: request => send(request) });

// ---- messages

/** Arrival time of the newest frame. */
let arrived_ms = 0;

const STATES = {
  open: '', lost: 'no connection', over: 'the run is over',
  locked: 'a token is needed: open the link that the program shows', full: 'too many pages are open: close one of them',
};

const link = new Link({
  picture({ header, parts }) {
    page.pictures++;
    page.header = header;
    timeline.history.add(header.history);
    health.take(header.health);
    const { answer } = header, isNew = page.last !== answer.sequence;
    page.last = answer.sequence;
    if (isNew) arrived_ms = performance.now();
    timeline.now = answer.time_s;
    timeline.draw();
    say(silent_s() ? null : answer);
    if (header.map) {
      const floor = floats(parts.floor);
      map.take(header.map, parts.map, floor);
      profile.take(header.map, parts.map, floor, map.hold);
      if (isNew) doppler.take(header.map, parts.map, floor, answer.time_s);
    } else {
      map.none(answer.warming_up ? `the network’s map warms up: ${answer.warming_up}` : 'no map');
      profile.none();
    }
    if (header.partner) {
      partner.low = map.low ?? map.auto?.[0] ?? null;
      partner.high = map.high ?? map.auto?.[1] ?? null;
      partner.take(header.partner, parts.partner, floats(parts.partner_floor));
    } else if (page.hello?.partner) partner.none('the pair has no partner for this frame');
    if (header.chirps) chirps.take(header.chirps, words(parts.chirps), page.hello.sample_interval_s);
    place();
  },
  news({ hello, labels, playback, access, refused, over }) {
    if (hello) greet(hello);
    if (labels) {
      page.labels = labels;
      timeline.spans = labels.spans;
      timeline.open = labels.open;
      timeline.draw();
      list.take(labels);
      for (const button of document.querySelectorAll('#keys [data-label]')) button.setAttribute('aria-pressed', labels.open?.label === button.dataset.label);
      $('stop').disabled = !labels.open;
      $('undo').disabled = !labels.can_undo;
      $('redo').disabled = !labels.can_redo;
      offer(labels.adaptation);
      if (labels.fault && labels.fault !== page.labelFault) notice(`Labels are not saved: ${labels.fault}`);
      page.labelFault = labels.fault;
    }
    if (playback) {
      page.playback = playback;
      $('play').textContent = playback.playing ? 'Pause' : playback.at_end ? 'Play again' : 'Play';
      const options = [...$('speed').options], known = options.find(option => Number(option.value) === playback.speed);
      // "fastest", whose value is 0, is the last one.
      if (!known) $('speed').add(new Option(`${playback.speed}×`, playback.speed), options.find(({ value }) => !Number(value) || value > playback.speed));
      $('speed').value = playback.speed;
      place();
    }
    if (access) health.access(access);
    if (refused) notice(refused);
    if (over) {
      notice(`The run is over: ${over.over?.frames ?? over.frames ?? ''} frames.`);
      page.isOver = true;
      list.end();
    }
  },
  state(state) {
    page.state = state;
    $('status').textContent = STATES[state];
    $('status').classList.toggle('bad', state !== 'open');
    if (state !== 'open') $('frame').textContent = '';
    if (state === 'open') look();
    else say(null);
  },
});
/** Sends a request. The user learns of one that is not sent; what to look at is sent again when the connection is back. */
const send = request => { if (!link.send(request) && request.do !== 'look') notice('No connection: nothing was changed.'); };

function greet(hello) {
  if (page.state === 'open' && page.isOver) $('notice').hidden = true;
  page.isOver = false;
  page.hello = hello;
  // The program sends the history again; it may be another run.
  timeline.history = new History();
  health.hello(hello);
  timeline.tape = hello.tape;
  timeline.interval = hello.frame_interval_s;
  // Read-only pages get no controls that change labels.
  list.readOnly = timeline.readOnly = $('keys').hidden = $('who-label').hidden = hello.read_only_labels;
  $('tape').hidden = !hello.tape;
  if (!hello.tape) list.goTo = null;
  else {
    Object.assign($('seek'), { min: hello.tape.first_s, max: hello.tape.last_s });
    Object.assign($('at'), { min: hello.tape.first_s, max: hello.tape.last_s });
    if (hello.tape.last_s - hello.tape.first_s > 60 && !page.windowed) $('window').value = 60;
  }
  $('chirp').max = hello.chirps - 1;
  $('partner-card').hidden = !hello.partner;
  document.body.classList.toggle('with-partner', hello.partner);
  const chosen = $('channel').value, options = [['"sum"', hello.rx > 1 ? 'mean of all' : 'receiver 1'], ['"network"', 'as the network sees it']];
  if (hello.rx > 1) for (let rx = 0; rx < hello.rx; rx++) options.splice(1 + rx, 0, [JSON.stringify({ rx }), `receiver ${rx + 1}`]);
  $('channel').replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  const wanted = chosen || stored('channel');
  if (options.some(([value]) => value === wanted)) $('channel').value = wanted;
  look();
}

/** Shows the command that adapts the model with the labels, if there are any. */
function offer(adaptation) {
  $('adapt').hidden = !adaptation;
  $('adapt-text').textContent = adaptation?.text ?? '';
  $('adapt-row').hidden = !adaptation?.command;
  if ($('adapt-command').textContent !== (adaptation?.command ?? '')) {
    $('adapt-command').textContent = adaptation?.command ?? '';
    $('adapt-copy').textContent = 'Copy';
  }
}

/** Copies the command. Browsers allow this only on local and encrypted pages; elsewhere the command is selected. */
async function copyCommand() {
  try {
    await navigator.clipboard.writeText($('adapt-command').textContent);
    $('adapt-copy').textContent = 'Copied';
  } catch {
    getSelection().selectAllChildren($('adapt-command'));
    $('adapt-copy').textContent = 'Selected';
  }
}

/** Shows the text of an answer, also in the title: tabs of several rooms are told apart by it. */
function answered(text) {
  if ($('answer').value !== text) $('answer').value = text;
  const { hello } = page, title = hello ? `${text} · ${hello.name ?? brief(hello.source)} · radome` : 'radome';
  if (document.title !== title) document.title = title;
}

/**
 * Shows an answer in all its fields. `null` stands for none: the fields are cleared and the plots of the last frame
 * dimmed, so that old ones do not look like the present ones.
 */
function say(answer) {
  const { label, probabilities, occupied, truth, transition, warming_up, no_signal } = answer ?? {};
  document.body.classList.toggle('stale', !answer);
  answered(label ?? (warming_up ? `warming up ${warming_up}` : no_signal ? 'no signal' : '–'));
  $('confidence').textContent = probabilities && label ? `${(100 * probabilities[label]).toFixed(0)} %` : '';
  $('occupied').hidden = !probabilities;
  $('occupied').textContent = occupied ? 'occupied' : 'not occupied';
  $('occupied').classList.toggle('on', Boolean(occupied));
  $('truth').textContent = truth ? `truth: ${truth}${transition ? ', coming or going' : ''}` : '';
  if (!answer) health.put('frames/s', '–');
  else if (page.state === 'open') {
    // The number stands outside of the live region: screen readers would read each frame.
    $('frame').textContent = `frame ${answer.sequence} · ${clock(answer.time_s, 2)}`;
    $('status').textContent = '';
    $('status').classList.remove('bad');
  }
}

/** Seconds without a frame if they are too many, else 0. A recording may be paused at a frame. */
function silent_s() {
  const seconds = (performance.now() - arrived_ms) / 1000;
  return page.hello && !page.hello.tape && seconds > Math.max(2, 5 * page.hello.frame_interval_s) ? seconds : 0;
}

setInterval(() => {
  const seconds = silent_s();
  if (!seconds || page.state !== 'open') return;
  say(null);
  $('frame').textContent = '';
  $('status').textContent = `no frames for ${Math.floor(seconds)} s`;
  $('status').classList.add('bad');
}, 500);

let seeking = false;
function place() {
  const tape = page.hello?.tape, answer = page.header?.answer;
  if (!tape || !answer) return;
  if (!seeking) $('seek').value = answer.time_s;
  if (document.activeElement !== $('at')) $('at').value = answer.time_s.toFixed(2);
  $('position').textContent = `of ${clock(tape.last_s)} · frame ${answer.sequence} of ${tape.last_sequence}`;
  $('seek').setAttribute('aria-valuetext', `${clock(answer.time_s)}, frame ${answer.sequence}`);
}

let fading = 0;
function notice(text) {
  $('notice').textContent = text;
  $('notice').hidden = false;
  clearTimeout(fading);
  fading = setTimeout(() => { $('notice').hidden = true; }, 8000);
}

// ---- user input

function look() {
  if (!page.hello) return;
  const channel = JSON.parse($('channel').value || '"sum"');
  $('removal').disabled = channel === 'network';
  const chirp = $('chirps-card').open ? Math.max(0, Math.min(page.hello.chirps - 1, Math.round(Number($('chirp').value)) || 0)) : null;
  send({ do: 'look', channel, removal: $('removal').value, chirp, partner: page.hello.partner && $('partner-on').checked });
}

/** Applies a new selection and discards the held maxima of the old one. */
function relook() {
  store('channel', $('channel').value);
  store('removal', $('removal').value);
  for (const view of [map, partner, profile, doppler]) view.forget();
  look();
}

/** Seeks in the recording. While the user drags, requests are throttled: each one reads the frames before it. */
let sought = null, resting = 0, aimed = { time_s: 0, at: -Infinity };
function seek(time_s) {
  if (!page.hello?.tape || !Number.isFinite(time_s)) return;
  sought = time_s;
  aimed = { time_s, at: performance.now() };
  if (!resting) seekNow();
}

/** Sends the seek that waits, if there is one. */
function seekNow() {
  if (sought === null) return;
  send({ do: 'seek', time_s: sought });
  sought = null;
  clearTimeout(resting);
  resting = setTimeout(() => { resting = 0; seekNow(); }, 200);
}

function select(id) { timeline.selected = id; list.mark(id); timeline.draw(); }
function who() { return $('who').value.trim() || null; }
/** Time of the frame that the user sees: a label begins and ends there, also where the newest frame is still on its way. */
const shown_s = () => page.header?.answer?.time_s;
function label(occupancy) { send({ do: 'label', occupancy, who: who(), shown_s: shown_s() }); }
const stopLabel = () => send({ do: 'stop', shown_s: shown_s() });
// The recording plays from the frame that was sought, and steps are counted from it.
function play() { seekNow(); send({ do: page.playback?.playing ? 'pause' : 'play' }); }
function step(frames) { seekNow(); send({ do: 'step', frames }); }

/** Selects the next or the previous option of a select element. */
function turn(element, by, round = false) {
  const n = element.options.length, index = element.selectedIndex + by;
  element.selectedIndex = round ? (index + n) % n : Math.max(0, Math.min(n - 1, index));
  element.dispatchEvent(new Event('change'));
}

$('removal').value = stored('removal') ?? 'mean';
$('who').value = stored('who') ?? '';
$('who').addEventListener('change', () => store('who', $('who').value));
$('channel').addEventListener('change', relook);
$('removal').addEventListener('change', relook);
$('over-floor').addEventListener('change', () => { map.overFloor = partner.overFloor = $('over-floor').checked; map.forget(); partner.forget(); look(); });
$('hold').addEventListener('change', () => { map.hold = partner.hold = $('hold').checked; look(); });
$('hold-reset').addEventListener('click', () => { for (const view of [map, partner, profile]) view.forget(); look(); });
for (const id of ['low', 'high']) $(id).addEventListener('input', () => { map[id] = $(id).value === '' ? null : Number($(id).value); map.draw(); });
$('partner-on').addEventListener('change', look);
$('chirps-card').addEventListener('toggle', look);
$('chirp').addEventListener('input', look);
$('whole').addEventListener('change', () => { chirps.whole = $('whole').checked; chirps.draw(); });
$('window').addEventListener('change', () => { page.windowed = true; timeline.window = Number($('window').value); timeline.draw(); });
$('play').addEventListener('click', play);
$('step').addEventListener('click', () => step(1));
$('step-back').addEventListener('click', () => step(-1));
$('speed').addEventListener('change', () => send({ do: 'speed', times: Number($('speed').value) }));
$('seek').addEventListener('input', () => { seeking = true; seek(Number($('seek').value)); });
$('seek').addEventListener('change', () => { seeking = false; });
$('at').addEventListener('change', () => { if ($('at').value === '') place(); else seek(Number($('at').value)); });
for (const button of document.querySelectorAll('#keys [data-label]')) button.addEventListener('click', () => label(button.dataset.label));
$('stop').addEventListener('click', stopLabel);
$('undo').addEventListener('click', () => send({ do: 'undo' }));
$('redo').addEventListener('click', () => send({ do: 'redo' }));
$('adapt-copy').addEventListener('click', copyCommand);
$('help-open').addEventListener('click', () => $('help').showModal());

// A select element that was opened with a pointer loses the focus after a change.
let pointed = false;
addEventListener('pointerdown', () => { pointed = true; }, true);
addEventListener('keydown', () => { pointed = false; }, true);
document.addEventListener('change', event => { if (pointed && event.target.tagName === 'SELECT') event.target.blur(); });

const toggle = id => { $(id).checked = !$(id).checked; $(id).dispatchEvent(new Event('change')); };
// Jumps that follow each other quickly add up: the frame of the first one may not have come yet.
const jump = seconds => {
  const { first_s, last_s } = page.hello.tape;
  const from = performance.now() - aimed.at < 500 ? aimed.time_s : page.header?.answer.time_s;
  if (from !== undefined) seek(Math.max(first_s, Math.min(last_s, from + seconds)));
};
const KEYS = {
  '0': () => label('empty'), '1': () => label('one'), '2': () => label('two'),
  e: stopLabel, u: () => send({ do: 'undo' }), U: () => send({ do: 'redo' }),
  c: () => turn($('channel'), 1, true), s: () => turn($('removal'), 1, true),
  h: () => toggle('hold'), x: () => $('hold-reset').click(), f: () => toggle('over-floor'),
  r: () => { $('chirps-card').open = !$('chirps-card').open; }, l: () => { $('labels-card').open = !$('labels-card').open; },
  '+': () => turn($('window'), -1), '=': () => turn($('window'), -1), '-': () => turn($('window'), 1),
  '?': () => $('help').showModal(),
};
const TAPE = {
  ' ': play, ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => seek(page.hello.tape.first_s), End: () => seek(page.hello.tape.last_s),
  '[': () => turn($('speed'), -1), ']': () => turn($('speed'), 1),
};
$('shortcuts').checked = stored('shortcuts') !== 'off';
$('shortcuts').addEventListener('change', () => store('shortcuts', $('shortcuts').checked ? 'on' : 'off'));
addEventListener('keydown', event => {
  if (event.ctrlKey || event.metaKey || event.altKey || $('help').open) return;
  // Speech input and trembling hands press single characters without intent.
  if (!$('shortcuts').checked && event.key.length === 1) return;
  const { target } = event, tag = target.tagName;
  const isTyping = tag === 'SELECT' || tag === 'INPUT' && !['checkbox', 'range'].includes(target.type);
  if (isTyping) { if (event.key === 'Escape') target.blur(); return; }
  // Keys that controls use themselves are not shortcuts.
  if (event.key === ' ' && ['BUTTON', 'SUMMARY', 'INPUT', 'A'].includes(tag)) return;
  if (tag === 'INPUT' && target.type === 'range' && /^(Arrow|Home|End|Page)/.test(event.key)) return;
  // Caps Lock changes no shortcut.
  const key = event.key.length > 1 ? event.key : event.shiftKey ? event.key.toUpperCase() : event.key.toLowerCase();
  let act = KEYS[key];
  if (page.hello?.tape) {
    act ??= TAPE[event.key];
    if (event.shiftKey && event.key === 'ArrowLeft') act = () => jump(-5);
    if (event.shiftKey && event.key === 'ArrowRight') act = () => jump(5);
  }
  if (!act) return;
  event.preventDefault();
  if (event.repeat && !/Arrow/.test(event.key)) return;
  act();
});
const drawAll = () => { for (const view of [map, partner, profile, doppler, chirps, timeline]) view.draw(); };
addEventListener('resize', drawAll);
document.addEventListener('visibilitychange', () => { if (!document.hidden) drawAll(); });
// After plot.js has read the new colours.
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', drawAll);
