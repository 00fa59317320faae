/** The log lines of the bridge, the latest first. */
import {card, h} from '../dom.js';

const SHOWN = 50;
const LEVELS = {1: 'debug', 2: 'info', 4: 'warn', 8: 'error', 16: 'fatal'};

export const timeOfDay = (seconds) => new Date(seconds * 1000).toLocaleTimeString('en-GB');

export class Log {
  constructor() {
    this._list = h('ol',
      {class: 'log', tabindex: '0', 'aria-label': 'log lines, the latest first'});
    this.element = card('Log', '/rosout', this._list);
  }

  draw(model, _now, wall) {
    const lines = model.log.slice(-SHOWN).reverse();
    if (lines[0] === this._drawn && lines.length === this._list.children.length) return;
    this._drawn = lines[0];
    this._list.replaceChildren(...lines.map(([at, level, text]) =>
      h('li', {'data-level': LEVELS[level] ?? 'info'},
      h('time', {class: 'note'}, timeOfDay(at + wall)), h('span', {}, text))));
  }
}
