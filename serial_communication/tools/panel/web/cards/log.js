/** The log lines of the bridge. */
import {card, formatAge, h, updateText} from '../dom.js';

const SHOWN = 30;
const LEVELS = {1: 'debug', 2: 'info', 4: 'warn', 8: 'error', 16: 'fatal'};

/** The text; the link that it begins with becomes a button that shows the link's card. */
function withLink(text, model) {
  const name = text.match(/^(\w+)(?=:| says)/)?.[1];
  if (!model.links.has(name)) return [text];
  const show = () => document.querySelector(`.link[data-link="${name}"]`)?.scrollIntoView({block: 'center'});
  return [h('button', {type: 'button', class: 'link-name', onclick: show}, name), text.slice(name.length)];
}

export class Log {
  constructor() {
    this.topics = [];
    this._list = h('ol', {class: 'log', tabindex: '0', 'aria-label': 'log lines, the latest first'});
    this.element = card('Log', '/rosout', this._list);
    this._last = null;
  }

  draw(model, now) {
    if (this._list.matches(':hover')) return;       // a line leads to a link: it must not move
    const lines = model.log.slice(-SHOWN).reverse();
    const last = lines[0];
    if (last !== this._last || lines.length !== this._list.children.length) {
      this._last = last;
      this._list.replaceChildren(...lines.map(([, level, text]) =>
        h('li', {'data-level': LEVELS[level] ?? 'info'}, h('time', {}), h('span', {}, ...withLink(text, model)))));
    }
    lines.forEach(([at], index) => updateText(this._list.children[index].firstChild,
      `${formatAge(Math.max(0, now - at))}`));
    if (!lines.length) this._list.replaceChildren(h('li', {class: 'words'}, 'no lines since the page was opened'));
  }
}
