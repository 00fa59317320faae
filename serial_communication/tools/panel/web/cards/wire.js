/**
 * The wire: the latest frames of serial_msg as text and as bytes coloured by field. serial_msg is
 * subscribed to only while this card is open.
 */
import {h, updateAttribute, updateText} from '../dom.js';

const KEPT = 2000;          // frames
const SHOWN = 16;           // frames
const REDRAW = 0.25;        // s; nobody reads faster
const QUIET = /heartbeat/;  // kinds of frames that are hidden at first
const COLOURS = 6;

/** The kind of a frame: link, direction and type, and a name for it. */
function kindOf([, link, sent, type, words, error]) {
  if (error) return {key: `${link} damaged`, link, word: 'damaged'};
  const word = words.match(/^[A-Za-z][A-Za-z_ ]*[A-Za-z]/)?.[0] ?? 'frame';
  return {key: `${link} ${sent ? '→' : '←'} ${type}`, link, word: `${sent ? '→' : '←'} ${word}`};
}

export class Wire {
  constructor(changed) {
    this._changed = changed;
    this._frames = [];
    this._kinds = new Map();       // key -> {link, word, count, shown, button}
    this._links = new Map();       // name -> button
    this._paused = false;
    this._pointed = false;
    this._leftOut = -Infinity;     // when frames were left out last
    this._drawn = 0;
    this._selected = null;
    this._dirty = false;
    this._pause = h('button', {type: 'button', 'aria-pressed': 'false',
      onclick: () => this._setPaused(!this._paused)}, 'Pause');
    this._note = h('span', {class: 'note', role: 'status'});
    this._linkChips = h('div', {class: 'chips', role: 'group', 'aria-label': 'links'});
    this._kindChips = h('div', {class: 'chips', role: 'group', 'aria-label': 'kinds of frames'});
    this._list = h('ol', {class: 'frames', 'aria-label': 'frames, the newest first',
      onmouseenter: () => { this._pointed = true; },
      onmouseleave: () => { this._pointed = false; this._highlight(null); },
      onmouseover: (event) => this._highlight(event.target.closest('[data-field]')),
      onfocusin: () => { this._pointed = true; },
      onfocusout: () => { this._pointed = false; }});
    this._detail = h('div', {class: 'frame-detail', hidden: true});
    this._detail.addEventListener('mouseover', (event) =>
      this._highlight(event.target.closest('[data-field]')));
    this._detail.addEventListener('focusin', (event) =>
      this._highlight(event.target.closest('[data-field]')));
    this.element = h('details', {class: 'card wire', id: 'card-wire', ontoggle: () => {
      this._frames = [];
      this._leftOut = -Infinity;
      this._dirty = true;
      changed();
    }},
    h('summary', {class: 'card-head'}, h('h2', {}, 'The wire'),
      h('span', {class: 'note'}, 'serial_msg, subscribed to while this is open')),
    h('div', {class: 'tools'}, this._pause, this._linkChips, this._note),
    this._kindChips, this._list, this._detail);
  }

  /** serial_msg while this is open, else nothing. */
  get topics() { return this.element.open ? ['serial_msg'] : []; }

  /** Add the frames of an update. */
  take(wire) {
    if (!this.element.open) return;
    for (const frame of wire.frames) {
      const kind = kindOf(frame);
      let known = this._kinds.get(kind.key);
      if (!known) known = this._addKind(kind);
      known.count += 1;
      frame.kind = known;
    }
    if (wire.left_out) this._leftOut = this._drawn;
    if (this._paused) return;
    this._frames.push(...wire.frames);
    if (this._frames.length > KEPT * 1.2) this._frames.splice(0, this._frames.length - KEPT);
    this._dirty = true;
  }

  draw(model, now) {
    if (!this.element.open || now - this._drawn < REDRAW && now >= this._drawn) return;
    this._drawn = now;
    for (const kind of this._kinds.values()) updateText(kind.counter, String(kind.count));
    updateText(this._note, this._paused ? 'paused' : this._pointed ? 'paused while you point at it'
      : now - this._leftOut < 5 ? 'some frames are left out: too many to be shown' : '');
    if (!this._dirty || this._pointed || this._paused) return;
    this._dirty = false;
    this._show();
  }

  _show() {
    const shown = [];
    for (let index = this._frames.length - 1; index >= 0 && shown.length < SHOWN; index--) {
      const {kind} = this._frames[index];
      if (kind.shown && this._links.get(kind.link).shown) shown.push(this._frames[index]);
    }
    this._list.replaceChildren(...shown.map((frame) => this._item(frame)));
  }

  _item(frame) {
    const [at, link, sent, , words, error] = frame;
    return h('li', {class: 'frame', tabindex: '0', 'data-link': link, 'data-error': Boolean(error),
      onclick: () => this._select(frame),
      onkeydown: (event) => { if (event.key === 'Enter') this._select(frame); }},
    h('time', {}, (at % 1000).toFixed(3)),
    h('span', {class: 'frame-link'}, `${link} ${sent ? '→' : '←'}`),
    h('span', {class: 'frame-words'}, error || words),
    h('span', {class: 'bytes'}, ...this._bytes(frame)));
  }

  /** The bytes; neighbours of one field share a colour. */
  _bytes([, , , , , , hex, fields], most = 28) {
    const out = [], bytes = hex.match(/../g) ?? [];
    const owner = new Array(bytes.length).fill(null);
    fields.forEach(([, first, end], index) => owner.fill(index, first, end));
    for (let from = 0; from < Math.min(bytes.length, most);) {
      let to = from + 1;
      while (to < bytes.length && to < most && owner[to] === owner[from]) to++;
      const text = bytes.slice(from, to).join(' ');
      out.push(owner[from] === null ? h('span', {class: 'byte'}, text)
        : h('span', {class: `byte f${owner[from] % COLOURS}`, 'data-field': owner[from],
          title: `${fields[owner[from]][0]}: ${fields[owner[from]][3]}`}, text));
      from = to;
    }
    if (bytes.length > most) out.push(h('span', {class: 'byte'}, `… ${bytes.length} bytes`));
    return out;
  }

  /** Show the fields of one frame. */
  _select(frame) {
    const [, link, sent, , words, error, , fields] = frame;
    this._selected = frame;
    this._detail.hidden = false;
    this._detail.replaceChildren(
      h('p', {class: 'frame-title'}, h('b', {}, `${link} ${sent ? 'sent' : 'received'}: `),
        error ? `${error}; ${words}` : words),
      h('p', {class: 'bytes'}, ...this._bytes(frame, Infinity)),
      h('dl', {class: 'fields'}, ...fields.map(([name, first, end, value, amiss], index) =>
        h('div', {class: `f${index % COLOURS}`, 'data-field': index, tabindex: '0'},
          h('dt', {}, name), h('dd', {}, value, ...amiss ? [h('b', {class: 'amiss'}, ` ${amiss}`)] : []),
          h('dd', {class: 'note'}, end - first > 1 ? `bytes ${first} – ${end - 1}` : `byte ${first}`)))));
  }

  /** Highlight all bytes and values of the field that is pointed at. */
  _highlight(target) {
    for (const lit of this.element.querySelectorAll('[data-lit]')) updateAttribute(lit, 'data-lit', false);
    if (!target) return;
    const home = target.closest('.frame, .frame-detail');
    for (const same of home.querySelectorAll(`[data-field="${target.dataset.field}"]`)) {
      updateAttribute(same, 'data-lit', true);
    }
  }

  _addKind({key, link, word}) {
    const kind = {link, word, count: 0, shown: !QUIET.test(word)};
    kind.counter = h('span', {class: 'counter'}, '0');
    kind.button = this._chip(kind, `${link} ${word}`, kind.counter);
    this._kinds.set(key, kind);
    this._kindChips.append(kind.button);
    if (!this._links.has(link)) {
      const chip = {shown: true};
      this._links.set(link, chip);
      this._linkChips.append(this._chip(chip, link));
    }
    return kind;
  }

  /** Create a button that shows or hides frames. */
  _chip(what, ...words) {
    const button = h('button', {type: 'button', class: 'chip', 'aria-pressed': String(what.shown),
      onclick: () => {
        what.shown = !what.shown;
        updateAttribute(button, 'aria-pressed', String(what.shown));
        this._show();
      }}, ...words);
    return button;
  }

  _setPaused(paused) {
    this._paused = paused;
    updateAttribute(this._pause, 'aria-pressed', String(paused));
    updateText(this._pause, paused ? 'Resume' : 'Pause');
    this._drawn = 0;
  }
}
