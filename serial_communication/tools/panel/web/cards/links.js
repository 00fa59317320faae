/** A card for each link: state, errors, age; all diagnostics on demand. */
import {card, formatAge, h, setAttribute, setText} from '../dom.js';

const SIGNS = {ok: '✓', warn: '!', error: '✕', none: '?'};
const ORDER = ['none', 'error', 'warn', 'ok'];

class LinkCard {
  constructor(name) {
    this._sign = h('span', {class: 'sign', 'aria-hidden': 'true'}, '?');
    this._summary = h('p', {class: 'summary'});
    this._port = h('p', {class: 'note port'});
    this._errors = h('p', {class: 'note'});
    this._age = h('p', {class: 'note'});
    this._all = h('tbody');
    this._details = h('details', {class: 'all'}, h('summary', {}, 'all diagnostics'),
      h('table', {}, this._all));
    this.element = card(name, '', h('div', {class: 'now'}, this._sign,
      h('div', {}, this._summary, this._port, this._errors, this._age)), this._details);
    this.element.dataset.link = name;
    this._title = this.element.querySelector('.note');
  }

  draw(link, title, now) {
    const stale = link.stale(now);
    setAttribute(this.element, 'data-health', link.health(now));
    setText(this._sign, SIGNS[link.health(now)]);
    setText(this._title, title ?? '');
    setText(this._summary, link.at === null ? 'no status received yet'
      : stale ? `no status for ${formatAge(now - link.at)}` : link.summary);
    setText(this._port, link.values.port ?? '');
    const errors = link.errors();
    setText(this._errors, errors.length
      ? `errors in a minute: ${errors.map(([cause, count]) => `${cause} ${count}`).join(', ')}`
        : 'no errors');
    const age = Number(link.values['last frame age [s]']) + (stale ? now - link.at : 0);
    setText(this._age, Number.isNaN(age) ? 'no frame yet' : age < 1 ? 'frames arrive'
      : `last frame ${formatAge(age)} ago`);
    if (!this._details.open || link.at === this._listed) return;
    this._listed = link.at;
    this._all.replaceChildren(...Object.entries(link.values).map(([key, value]) =>
      h('tr', {}, h('th', {scope: 'row'}, key), h('td', {}, value))));
  }
}

/** The cards of all links that are known. */
export class Links {
  constructor(place) {
    this._place = place;
    this._cards = new Map();
  }

  draw(model, now) {
    for (const [name, link] of model.links) {
      if (!this._cards.has(name)) {
        this._cards.set(name, new LinkCard(name));
        this._place.append(this._cards.get(name).element);
      }
      this._cards.get(name).draw(link, model.titles[name], now);
    }
    for (const [name, each] of this._cards) each.element.hidden = !model.links.has(name);
  }
}

/** The worst link and its health as words, and as a sign, for the title of the tab. */
export function worst(model, now) {
  const links = [...model.links.values()].map((link) => [link.health(now), link.name])
    .sort(([one], [other]) => ORDER.indexOf(one) - ORDER.indexOf(other));
  const [health, name] = links[0] ?? ['none', 'bridge'];
  return health === 'ok' ? '✓' : `${SIGNS[health]} ${name}: ${health}`;
}
