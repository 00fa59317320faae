/**
 * A card for each link, with its status in a colour and a text that can be read from a distance. Its
 * height does not depend on what it says, or the controls below would move under a pointer.
 */
import {card, colour, context, formatAge, formatNumber, h, shortened, updateAttribute, updateText} from '../dom.js';

const SHOWN = 300;         // s, the span of the bar chart
const BIN = 3;             // s, one bar
const MINUTE = 60;
const SIGNS = {ok: '✓', warn: '!', error: '✕', none: '?'};
const WORDS = {ok: 'OK', warn: 'warning', error: 'error', none: 'no status'};
const CAUSES = ['--cause-1', '--cause-2', '--cause-3', '--cause-4', '--cause-5'];

/** Further values on the card: the label, and the text from the values of /diagnostics. */
const MORE = [
  ['round trip', (v) => milliseconds(v['round trip p50 [ms]'])],
  ['slowest', (v) => milliseconds(v['round trip max [ms]'])],
  ['timeouts', (v) => v['timeouts']],
  ['heartbeat gap', (v) => milliseconds(v['heartbeat gap [ms]'])],
  ['lost', (v) => v['frames lost']],
  ['read delay', (v) => milliseconds(v['read delay p50 [ms]'])],
  ['unconfirmed', (v) => v['settings unconfirmed'] || undefined],
  ['stale', (v) => v['stale'] === undefined ? undefined : `${v['stale']} bytes`],
  ['reconnects', (v) => v['reconnects']],
];

const milliseconds = (value) => value === undefined || value === '-' ? value : `${value} ms`;

class LinkCard {
  constructor(name, announce) {
    this._name = name;
    this._announce = announce;
    this._health = null;
    this._sign = h('span', {class: 'sign', 'aria-hidden': 'true'}, '?');
    this._summary = h('p', {class: 'summary'}, 'no status received yet');
    this._port = h('p', {class: 'port'});
    this._count = h('span', {class: 'count'}, '0');
    this._spark = h('canvas', {class: 'spark', role: 'img', 'aria-label': 'errors'});
    this._causes = h('ul', {class: 'causes'});
    this._rates = {in: h('dd'), out: h('dd'), age: h('dd')};
    this._more = new Map(MORE.map(([label]) => [label, h('dd')]));
    this._gap = h('dd', {class: 'gap'});
    this._gapAt = null;          // time of the latest status with a heartbeat gap that was too long
    this._all = h('tbody');
    this._details = h('details', {class: 'all'}, h('summary', {}, 'all diagnostics'),
      h('table', {}, this._all));
    const item = (label, value, shape = null) => h('div', {class: shape}, h('dt', {}, label), value);
    this.element = card(name, '',
      h('div', {class: 'now'},
        h('div', {class: 'state'}, this._sign, h('div', {}, this._summary, this._port)),
        h('div', {class: 'errors'},
          h('p', {class: 'per-minute'}, this._count, h('span', {}, ' errors a minute')),
          this._spark)),
      this._causes,
      h('dl', {class: 'facts'}, item('in', this._rates.in), item('out', this._rates.out),
        item('last frame', this._rates.age),
        ...MORE.map(([label]) => item(label, this._more.get(label))), item('last long gap', this._gap, 'wide')),
      this._details);
    this._title = this.element.querySelector('.note');
    this.element.classList.add('link');
    this.element.dataset.link = name;
  }

  draw(model, now) {
    const link = model.links.get(this._name);
    if (!link) return;
    const health = link.health(now), board = model.boards[this._name];
    updateText(this._title, board?.title ?? '');
    updateAttribute(this.element, 'data-health', health);
    updateText(this._sign, SIGNS[health]);
    const stale = link.stale(now);
    const summary = link.at === null ? 'no status received yet'
      : stale ? `no status for ${formatAge(now - link.at)}` : link.summary;
    if (this._summary.textContent !== summary) {      // its beginning is read from a distance
      const [, begin, more] = summary.match(/^([^:;]*)(.*)$/s);
      this._summary.replaceChildren(begin, h('span', {class: 'more'}, more));
      updateAttribute(this._summary, 'title', summary);
    }
    if (health !== this._health) {
      if (this._health !== null || health === 'error') {
        this._announce(`${this._name} link: ${WORDS[health]}, ${summary}`);
      }
      this._health = health;
    }
    if (link.at === null) return;
    const values = link.values;
    const port = values['port'] ?? '';
    if (this._port.textContent !== port) this._port.replaceChildren(...shortened(port));
    updateAttribute(this._port, 'title', port);
    this._errors(link, now);
    const rate = (sent) => {
      const value = link.rate(sent);
      return value === null || stale ? '–' : `${formatNumber(value, value < 10 ? 1 : 0)}/s`;
    };
    updateText(this._rates.in, rate(false));
    updateText(this._rates.out, rate(true));
    const age = Number(values['last frame age [s]']);
    // As the status has it: frames have been received since then, unless the statuses have ended.
    const silence = age + (stale ? now - link.at : 0);
    updateText(this._rates.age, Number.isNaN(age) ? 'never' : silence < 0.1 ? 'now' : `${formatAge(silence)} ago`);
    this._rememberGap(values, link.at, board);
    updateText(this._gap, this._gapAt === null || this._gapAt === link.at ? '–'
      : `${this._gapWords}, ${formatAge(now - this._gapAt)} ago`);
    this._gap.parentElement.hidden = !board?.longest_gap;
    for (const [label, text] of MORE) {
      const value = text(values), place = this._more.get(label);
      place.parentElement.hidden = value === undefined;
      updateText(place, value ?? '');
      updateAttribute(place, 'data-too-long', label === 'heartbeat gap'
        && parseFloat(value) > 1000 * (board?.longest_gap ?? Infinity));
    }
    if (this._details.open) this._list(values);
  }

  /** Remember the latest heartbeat gap that was too long, with the time of its status. */
  _rememberGap(values, at, board) {
    const gap = values['heartbeat gap [ms]'];
    if (at === this._gapAt || !(parseFloat(gap) > 1000 * (board?.longest_gap ?? Infinity))) return;
    this._gapAt = at;
    this._gapWords = milliseconds(gap);
  }

  _errors(link, now) {
    const minute = link.errorsSince(now - MINUTE);
    const sum = [...minute.values()].reduce((all, each) => all + each, 0);
    updateText(this._count, formatNumber(sum));
    updateAttribute(this._count, 'data-some', sum > 0);
    const shown = link.errorsSince(now - SHOWN);
    const causes = [...shown.keys()].sort();
    const words = causes.map((cause) => `${cause} ${minute.get(cause) ?? 0}`).join(' ');
    if (this._causes.dataset.words !== words) {
      this._causes.dataset.words = words;
      this._causes.replaceChildren(...causes.map((cause, at) => {
        const item = h('li', {class: 'key', 'data-cause': cause}, `${cause} `,
          h('b', {}, String(minute.get(cause) ?? 0)));
        item.style.setProperty('--key', `var(${CAUSES[at % CAUSES.length]})`);
        return item;
      }));
      updateAttribute(this._spark, 'aria-label', `errors in the last five minutes: ${causes.map((cause) =>
        `${cause} ${shown.get(cause)}`).join(', ') || 'none'}`);
    }
    const area = context(this._spark);
    if (area) this._bars(area, link, now, causes);
  }

  _bars({ctx, width, height}, link, now, causes) {
    const bins = Math.round(SHOWN / BIN), begin = (Math.floor(now / BIN) + 1) * BIN - SHOWN;
    const sums = Array.from({length: bins}, () => causes.map(() => 0));
    for (const [at, counts] of link.errors) {
      const bin = sums[Math.floor((at - begin) / BIN)];
      if (bin) causes.forEach((cause, index) => { bin[index] += counts.get(cause) ?? 0; });
    }
    const most = Math.max(5, ...sums.map((bin) => bin.reduce((all, each) => all + each, 0)));
    const wide = width / bins;
    ctx.fillStyle = colour('--grid');
    ctx.fillRect(0, height - 1, width, 1);
    sums.forEach((bin, index) => {
      let y = height;
      bin.forEach((count, cause) => {
        if (!count) return;
        const high = Math.max(2, count / most * (height - 2));
        ctx.fillStyle = colour(CAUSES[cause % CAUSES.length]);
        ctx.fillRect(index * wide, y - high, Math.max(1, wide - 0.6), high);
        y -= high;
      });
    });
  }

  _list(values) {
    const words = JSON.stringify(values);
    if (this._all.dataset.words === words) return;
    this._all.dataset.words = words;
    this._all.replaceChildren(...Object.entries(values).map(([key, value]) =>
      h('tr', {}, h('th', {scope: 'row'}, key), h('td', {}, value))));
  }
}

/** The cards of all links that are known. */
export class Links {
  constructor(announce) {
    this.topics = [];
    this.element = document.getElementById('links');
    this._announce = announce;
    this._cards = new Map();
  }

  draw(model, now) {
    for (const name of model.links.keys()) {
      if (!this._cards.has(name)) {
        const made = new LinkCard(name, this._announce);
        this._cards.set(name, made);
        this.element.append(made.element);
      }
    }
    for (const [name, each] of this._cards) {
      each.element.hidden = !model.links.has(name);
      each.draw(model, now);
    }
  }
}

/** The health of the worst link and which it is, for the title of the tab. */
export function worst(model, now) {
  const order = ['none', 'error', 'warn', 'ok'];
  let found = 'ok', words = '';
  for (const link of model.links.values()) {
    const health = link.health(now);
    if (order.indexOf(health) < order.indexOf(found)) {
      [found, words] = [health, `${link.name}: ${WORDS[health]}`];
    }
  }
  return {health: found, sign: SIGNS[found], words};
}
