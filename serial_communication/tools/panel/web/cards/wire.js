/** The wire: the latest frames of serial_msg, which is subscribed to only while this is open. */
import {h} from '../dom.js';

const SHOWN = 16;           // frames

const timeOf = (stamp) => new Date(stamp * 1000).toISOString().slice(11, 23);

export class Wire {
  constructor(connection) {
    this._pause = h('input', {type: 'checkbox'});
    this._filter = h('input', {type: 'text', placeholder: 'words of a frame, as arduino SPEED',
      'aria-label': 'show only frames with these words'});
    this._hide = h('input', {type: 'checkbox', checked: true});
    this._list = h('ol', {class: 'frames', 'aria-label': 'frames, the newest first'});
    this.element = h('details',
      {class: 'card wire', ontoggle: () => connection.send({wire: this.element.open})},
      h('summary', {}, h('h2', {}, 'The wire'),
        h('span', {class: 'note'}, 'serial_msg, subscribed to while this is open; stamps are UTC')),
      h('div', {class: 'row'}, this._filter, h('label', {}, this._hide, ' hide heartbeats'),
        h('label', {}, this._pause, ' pause')),
      this._list);
    connection.addEventListener('update', ({detail}) => {
      if ('control' in detail && this.element.open) connection.send({wire: true});
    });
  }

  draw({frames}) {
    if (!this.element.open || this._pause.checked || this._list.matches(':hover')) return;
    const words = this._filter.value.toLowerCase().split(' ').filter(Boolean);
    const shown = [];
    for (let index = frames.length - 1; index >= 0 && shown.length < SHOWN; index--) {
      const [, link, sent, text, error] = frames[index];
      const all = `${link} ${sent ? '→ sent' : '← received'} ${text} ${error}`.toLowerCase();
      if (words.every((word) => all.includes(word))
        && !(this._hide.checked && text.startsWith('heartbeat'))) {
        shown.push(frames[index]);
      }
    }
    this._list.replaceChildren(...shown.map(item));
  }
}

function item([stamp, link, sent, text, error, hex]) {
  return h('li', {class: 'frame', 'data-error': Boolean(error)},
    h('time', {}, timeOf(stamp)), h('span', {class: 'note'}, `${link} ${sent ? '→' : '←'}`),
    h('span', {class: 'frame-words', title: error || text}, error || text),
    h('code', {}, (hex.match(/../g) ?? []).join(' ')));
}
