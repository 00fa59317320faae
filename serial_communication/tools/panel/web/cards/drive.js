/**
 * The driving pad, a dead man's switch: the car drives while the pad is held. It stops on release, on
 * a lost or slow connection, on a hidden tab and on blur. If this page hangs, the panel stops the car
 * because no command is received; if the panel hangs, the bridge does.
 *
 * The release of a key may never be reported: macOS does not report it while Cmd is held, and a remote
 * desktop may lose it. Therefore no key drives together with a modifier, and a key that no longer
 * repeats counts as released.
 */
import {APPEARED, hasJustAppeared} from '../appeared.js';
import {card, h, updateAttribute, updateText} from '../dom.js';
import {STOPPED, whyNot} from '../reasons.js';

const TOPICS = '~speed, ~steering';
const IDLE = 'hold to drive';
const EVERY = 50;           // ms between two commands
const SILENCE = 0.3;        // s without an update from the panel, after which the hold ends
const PANEL_SILENT = `stopped: no update from the panel for ${SILENCE} s`;
const MIDDLE = 1500;        // µs, the servo straight ahead
const TURN = 400;           // µs to either side
const SLOW = 200;           // of 1000: the speed limit at first
// By `code`, the position of the key: its `key` may differ at release (keypad with Shift).
const KEYS = new Map([['ArrowUp', [0, 1]], ['ArrowDown', [0, -1]], ['ArrowLeft', [-1, 0]],
  ['ArrowRight', [1, 0]]]);
const MODIFIERS = ['Alt', 'AltGraph', 'Control', 'Meta', 'Shift'];
// Systems repeat the key that was pressed last. If its release is lost, the repeats end nevertheless.
const FIRST_REPEAT = 3000;  // ms from a press to its first repeat, at most; Windows and macOS: up to 2 s
const NEXT_REPEAT = 1000;   // ms between two repeats, at most; the slowest setting: 500 ms

export class Drive {
  constructor(connection) {
    this.topics = [];
    this._connection = connection;
    this._hold = 0;             // number of presses
    this._timer = null;         // while held
    this._pointer = null;       // id of the pointer that pressed it
    this._keys = new Set();     // codes of the keys that are held
    this._repeats = false;      // whether this system is known to repeat keys
    this._repeatDue = Infinity; // when the next repeat is due, ms of performance.now()
    this._at = [0, 0];          // right, ahead: -1 … 1
    this._reason = '';          // why the car cannot be driven
    this._knob = h('span', {class: 'knob', 'aria-hidden': 'true'});
    this._pad = h('div', {class: 'pad', role: 'application', tabindex: '0', id: 'pad',
      'aria-label': 'driving pad: hold the arrow keys to drive, release them to stop',
      'aria-describedby': 'pad-words'}, this._knob);
    this._words = h('p', {class: 'words', id: 'pad-words', role: 'status'}, IDLE);
    this._limit = h('input', {type: 'range', min: '50', max: '1000', step: '50', value: String(SLOW),
      id: 'speed-limit'});
    this._limitWords = h('output', {for: 'speed-limit'}, String(SLOW));
    this.element = card('Drive', TOPICS, this._pad, this._words,
      h('label', {class: 'amount', for: 'speed-limit'}, 'at most ', this._limit, this._limitWords));
    this.element.hidden = true;
    this._note = this.element.querySelector('.note');
    this._limit.addEventListener('input', () => updateText(this._limitWords, this._limit.value));
    this._addListeners();
  }

  get held() { return this._timer !== null; }

  draw(model, now) {
    this.element.hidden = model.controls === null;
    const reason = whyNot(model, this._connection, now, 'arduino', true);
    if (reason !== this._reason && !this.held) updateText(this._words, reason || IDLE);
    this._reason = reason;
    if (this.held && this._connection.silence() > SILENCE) this._end(PANEL_SILENT);
    if (this.held && reason === STOPPED) this._end(STOPPED);
    updateAttribute(this._pad, 'data-held', this.held);
    updateAttribute(this._pad, 'aria-disabled', reason && !this.held ? 'true' : null);
    updateText(this._note, model.drives && this._connection.alive ? 'a page drives' : TOPICS);
  }

  /** The panel refused a drive command. */
  refused(words) { this._end(`stopped: ${words}`); }

  _addListeners() {
    const pad = this._pad;
    pad.addEventListener('pointerdown', (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      pad.focus();
      if (this.held) {
        this._end('stopped: pressed while a key was held');
        return;
      }
      this._pointer = event.pointerId;
      pad.setPointerCapture(event.pointerId);
      this._point(event);
      this._begin();
    });
    pad.addEventListener('pointermove', (event) => {
      if (this.held && !this._keys.size && event.pointerId === this._pointer) this._point(event);
    });
    for (const end of ['pointerup', 'pointercancel', 'lostpointercapture', 'contextmenu']) {
      pad.addEventListener(end, (event) => {
        if (end === 'contextmenu') event.preventDefault();
        if (!this._keys.size) this._end('stopped: released');
      });
    }
    pad.addEventListener('keydown', (event) => this._keyDown(event));
    pad.addEventListener('keyup', (event) => this._keyUp(event));
    pad.addEventListener('blur', () => this._end('stopped: the pad has lost the focus'));
    window.addEventListener('blur', () => this._end('stopped: the window has lost the focus'));
    window.addEventListener('pagehide', () => this._end('stopped'));
    document.addEventListener('visibilitychange', () => {
      if (document.hidden) this._end('stopped: the page was hidden');
    });
    this._connection.addEventListener('lost', () => this._end('stopped: the connection was lost'));
  }

  _point(event) {
    const {left, top, width, height} = this._pad.getBoundingClientRect();
    const clip = (value) => Math.max(-1, Math.min(1, value));
    this._at = [clip((event.clientX - left) / width * 2 - 1), clip(1 - (event.clientY - top) / height * 2)];
  }

  _keyDown(event) {
    if (!KEYS.has(event.code) || MODIFIERS.some((name) => event.getModifierState(name))) {
      this._end('stopped: another key was pressed');
      return;
    }
    event.preventDefault();
    if (event.repeat) {
      this._repeats = true;
      if (this._keys.has(event.code)) this._repeatDue = performance.now() + NEXT_REPEAT;
      return;
    }
    if (this.held && !this._keys.size) {
      this._end('stopped: a key was pressed while the pad was held');
      return;
    }
    this._keys.add(event.code);
    this._repeatDue = this._repeats ? performance.now() + FIRST_REPEAT : Infinity;
    this._pointByKeys();
    this._begin();
  }

  /** The release of any key that is not held stops, too: that of a held key may have been lost. */
  _keyUp(event) {
    if (!this._keys.delete(event.code) || !this._keys.size) {
      this._end('stopped: released');
      return;
    }
    this._repeatDue = Infinity;     // systems do not repeat the keys that are still held
    this._pointByKeys();
  }

  _pointByKeys() {
    this._at = [...this._keys].reduce(([x, y], code) => [x + KEYS.get(code)[0], y + KEYS.get(code)[1]], [0, 0]);
  }

  _begin() {
    if (this.held) return;
    const reason = hasJustAppeared() ? APPEARED : this._reason;
    if (reason) {
      this._keys.clear();
      updateText(this._words, reason);
      return;
    }
    this._hold += 1;
    this._timer = setInterval(() => this._sendDrive(), EVERY);
    this._sendDrive();
  }

  _sendDrive() {
    if (this._connection.silence() > SILENCE) {
      this._end(PANEL_SILENT);
      return;
    }
    if (performance.now() > this._repeatDue) {
      this._end('stopped: the key no longer repeats; press it again');
      return;
    }
    const [right, ahead] = this._at;
    const speed = Math.round(ahead * Number(this._limit.value));
    const steering = Math.round(MIDDLE + right * TURN);
    this._connection.send({drive: {key: 'drive', hold: this._hold, seen: this._connection.seen, speed, steering}});
    this._moveKnob(right, ahead);
    updateText(this._words, `speed ${speed}, steering ${steering}`);
  }

  /** End the hold: stop the car, and show why. */
  _end(words) {
    if (!this.held) return;
    clearInterval(this._timer);
    this._timer = null;
    this._keys.clear();
    this._connection.send({release: {hold: this._hold}});
    this._moveKnob(0, 0);
    updateText(this._words, words);
  }

  _moveKnob(right, ahead) {
    this._knob.style.transform = `translate(${(right * 50).toFixed(1)}cqmin, ${(-ahead * 50).toFixed(1)}cqmin)`;
  }
}
