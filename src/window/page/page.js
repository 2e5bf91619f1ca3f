// The window: frames in a strip, the chosen one in figures and in space, and how it goes.
//
//   /api/frames ──▶ frames, in order ◀── /events: what has changed since
//                        │
//            strip · figures · scene.js (three.js) · chart ◀── /api/status
//
// Only what can be seen of the strip is in the document, so ten thousand frames cost what fifty do. All that comes
// from outside is put in as text, never as markup.

const STEP_PX = 120;
const PLAY_MS = 1000 / 12;
const PREFETCH = 4;
const STAGES = ['read', 'rasterize', 'smooth', 'contour', 'write'];

const $ = id => document.getElementById(id);
const frames = new Map(); // by name
let order = []; // names, in natural order
let counts = {};
let status = {};
let chosen = null;
let scene = null;
let playing = false;
let detailOf = 0;

// ---- frames ----

/** The same order as that of the daemon: runs of digits are numbers. */
function natural(a, b) {
  const [left, right] = [a, b].map(text => text.match(/\d+|\D/gu) ?? []);
  for (let i = 0; i < Math.min(left.length, right.length); i++) {
    const [l, r] = [left[i], right[i]];
    if (l === r) continue;
    if (/\d/.test(l[0]) && /\d/.test(r[0])) {
      const [x, y] = [BigInt(l), BigInt(r)];
      return x < y ? -1 : x > y ? 1 : l.length - r.length;
    }
    return l < r ? -1 : 1;
  }
  return left.length - right.length;
}

/** Where a name is, or would be. */
function placeOf(name) {
  let [low, high] = [0, order.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (natural(order[middle], name) < 0) low = middle + 1; else high = middle;
  }
  return low;
}

function put(frame) {
  if (!frames.has(frame.name)) order.splice(placeOf(frame.name), 0, frame.name);
  frames.set(frame.name, frame);
}

function drop(name) {
  if (!frames.delete(name)) return;
  const place = order.indexOf(name);
  if (place >= 0) order.splice(place, 1);
}

async function json(path, options) {
  const answer = await fetch(path, options);
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer.json();
}

/** Looks at everything; the place from which events go on. */
async function loadAll() {
  frames.clear();
  order = [];
  let [at, after] = [null, null];
  do {
    const page = await json('api/frames?limit=2000' + (after === null ? '' : `&after=${encodeURIComponent(after)}`));
    at ??= page.at;
    for (const frame of page.frames) {
      // They come in order.
      if (!frames.has(frame.name)) order.push(frame.name);
      frames.set(frame.name, frame);
    }
    after = page.next;
  } while (after !== null);
  return at;
}

let source = null;
async function follow() {
  source?.close();
  try {
    const at = await loadAll();
    const told = await json('api/status');
    [counts, status] = [told.frames, told.status];
    showSettings();
    showAll();
    source = new EventSource(`events?after=${at}`);
  } catch {
    linked(false);
    setTimeout(follow, 2000);
    return;
  }
  source.onopen = () => linked(true);
  source.onerror = () => {
    linked(false);
    if (source.readyState === EventSource.CLOSED) setTimeout(follow, 2000);
  };
  source.addEventListener('resync', follow);
  source.addEventListener('change', event => {
    const change = JSON.parse(event.data);
    change.frames.forEach(put);
    change.removed.forEach(drop);
    counts = change.counts;
    status = change.status ?? status;
    if (change.settings) showSettings();
    showAll();
    if (change.frames.some(frame => frame.name === chosen)) showFrame();
  });
}

function linked(isLinked) {
  $('link').className = isLinked ? 'good' : 'bad';
  $('link').textContent = isLinked ? 'live' : 'no connection';
}

// ---- what is listed ----

let listed = [];
function list() {
  listed = $('only-failed').checked ? order.filter(name => frames.get(name).state === 'failed') : order;
}

function showAll() {
  list();
  const parts = ['done', 'working', 'queued', 'waiting', 'retrying', 'failed'].filter(state => counts[state]);
  $('counts').textContent = parts.map(state => `${counts[state]} ${state}`).join(' · ') || 'no frames yet';
  const alarms = [status.paused && `paused: ${status.paused}`, ...(status.unavailable ?? []), status.stopping && 'stopping'];
  $('alarm').textContent = alarms.filter(Boolean).join(' · ');
  $('alarm').hidden = !$('alarm').textContent;
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
  $('scrub').value = Math.max(0, listed.indexOf(chosen));
  $('scrub').setAttribute('aria-valuetext', chosen ?? 'none');
}

// ---- the strip ----

const shown = new Map(); // elements, by name
let stripAsked = false;
function showStrip() {
  if (stripAsked) return;
  stripAsked = true;
  requestAnimationFrame(() => {
    stripAsked = false;
    const strip = $('strip');
    $('strip-room').style.width = `${listed.length * STEP_PX}px`;
    const first = Math.max(0, Math.floor(strip.scrollLeft / STEP_PX) - 3);
    const last = Math.min(listed.length, Math.ceil((strip.scrollLeft + strip.clientWidth) / STEP_PX) + 3);
    const wanted = new Set(listed.slice(first, last));
    for (const [name, element] of shown) {
      if (!wanted.has(name)) {
        element.remove();
        shown.delete(name);
      }
    }
    for (let place = first; place < last; place++) showCell(place, listed[place]);
  });
}

function showCell(place, name) {
  const frame = frames.get(name);
  let cell = shown.get(name);
  if (!cell) {
    cell = make('div', '', make('div', 'picture'), make('div', 'name'));
    cell.setAttribute('role', 'option');
    cell.id = `frame-${cells++}`;
    cell.addEventListener('click', () => choose(name));
    shown.set(name, cell);
    $('strip-room').append(cell);
  }
  cell.style.left = `${place * STEP_PX + 4}px`;
  cell.className = `frame ${frame.state}`;
  cell.title = frame.reason ?? frame.name;
  const isChosen = name === chosen;
  cell.setAttribute('aria-selected', isChosen);
  if (isChosen) $('strip').setAttribute('aria-activedescendant', cell.id);
  cell.lastChild.textContent = name;
  const text = frame.stage ?? (frame.state === 'done' ? seconds(frame.seconds) : frame.state);
  showPicture(cell.firstChild, frame, text);
}
let cells = 0;

function showPicture(place, frame, text) {
  const path = frame.picture && `files/${encodeURIComponent(frame.picture)}?at=${frame.since_ms}`;
  if (!path) {
    place.textContent = text;
  } else if (place.firstChild?.dataset?.path !== path) {
    const image = make('img');
    image.alt = '';
    image.dataset.path = path;
    image.src = path;
    place.replaceChildren(image);
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
  const strip = $('strip');
  const left = listed.indexOf(name) * STEP_PX;
  if (left < strip.scrollLeft || strip.scrollLeft + strip.clientWidth < left + STEP_PX) {
    $('strip-room').style.width = `${listed.length * STEP_PX}px`;
    strip.scrollLeft = left - (strip.clientWidth - STEP_PX) / 2;
  }
  showScrub();
  showStrip();
  showFrame();
  return showSurface();
}

async function showSurface() {
  const frame = frames.get(chosen);
  if (!scene || !frame) return;
  $('hint').textContent = frame.surface ? frame.name : `${frame.name}: ${frame.reason ?? frame.stage ?? frame.state}`;
  if (!frame.surface) return;
  const place = listed.indexOf(chosen);
  const next = listed.slice(place + 1, place + 1 + PREFETCH).map(name => frames.get(name)).filter(one => one.surface);
  try {
    await scene.show(surfacePath(frame), next.map(surfacePath));
  } catch (error) {
    if (frame.name === chosen) $('hint').textContent = `${frame.name}: ${error.message}`;
  }
}

function surfacePath(frame) {
  return `files/${encodeURIComponent(frame.surface)}?at=${frame.since_ms}`;
}

async function play(isPlaying) {
  if (playing === isPlaying) return;
  playing = isPlaying;
  $('play').textContent = playing ? 'Pause' : 'Play';
  while (playing) {
    const began = performance.now();
    const place = listed.indexOf(chosen);
    const next = listed.slice(place + 1).find(name => frames.get(name).surface)
      ?? listed.find(name => frames.get(name).surface);
    if (next === undefined) break;
    await choose(next);
    await new Promise(done => setTimeout(done, Math.max(0, PLAY_MS - (performance.now() - began))));
  }
  playing = false;
  $('play').textContent = 'Play';
}

function step(by) {
  const place = Math.min(Math.max(listed.indexOf(chosen) + by, 0), listed.length - 1);
  choose(listed[place]);
}

// ---- figures ----

async function showFrame() {
  const turn = ++detailOf;
  let frame = frames.get(chosen);
  if (!frame) return;
  try {
    frame = await json(`api/frames/${encodeURIComponent(chosen)}`);
  } catch {
    // It is gone, or the connection is: what is in the strip will do.
  }
  if (turn !== detailOf) return;
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
    ['memory, at most', bytes(figures?.peak_memory_bytes)],
    ['certificate', figures && (figures.certificate.holds ? 'holds' : 'does not hold')],
    ['file', bytes(frame.input_bytes)],
    ['attempts that failed', frame.attempts || null],
    ['in all', seconds(frame.seconds)],
  ]));
  if (figures) parts.push(...stageBar(figures.seconds));
  for (const note of figures?.notes ?? []) parts.push(make('p', '', note));
  const links = (frame.outputs ?? []).map(output => {
    const link = make('a', '', `${output.name} (${bytes(output.size_bytes)})`);
    link.href = `files/${encodeURIComponent(output.name)}`;
    link.download = output.name.split('/').at(-1);
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
  const told = entries.filter(([, value]) => value !== null && value !== undefined && value !== '');
  return make('dl', '', ...told.flatMap(([name, value]) => [make('dt', '', name), make('dd', '', String(value))]));
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
  const { daemon, sequences } = await json('api/settings');
  const shownAs = value => value !== null && typeof value === 'object' ? Object.entries(value).map(([k, v]) => `${k} ${v}`).join(', ') : typeof value === 'number' && !Number.isInteger(value) ? Number(value.toPrecision(6)) : value;
  const told = (name, value) => name.endsWith('_bytes') ? bytes(value) : Array.isArray(value) ? value.join(', ') : shownAs(value);
  const block = (title, values) => [
    make('h3', '', title),
    pairs(Object.entries(values).map(([name, value]) => [name.replaceAll('_', ' '), told(name, value)])),
  ];
  const { watches, ...rest } = daemon;
  const parts = [
    ...sequences.flatMap(({ sequence, ...values }) => block(sequence, values)),
    ...watches.flatMap(({ input, ...values }) => block(input, values)),
    ...block('The daemon', rest),
  ];
  $('settings-text').replaceChildren(...parts);
}

// ---- the chart ----

async function showFlow() {
  if (!document.hidden) {
    try {
      const told = await json('api/status');
      status = told.status;
      drawFlow(told.samples);
    } catch {
      // The link says so.
    }
  }
  setTimeout(showFlow, 5000);
}

function drawFlow(samples) {
  const canvas = $('chart');
  const ratio = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  [canvas.width, canvas.height] = [width * ratio, height * ratio];
  const pen = canvas.getContext('2d');
  pen.scale(ratio, ratio);
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
  if (samples.length < 2) return;
  const [begin, end] = [samples[0].at_ms, samples.at(-1).at_ms];
  const x = sample => (sample.at_ms - begin) / Math.max(1, end - begin) * width;
  // Frames per minute, over the last ten samples.
  const rates = samples.map((sample, i) => {
    const before = samples[Math.max(0, i - 10)];
    return (sample.converted - before.converted) * 60000 / Math.max(1000, sample.at_ms - before.at_ms);
  });
  const queues = samples.map(sample => sample.queued + sample.working);
  const line = (values, most, stroke, fill) => {
    pen.beginPath();
    values.forEach((value, i) => pen.lineTo(x(samples[i]), height - 4 - (height - 10) * value / Math.max(most, 1e-9)));
    if (fill) {
      pen.lineTo(width, height);
      pen.lineTo(0, height);
      pen.globalAlpha = .25;
      pen.fillStyle = stroke;
      pen.fill();
      pen.globalAlpha = 1;
    } else {
      pen.strokeStyle = stroke;
      pen.lineWidth = 1.5;
      pen.stroke();
    }
  };
  const [rateMost, queueMost] = [Math.max(...rates), Math.max(...queues)];
  line(queues, Math.max(queueMost, 1), colour('wait'), true);
  line(rates, Math.max(rateMost, 1), colour('accent'), false);
  $('flow-text').textContent = `line: ${rates.at(-1).toFixed(0)} frames a minute, at most ${rateMost.toFixed(0)} · `
    + `area: ${queues.at(-1)} in the queue and under way, at most ${queueMost} · ${bytes(samples.at(-1).memory_bytes) ?? 'unknown'} of memory · `
    + `${bytes(status.disk_free_bytes) ?? 'unknown'} of disk free`;
}

// ---- keys, and the beginning ----

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.type === 'range') return;
  const nextFailed = () => {
    const place = listed.indexOf(chosen);
    const isFailed = name => frames.get(name).state === 'failed';
    choose(listed.slice(place + 1).find(isFailed) ?? listed.find(isFailed));
  };
  const acts = {
    ArrowLeft: () => step(-1), ArrowRight: () => step(1), PageUp: () => step(-10), PageDown: () => step(10),
    Home: () => choose(listed[0]), End: () => choose(listed.at(-1)), f: nextFailed, F: nextFailed,
    ' ': () => event.target.tagName === 'BUTTON' || event.target.type === 'checkbox' ? null : play(!playing),
  };
  const act = acts[event.key];
  if (!act || (event.key === ' ' && (event.target.tagName === 'BUTTON' || event.target.type === 'checkbox'))) return;
  event.preventDefault();
  act();
}

document.addEventListener('keydown', key);
$('strip').addEventListener('scroll', showStrip, { passive: true });
addEventListener('resize', showStrip);
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
  $('hint').textContent = `there is no 3D view here: ${error.message}`;
});
