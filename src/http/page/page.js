// The status page: a strip of frames, the chosen frame in figures and in 3D, and a chart of throughput.
//
//   /api/frames ──▶ frames, in order ◀── /events: what has changed since
//                        │
//            strip · figures · scene.js (three.js) · chart ◀── /api/status
//
// Only the visible part of the strip is in the document, so ten thousand frames cost as much as fifty. All
// external data is inserted as text, never as markup.

import { natural } from './order.js';

const STEP_PX = 120;
const PLAY_MS = 1000 / 12;
const PREFETCH = 4;
// Frames that are only scrolled past get no picture.
const PICTURE_MS = 90;
const STAGES = ['read', 'rasterize', 'smooth', 'contour', 'write', 'preview'];

const $ = id => document.getElementById(id);
let frames = new Map(); // by name
let order = []; // names, in natural order
let counts = {};
let status = {};
let isConnected = false;
let chosen = null;
let scene = null;
let playing = false;
// Counters of requests: an answer to an outdated request is ignored.
let detailRequests = 0;
let playRequests = 0;
let settingsRequests = 0;

// ---- frames ----

/** The index of a name in the order, or where it would be inserted. */
function insertionIndex(name) {
  let [low, high] = [0, order.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (natural(order[middle], name) < 0) low = middle + 1; else high = middle;
  }
  return low;
}

function addFrame(frame) {
  if (!frames.has(frame.name)) order.splice(insertionIndex(frame.name), 0, frame.name);
  frames.set(frame.name, frame);
}

function removeFrame(name) {
  if (!frames.delete(name)) return;
  const index = order.indexOf(name);
  if (index >= 0) order.splice(index, 1);
}

async function json(path, options) {
  const response = await fetch(path, options);
  if (!response.ok) throw new Error(`${path}: ${response.status}`);
  return response.json();
}

/** Loads all frames, and the position from which events continue. Meanwhile the page keeps showing the earlier state. */
async function loadAll() {
  const [all, names] = [new Map(), []];
  let [at, after] = [null, null];
  do {
    const page = await json('api/frames?limit=2000' + (after === null ? '' : `&after=${encodeURIComponent(after)}`));
    at ??= page.at;
    for (const frame of page.frames) {
      // The pages arrive in natural order.
      if (!all.has(frame.name)) names.push(frame.name);
      all.set(frame.name, frame);
    }
    after = page.next;
  } while (after !== null);
  return { at, all, names };
}

let source = null;
async function follow() {
  source?.close();
  try {
    const { at, all, names } = await loadAll();
    const answer = await json('api/status');
    // All at once, so that names and frames always match.
    [frames, order, counts, status] = [all, names, answer.frames, answer.status];
    showAll();
    showSettings();
    source = new EventSource(`events?after=${at}`);
  } catch {
    showConnection(false);
    setTimeout(follow, 2000);
    return;
  }
  source.onopen = () => showConnection(true);
  source.onerror = () => {
    showConnection(false);
    if (source.readyState === EventSource.CLOSED) setTimeout(follow, 2000);
  };
  source.addEventListener('resync', follow);
  source.addEventListener('change', event => {
    const change = JSON.parse(event.data);
    change.frames.forEach(addFrame);
    change.removed.forEach(removeFrame);
    counts = change.counts;
    status = change.status ?? status;
    if (change.settings) showSettings();
    showAll();
    if (change.frames.some(frame => frame.name === chosen)) showFrame();
  });
}

function showConnection(connected) {
  isConnected = connected;
  $('link').className = isConnected ? 'good' : 'bad';
  $('link').textContent = isConnected ? 'live' : status.stopping ? 'stopped' : 'no connection';
  showAlarms();
  showProgress();
}

/** Shows what is wrong now. Without a connection, that is unknown. */
function showAlarms() {
  const alarms = [status.paused && `paused: ${status.paused}`, ...(status.unavailable ?? []), status.stopping && 'stopping'];
  $('alarm').textContent = isConnected ? alarms.filter(Boolean).join(' · ') : '';
  $('alarm').hidden = !$('alarm').textContent;
}

// ---- list of frames ----

let listed = [];
let countsText = null;
function updateListed() {
  listed = $('only-failed').checked ? order.filter(name => frames.get(name).state === 'failed') : order;
}

function showAll() {
  updateListed();
  const states = ['done', 'working', 'queued', 'waiting', 'retrying', 'failed'].filter(state => counts[state]);
  const texts = states.map(state => `${number(counts[state])} ${state}`);
  if (texts.join() !== countsText) {
    countsText = texts.join();
    $('counts').replaceChildren(...(texts.length ? texts.map((text, i) => make('span', states[i], text)) : ['no frames yet']));
  }
  showAlarms();
  showProgress();
  if ($('follow').checked && !playing) {
    const newest = listed.findLast(name => frames.get(name).surface) ?? listed.at(-1);
    if (newest !== undefined && newest !== chosen) return choose(newest, true);
  }
  if (chosen === null && listed.length) return choose(listed[0], true);
  showScrub();
  showStrip();
}

function showScrub() {
  $('scrub').max = Math.max(0, listed.length - 1);
  const index = listed.indexOf(chosen);
  $('scrub').value = Math.max(0, index);
  $('scrub').setAttribute('aria-valuetext', chosen ?? 'none');
  $('position').textContent = index < 0 ? '' : `${number(index + 1)} / ${number(listed.length)}`;
}

// ---- the strip ----

const shown = new Map(); // elements, by name
let isStripScheduled = false;
let arePicturesScheduled = false;
function showStrip() {
  if (isStripScheduled) return;
  isStripScheduled = true;
  requestAnimationFrame(() => {
    isStripScheduled = false;
    const strip = $('strip');
    $('strip-content').style.width = `${listed.length * STEP_PX}px`;
    const first = Math.max(0, Math.floor(strip.scrollLeft / STEP_PX) - 3);
    const last = Math.min(listed.length, Math.ceil((strip.scrollLeft + strip.clientWidth) / STEP_PX) + 3);
    const wanted = new Set(listed.slice(first, last));
    for (const [name, element] of shown) {
      if (!wanted.has(name)) {
        element.remove();
        shown.delete(name);
      }
    }
    const seenUntil = performance.now() - PICTURE_MS;
    let isEarly = false;
    for (let index = first; index < last; index++) isEarly = showCell(index, listed[index], seenUntil) || isEarly;
    if (isEarly && !arePicturesScheduled) {
      arePicturesScheduled = true;
      setTimeout(() => {
        arePicturesScheduled = false;
        showStrip();
      }, PICTURE_MS);
    }
  });
}

/** Shows a frame at its index; returns whether it is too early to load its picture. */
function showCell(index, name, seenUntil) {
  const frame = frames.get(name);
  let cell = shown.get(name);
  if (!cell) {
    // A long name is cut at its start, behind the number of its folder, as text from right to left, so it must be
    // isolated from that direction.
    const folder = name.match(/^\d+\//)?.[0] ?? '';
    const text = make('bdi', '', name.slice(folder.length));
    text.dir = 'ltr';
    cell = make('div', '', make('div', 'picture'), make('div', 'name', folder, make('span', '', text)), make('div', 'details'));
    cell.setAttribute('role', 'option');
    cell.id = `frame-${cells++}`;
    cell.since = performance.now();
    cell.addEventListener('click', () => choose(name));
    shown.set(name, cell);
    $('strip-content').append(cell);
  }
  cell.style.left = `${index * STEP_PX + 4}px`;
  cell.className = `frame ${frame.state}`;
  cell.title = frame.reason ?? frame.name;
  const isChosen = name === chosen;
  cell.setAttribute('aria-selected', isChosen);
  if (isChosen) $('strip').setAttribute('aria-activedescendant', cell.id);
  const [picture, , details] = cell.children;
  details.textContent = frame.stage ?? (frame.state === 'done' ? `done ${seconds(frame.seconds)}` : frame.state);
  const isEarly = seenUntil < cell.since;
  if (!isEarly) showPicture(picture, frame);
  return isEarly;
}
let cells = 0;

/** Why the frame failed or waits, without the path that precedes it: the name is already shown. */
function reasonOf(frame) {
  const file = frame.name.split('/').at(-1);
  return frame.reason?.split(`${file}: `).at(-1).replace(/^(\/|[A-Za-z]:[\\/]|\\\\).*?: /, '');
}

function showPicture(box, frame) {
  const path = frame.picture && `files/${encodeURIComponent(frame.picture)}?at=${frame.since_ms}`;
  if (!path) {
    box.textContent = frame.state === 'done' ? '' : reasonOf(frame) ?? frame.state;
  } else if (box.firstChild?.dataset?.path !== path) {
    const image = make('img');
    image.alt = '';
    image.decoding = 'async';
    image.dataset.path = path;
    image.src = path;
    box.replaceChildren(image);
  }
}

function make(tag, className = '', ...children) {
  const element = document.createElement(tag);
  element.className = className;
  element.append(...children);
  return element;
}

// ---- choosing, playing ----

function choose(name, isFollowing = false) {
  if (name === undefined || !frames.has(name)) return;
  if (!isFollowing) $('follow').checked = false;
  chosen = name;
  bringIntoView();
  showScrub();
  showStrip();
  showFrame();
  return showSurface();
}

/** Scrolls the strip so that the chosen frame is visible. */
function bringIntoView() {
  const strip = $('strip');
  const left = listed.indexOf(chosen) * STEP_PX;
  if (left < strip.scrollLeft || strip.scrollLeft + strip.clientWidth < left + STEP_PX) {
    $('strip-content').style.width = `${listed.length * STEP_PX}px`;
    strip.scrollLeft = left - (strip.clientWidth - STEP_PX) / 2;
  }
}

async function showSurface() {
  const frame = frames.get(chosen);
  if (!scene || !frame) return;
  $('hint').textContent = frame.surface ? frame.name : `${frame.name}: ${reasonOf(frame) ?? frame.stage ?? frame.state}`;
  if (!frame.surface) return scene.clear();
  const index = listed.indexOf(chosen);
  const next = listed.slice(index + 1, index + 1 + PREFETCH).map(name => frames.get(name)).filter(one => one.surface);
  try {
    await scene.show(surfacePath(frame), next.map(surfacePath));
  } catch (error) {
    const current = frames.get(chosen);
    if (!current?.surface || surfacePath(current) !== surfacePath(frame)) return;
    scene.clear();
    $('hint').textContent = `${frame.name}: ${isConnected ? error.message : 'no connection to the daemon'}`;
  }
}

function surfacePath(frame) {
  return `files/${encodeURIComponent(frame.surface)}?at=${frame.since_ms}`;
}

async function play(isPlaying) {
  if (playing === isPlaying) return;
  // An earlier playback ends with its next step, and no longer updates the button.
  const request = ++playRequests;
  showPlaying(isPlaying);
  try {
    while (playing && request === playRequests) {
      const began = performance.now();
      const index = listed.indexOf(chosen);
      const next = listed.slice(index + 1).find(name => frames.get(name).surface)
        ?? listed.find(name => frames.get(name).surface);
      if (next === undefined) break;
      await choose(next);
      await new Promise(done => setTimeout(done, Math.max(0, PLAY_MS - (performance.now() - began))));
    }
  } finally {
    if (request === playRequests) showPlaying(false);
  }
}

function showPlaying(isPlaying) {
  playing = isPlaying;
  $('play').textContent = playing ? 'Pause' : 'Play';
}

function step(by) {
  const index = Math.min(Math.max(listed.indexOf(chosen) + by, 0), listed.length - 1);
  choose(listed[index]);
}

// ---- figures ----

async function showFrame() {
  const request = ++detailRequests;
  let frame = frames.get(chosen);
  if (!frame) return;
  let isWhole = false;
  try {
    frame = await json(`api/frames/${encodeURIComponent(chosen)}`);
    isWhole = true;
  } catch {
    // The frame is gone, or the connection is: the summary from the strip is shown.
  }
  if (request !== detailRequests) return;
  const parts = [make('h2', '', frame.name)];
  if (frame.reason) parts.push(make('p', 'reason', frame.reason));
  const figures = frame.figures;
  parts.push(pairs([
    ['state', frame.stage ? `in ${frame.stage}` : frame.state],
    ['since', new Date(frame.since_ms).toLocaleTimeString()],
    ['particles', number(frame.particles)],
    ['voxels', number(figures?.voxels)],
    ['triangles', number(figures?.triangles)],
    ['pieces', number(figures?.components)],
    ['peak memory', bytes(figures?.peak_memory_bytes)],
    ['validation', figures && (figures.certificate.holds ? 'passed' : 'failed')],
    ['file', bytes(frame.input_bytes)],
    ['failed attempts', frame.attempts || null],
    ['total time', seconds(frame.seconds)],
  ]));
  if (figures) parts.push(...stageBar(figures.seconds));
  else if (isWhole && frame.state === 'done') parts.push(make('p', 'note', 'No statistics were recorded for this frame.'));
  for (const note of figures?.notes ?? []) parts.push(make('p', 'note', note));
  const links = (frame.outputs ?? []).map(output => {
    const link = make('a', '', `${output.name} (${bytes(output.size_bytes)})`);
    link.href = `files/${encodeURIComponent(output.name)}`;
    // Frames in several folders may have the same name.
    link.download = output.name.replaceAll('/', '_');
    return link;
  });
  $('frame').replaceChildren(...parts, ...links);
}

function stageBar(times) {
  const bar = make('div', 'bar');
  const key = make('ul', 'key');
  const total = STAGES.reduce((sum, stage) => sum + times[stage], 0) || 1;
  bar.setAttribute('role', 'img');
  bar.setAttribute('aria-label', STAGES.map(stage => `${stage} ${seconds(times[stage])}`).join(', '));
  for (const stage of STAGES) {
    const part = make('span', stage);
    part.style.width = `${100 * times[stage] / total}%`;
    bar.append(part);
    key.append(make('li', '', make('i', stage), `${stage} ${seconds(times[stage])}`));
  }
  return [bar, key];
}

function pairs(entries) {
  const present = entries.filter(([, value]) => value !== null && value !== undefined && value !== '');
  return make('dl', '', ...present.flatMap(([name, value]) => [make('dt', '', name), make('dd', '', String(value))]));
}

const number = value => value?.toLocaleString() ?? null;
const seconds = value => value === null || value === undefined ? '' : `${value < 10 ? value.toFixed(2) : value.toFixed(0)} s`;
function bytes(value) {
  if (value === null || value === undefined) return null;
  const power = Math.min(Math.floor(Math.log2(Math.max(value, 1)) / 10), 4);
  return `${(value / 2 ** (10 * power)).toFixed(power && value / 2 ** (10 * power) < 100 ? 1 : 0)} ${['B', 'KiB', 'MiB', 'GiB', 'TiB'][power]}`;
}

// ---- settings ----

async function showSettings() {
  const request = ++settingsRequests;
  let answer;
  try {
    answer = await json('api/settings');
  } catch {
    // The connection indicator shows the failure. The event that the settings changed is not repeated, so
    // this retries.
    setTimeout(() => request === settingsRequests && showSettings(), 2000);
    return;
  }
  if (request !== settingsRequests) return;
  // Before the daemon has started, there is no configuration.
  const { watches = [], ...rest } = answer.daemon ?? {};
  const block = (title, values) => make('div', '', make('h3', '', title), pairs(Object.entries(values).map(([name, value]) => settingEntry(name, value))));
  $('settings-text').replaceChildren(
    ...answer.sequences.map(({ sequence, more, ...values }) => block(sequence, { ...values, ...more })),
    ...watches.map(({ input, ...values }) => block(input, values)),
    block('The daemon', rest),
  );
}

/** The label and the value of a setting. */
function settingEntry(name, value) {
  const unit = name.match(/_(bytes|s|ms)$/)?.[1];
  const label = (unit ? name.slice(0, -unit.length - 1) : name).replaceAll('_', ' ');
  if (value === null || value === undefined) return [label, null];
  if (unit === 'bytes') return [label, bytes(value)];
  if (unit) return [label, `${value} ${unit}`];
  return [label, plain(value)];
}

function plain(value) {
  if (typeof value === 'boolean') return value ? 'yes' : 'no';
  if (typeof value === 'number' && !Number.isInteger(value)) return Number(value.toPrecision(6));
  if (Array.isArray(value)) return value.map(plain).join(', ');
  if (value !== null && typeof value === 'object') return Object.entries(value).map(([k, v]) => `${k} ${plain(v)}`).join(', ');
  return value;
}

// ---- the chart ----

let samples = [];
let forecast = {};
let rate = 0; // frames per minute, now
async function showFlow() {
  if (!document.hidden) {
    try {
      const answer = await json('api/status');
      ({ status, samples, forecast } = answer);
      drawFlow();
      showProgress();
    } catch {
      // The connection indicator shows the failure.
    }
  }
  setTimeout(showFlow, 5000);
}

/** Shows how many of the frames are done, and, while there is a connection, the current rate and queue, and an estimate of the time left. */
function showProgress() {
  const { done = 0, failed = 0, ...others } = counts;
  const left = Object.values(others).reduce((sum, count) => sum + count, 0);
  const time = isConnected && left && forecast.seconds_left ? `, about ${duration(forecast.seconds_left)} left` : '';
  const failures = failed ? `, ${number(failed)} failed` : '';
  const total = done + failed + left;
  $('flow-forecast').textContent = total ? `${number(done)} of ${number(total)} frames done${failures}${time}` : '';
  const { queued = 0, working = 0 } = counts;
  $('flow-rate').textContent = `${isConnected ? `${rate.toFixed(0)} ` : ''}frames a minute`;
  $('flow-queue').textContent = `${isConnected ? `${number(queued + working)} ` : ''}queued or in progress`;
}

function duration(value) {
  if (value < 90) return `${Math.round(value)} s`;
  if (value < 5400) return `${Math.round(value / 60)} min`;
  return value < 172800 ? `${(value / 3600).toFixed(1)} h` : `${(value / 86400).toFixed(1)} days`;
}

/** Draws frames per minute as a line, and queued frames and frames in progress as an area; each has its own scale, whose maximum is written above it. */
function drawFlow() {
  const canvas = $('chart');
  const ratio = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  [canvas.width, canvas.height] = [width * ratio, height * ratio];
  if (samples.length < 2) return;
  const pen = canvas.getContext('2d');
  pen.scale(ratio, ratio);
  const style = getComputedStyle(document.documentElement);
  const colour = name => style.getPropertyValue(`--${name}`);
  const [begin, end] = [samples[0].at_ms, samples.at(-1).at_ms];
  const [top, bottom] = [20, height - 18];
  const x = sample => (sample.at_ms - begin) / Math.max(1, end - begin) * width;
  const y = (value, max) => bottom - (bottom - top) * value / Math.max(max, 1);
  // Frames per minute, over the last ten samples.
  const rates = samples.map((sample, i) => {
    const before = samples[Math.max(0, i - 10)];
    return (sample.converted - before.converted) * 60000 / Math.max(1000, sample.at_ms - before.at_ms);
  });
  const queues = samples.map(sample => sample.queued + sample.working);
  const [rateMax, queueMax] = [Math.max(...rates), Math.max(...queues)];
  const trace = (values, max) => {
    pen.beginPath();
    values.forEach((value, i) => pen.lineTo(x(samples[i]), y(value, max)));
  };
  pen.strokeStyle = colour('line');
  for (const level of [top, (top + bottom) / 2, bottom]) pen.strokeRect(0, Math.round(level) + .5, width, 0);
  trace(queues, queueMax);
  pen.lineTo(width, bottom);
  pen.lineTo(0, bottom);
  pen.fillStyle = colour('wait');
  pen.globalAlpha = .35;
  pen.fill();
  pen.globalAlpha = 1;
  trace(rates, rateMax);
  pen.strokeStyle = colour('accent');
  pen.lineWidth = 2;
  pen.stroke();
  pen.font = `12px ${style.fontFamily || 'sans-serif'}`;
  const drawLabel = (text, name, align, at) => {
    pen.fillStyle = colour(name);
    pen.textAlign = align;
    pen.fillText(text, align === 'left' ? 0 : width, at);
  };
  drawLabel(`max ${rateMax.toFixed(0)} frames/min`, 'accent', 'left', 13);
  drawLabel(`max ${number(queueMax)} in the queue`, 'faint', 'right', 13);
  drawLabel(ago(end - begin), 'faint', 'left', height - 3);
  drawLabel('now', 'faint', 'right', height - 3);
  rate = rates.at(-1);
  $('flow-resources').textContent = `${bytes(samples.at(-1).memory_bytes) ?? 'unknown'} of memory · ${bytes(status.disk_free_bytes) ?? 'unknown'} of disk free`;
}

const ago = spanMs => spanMs < 90000 ? `${Math.round(spanMs / 1000)} s ago` : `${Math.round(spanMs / 60000)} min ago`;

// ---- keys and startup ----

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.type === 'range') return;
  const nextFailed = () => {
    const index = listed.indexOf(chosen);
    const isFailed = name => frames.get(name).state === 'failed';
    choose(listed.slice(index + 1).find(isFailed) ?? listed.find(isFailed));
  };
  const actions = {
    ArrowLeft: () => step(-1), ArrowRight: () => step(1), PageUp: () => step(-10), PageDown: () => step(10),
    Home: () => choose(listed[0]), End: () => choose(listed.at(-1)), f: nextFailed, F: nextFailed,
    ' ': () => event.target.tagName === 'BUTTON' || event.target.type === 'checkbox' ? null : play(!playing),
  };
  const action = actions[event.key];
  if (!action || (event.key === ' ' && (event.target.tagName === 'BUTTON' || event.target.type === 'checkbox'))) return;
  event.preventDefault();
  action();
}

document.addEventListener('keydown', key);
$('strip').addEventListener('scroll', showStrip, { passive: true });
addEventListener('resize', () => {
  bringIntoView();
  showStrip();
  drawFlow();
});
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => drawFlow());
$('play').addEventListener('click', () => play(!playing));
$('scrub').addEventListener('input', () => choose(listed[Number($('scrub').value)]));
$('follow').addEventListener('change', showAll);
$('only-failed').addEventListener('change', showAll);

follow();
showFlow();
import('./scene.js').then(module => {
  scene = module.makeScene($('canvas'));
  return showSurface();
}).catch(error => {
  $('hint').textContent = `the 3D view is unavailable: ${error.message}`;
});
