/**
 * The pad, a dead man's switch: the chosen motion goes on while the pad is held. It stops on
 * release, on a lost or slow connection, on a hidden tab and on blur. If this page hangs, the panel
 * stops the motion because no command is received; if the panel hangs, the bridge does.
 *
 * The release of a key may never be reported: macOS does not report it while Cmd is held, and a
 * remote desktop may lose it. Therefore no key drives together with a modifier, and a key that no
 * longer repeats counts as released.
 */
import {card, formatNumber, h, setAttribute, setText} from '../dom.js';

const IDLE = 'hold to drive';
const EVERY = 50;           // ms between two commands
const SILENCE = 0.3;        // s without an update from the panel, after which the hold ends
const SILENT = `no update from the panel for ${SILENCE} s`;
const STOPPED = 'stopped until STOP is released';
// By `code`, the position of the key: its `key` may differ at release (keypad with Shift).
const KEYS = new Map([['ArrowUp', [0, 1]], ['ArrowDown', [0, -1]], ['ArrowLeft', [-1, 0]],
  ['ArrowRight', [1, 0]]]);
const MODIFIERS = ['Alt', 'AltGraph', 'Control', 'Meta', 'Shift'];
// Systems repeat the key that was pressed last, also if its release is lost.
const FIRST_REPEAT = 3000;  // ms to its first repeat, at most; Windows and macOS: up to 2 s
const NEXT_REPEAT = 1000;   // ms between two repeats, at most; the slowest setting: 500 ms

const SPEED = 'serial_communication/SpeedPWMCommand';
const STEERING = 'serial_communication/SteeringPWMCommand';
const TWIST = 'geometry_msgs/Twist';
const STRAIGHT = 1500;      // µs, of the steering servo; a longer pulse steers to the right

/** Whether the pad drives by this form, which is then no form of the page. */
export const isOfPad = ({type, motion}) =>
  type === SPEED || type === STEERING || type === TWIST && motion;

/**
 * What the pad can drive: `cmd_vel` first. An axis is [unit, greatest value, value at first];
 * `values` are those of the forms for a forward speed and a turn to the right.
 */
function motionsOf(forms) {
  const found = [], named = (wanted) => Object.entries(forms).find(([, {type}]) => type === wanted);
  for (const [name, {type, motion, fields}] of Object.entries(forms)) {
    if (type !== TWIST || !motion) continue;
    const axis = (path, units, usual, first) => {
      const most = Math.min(usual, fields.find((field) => field.name === path)?.high || usual);
      return [units, most, Math.min(first, most)];
    };
    found.push({name, forward: axis('linear.x', 'm/s', 3, 0.2),
      turn: axis('angular.z', 'rad/s', 6, 0.8),
      values: (forward, turn) => ({[name]: Object.fromEntries(fields.map((field) =>
        [field.name, {'linear.x': forward, 'angular.z': -turn}[field.name] ?? 0]))})});
  }
  found.sort((one, other) => (other.name === '~cmd_vel') - (one.name === '~cmd_vel'));
  const [speed, steering] = [named(SPEED), named(STEERING)];
  if (speed && steering) {
    found.push({name: 'car', forward: ['', 1000, 200], turn: ['µs', 1000, 400],
      values: (forward, turn) => Object.fromEntries([[speed, Math.round(forward)], [steering,
        Math.round(STRAIGHT + turn)]].map(([[name, {fields}], value]) =>
          [name, {[fields[0].name]: value}]))});
  }
  return found;
}

export class Drive {
  constructor(connection, model) {
    this._connection = connection;
    this._model = model;
    this._motions = [];
    this._hold = 0;             // number of presses
    this._timer = null;         // while held
    this._pointer = null;       // id of the pointer that holds it
    this._keys = new Set();     // codes of the keys that are held
    this._repeats = false;      // whether this system is known to repeat keys
    this._repeatDue = Infinity; // when the next repeat is due, ms of performance.now()
    this._at = [0, 0];          // right, ahead: -1 … 1
    this._knob = h('span', {class: 'knob', 'aria-hidden': 'true'});
    this._pad = h('div', {class: 'pad', role: 'application', tabindex: '0', id: 'pad',
      'aria-label': 'driving pad: hold the arrow keys to drive, release them to stop',
      'aria-describedby': 'pad-words'}, this._knob);
    this._words = h('p', {id: 'pad-words', role: 'status'}, IDLE);
    this._choice = h('select', {'aria-label': 'what the pad drives',
      onchange: () => this._choose(this._choice.value)});
    this._limits = {};          // by axis: {input, words}
    const limit = (axis) => {
      const input = h('input',
        {type: 'range', 'aria-label': `${axis}, at most`, oninput: () => this._show(axis)});
      this._limits[axis] = {input, words: h('output')};
      return h('label', {class: 'row'}, `${axis} `, input, this._limits[axis].words);
    };
    this.element = card('Drive', '', this._choice, this._pad, this._words, limit('forward'),
      limit('turn'));
    this.element.hidden = true;
    this._note = this.element.querySelector('.note');
    this._listen();
  }

  get held() { return this._timer !== null; }

  get _motion() { return this._motions.find(({name}) => name === this._choice.value); }

  draw(model, now) {
    if (model.forms !== this._offered) {
      this._offered = model.forms;
      this._motions = motionsOf(model.forms);
      const before = this._choice.value;
      this._choice.replaceChildren(...this._motions.map(({name}) =>
        h('option', {value: name}, name.replace('~', ''))));
      if (this._motions.some(({name}) => name === this._chosen)) this._choice.value = this._chosen;
      if (before !== this._choice.value) this._choose();
    }
    this.element.hidden = !model.control || !this._motions.length;
    if (this.held && this._connection.silence() > SILENCE) this._end(SILENT);
    if (this.held && model.stopped(now)) this._end(STOPPED);
    setAttribute(this._pad, 'data-held', this.held || null);
    setText(this._note, model.drives && this._connection.alive ? 'a page drives' : '');
  }

  _choose(chosen = this._chosen) {
    this._chosen = chosen;      // by a person, so it stays
    this._end('another motion was chosen');
    if (!this._motion) return;
    for (const [axis, {input}] of Object.entries(this._limits)) {
      const [, most, preset] = this._motion[axis];
      Object.assign(input, {min: most / 60, max: most, step: most / 60});
      input.value = preset;
      this._show(axis);
    }
  }

  _show(axis) {
    const {input, words} = this._limits[axis];
    setText(words, `${formatNumber(Number(input.value))} ${this._motion?.[axis][0] ?? ''}`);
  }

  _listen() {
    const pad = this._pad;
    pad.addEventListener('pointerdown', (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      pad.focus({preventScroll: true});
      if (this.held) {
        this._end('pressed while it was held');
        return;
      }
      this._pointer = event.pointerId;
      pad.setPointerCapture(event.pointerId);
      this._point(event);
      this._begin();
    });
    pad.addEventListener('pointermove', (event) => {
      if (this.held && event.pointerId === this._pointer) this._point(event);
    });
    for (const end of ['pointerup', 'pointercancel', 'lostpointercapture']) {
      pad.addEventListener(end, (event) => {
        if (event.pointerId === this._pointer) this._end('released');
      });
    }
    pad.addEventListener('contextmenu', (event) => event.preventDefault());     // of a long press
    pad.addEventListener('keydown', (event) => this._keyDown(event));
    pad.addEventListener('keyup', (event) => this._keyUp(event));
    pad.addEventListener('blur', () => this._end('the pad has lost the focus'));
    window.addEventListener('blur', () => this._end('the window has lost the focus'));
    window.addEventListener('pagehide', () => this._end(''));
    document.addEventListener('visibilitychange', () => {
      if (document.hidden) this._end('the page was hidden');
    });
    this._connection.addEventListener('lost', () => this._end('the connection was lost'));
    this._connection.addEventListener('refused',
      ({detail: {key, words}}) => { if (key === 'drive') this._end(words); });
  }

  _point(event) {
    const {left, top, width, height} = this._pad.getBoundingClientRect();
    const clip = (value) => Math.max(-1, Math.min(1, value));
    this._at = [clip((event.clientX - left) / width * 2 - 1),
      clip(1 - (event.clientY - top) / height * 2)];
  }

  _keyDown(event) {
    if (event.key === 'Tab') return;
    if (!KEYS.has(event.code) || MODIFIERS.some((name) => event.getModifierState(name))) {
      this._end('another key was pressed');
      return;
    }
    event.preventDefault();
    if (event.repeat) {
      this._repeats = true;
      if (this._keys.has(event.code)) this._repeatDue = performance.now() + NEXT_REPEAT;
      return;
    }
    if (this.held && !this._keys.size) {
      this._end('a key was pressed while the pad was held');
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
      this._end('released');
      return;
    }
    this._repeatDue = Infinity;     // systems do not repeat the keys that are still held
    this._pointByKeys();
  }

  _pointByKeys() {
    this._at = [...this._keys].reduce(([x, y], code) =>
      [x + KEYS.get(code)[0], y + KEYS.get(code)[1]], [0, 0]);
  }

  _begin() {
    if (this.held) return;
    const now = this._connection.now();
    const reason = !this._connection.alive ? 'no connection to the panel' : this._model.trouble
      || (this._model.stopped(now) ? STOPPED : '');
    if (reason) {
      this._keys.clear();
      setText(this._words, reason);
      return;
    }
    this._hold += 1;
    this._timer = setInterval(() => this._sendDrive(), EVERY);
    this._sendDrive();
  }

  _sendDrive() {
    if (this._connection.silence() > SILENCE) {
      this._end(SILENT);
      return;
    }
    if (!this._motion) {
      this._end('it is not there any more');
      return;
    }
    if (performance.now() > this._repeatDue) {
      this._end('the key no longer repeats; press it again');
      return;
    }
    const [right, ahead] = this._at;
    const forward = ahead * Number(this._limits.forward.input.value);
    const turn = right * Number(this._limits.turn.input.value);
    this._connection.send({drive: {hold: this._hold, values: this._motion.values(forward, turn)}});
    this._moveKnob(right, ahead);
    const [speed, angle] = [['forward', forward], ['turn', turn]].map(([axis, value]) =>
      `${formatNumber(Number(value.toPrecision(3)))} ${this._motion[axis][0]}`.trim());
    setText(this._words, `forward ${speed}, right ${angle}`);
  }

  /** End the hold: stop, and show why. */
  _end(words) {
    if (!this.held) return;
    clearInterval(this._timer);
    this._timer = this._pointer = null;
    this._keys.clear();
    this._connection.send({release: {hold: this._hold}});
    this._moveKnob(0, 0);
    setText(this._words, words === STOPPED ? words : `stopped: ${words}`);
  }

  _moveKnob(right, ahead) {
    const [x, y] = [right, -ahead].map((each) => `${(each * 50).toFixed(1)}cqmin`);
    this._knob.style.transform = `translate(${x}, ${y})`;
  }
}
