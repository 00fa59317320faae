/**
 * Service calls. A control is disabled until its call is answered; the answers are listed. If the
 * connection is lost during a call, its outcome is shown as not known.
 */
import {card, formatAge, h, updateAttribute, updateText} from '../dom.js';

const LEAST_DISABLED = 700;    // ms; the second click of a double click follows within 500
const SHOWN = 12;              // answers
const WORDS = {done: 'done', refused: 'refused', 'not known': 'not known'};
const MOVES = {
  '~lift': ['lift', 'distance', 'mm', 20, [['▲ up', 0], ['▼ down', 1]]],
  '~gimbal': ['gimbal', 'angle', '°', 10, [['◀ left', 0], ['▶ right', 1], ['▲ up', 2], ['▼ down', 3]]],
};
const BUS = {'~bus/echo': 'echo', '~bus/sync': 'sync'};
const PLAIN = {...BUS, '~calibrate_imu': 'calibrate the IMU'};
const LEDS = ['left', 'right', 'brake', 'disable'];
const INTEGER = /^u?int\d+$/;

let presses = 0;

export class Commands {
  constructor(connection, announce) {
    this.topics = ['~imu/calibrating'];
    this._connection = connection;
    this._announce = announce;
    this._pending = new Map();      // key -> {name, words, at} of what was requested and not answered
    this._groups = new Map();       // service -> its buttons
    this._ownAnswers = [];          // answers of this page, beside those of the calls
    this._body = h('div', {class: 'commands'});
    this._answers = h('ol', {class: 'answers', 'aria-label': 'answers, the latest first'});
    this._calibrateNote = h('p', {class: 'words'});
    this.element = card('Commands', '', this._body,
      h('h3', {id: 'answers-title'}, 'Answers'), this._answers);
    this.element.hidden = true;
    this._shape = '';
    this._drawnAnswers = '';
    connection.addEventListener('lost', () => this._lost());
  }

  draw(model, now) {
    const shape = JSON.stringify(model.controls?.services ?? null);
    if (shape !== this._shape) {
      this._shape = shape;
      this.element.hidden = model.controls === null;
      if (model.controls) this._build(model.controls);
    }
    if (!model.controls) return;
    this._settle(model);
    for (const [name, buttons] of this._groups) {
      const busy = !this._connection.alive || [...this._pending.values()].some((each) =>
        each.name === name) || [...model.calls.values()].some((call) =>
        call.name === name && !call.outcome);
      buttons.forEach((button) => {
        updateAttribute(button, 'disabled', busy || button.disabledUntil > performance.now());
      });
    }
    this._calibrating(model, now);
    this._list(model, now);
  }

  /** The panel refused the command with this key. */
  refused({key, words}) {
    const request = this._pending.get(key);
    if (!request) return;
    this._pending.delete(key);
    this._addAnswer(request.words, 'refused', words);
  }

  _settle(model) {
    for (const call of model.calls.values()) {
      const request = this._pending.get(call.key);
      if (!request || !call.outcome) continue;
      this._pending.delete(call.key);
      this._announce(`${request.words}: ${WORDS[call.outcome]}, ${call.words}`);
    }
  }

  _lost() {
    for (const [key, request] of this._pending) {
      this._pending.delete(key);
      this._addAnswer(request.words, 'not known', 'the connection was lost before the answer was received; '
        + 'look before you repeat it');
    }
  }

  _addAnswer(what, outcome, words) {
    this._ownAnswers.push({what, outcome, words, at: this._connection.now()});
    this._ownAnswers.splice(0, this._ownAnswers.length - SHOWN);
    this._announce(`${what}: ${WORDS[outcome]}, ${words}`);
  }

  _request(event, name, args, words) {
    // The second click of a double click must not move anything again.
    if (event.detail > 1) return;
    const key = `${Date.now()}.${presses++}`;
    for (const button of this._groups.get(name)) {
      button.disabledUntil = performance.now() + LEAST_DISABLED;
      updateAttribute(button, 'disabled', true);
    }
    const at = this._connection.now();
    if (this._connection.alive && this._connection.send({call: {key, name, arguments: args}})) {
      this._pending.set(key, {name, words, at});
    } else {
      this._addAnswer(words, 'refused', 'nothing was sent: no connection to the panel');
    }
  }

  // -- building ------------------------------------------------------------------------------

  _build({services, led_limit: ledLimit}) {
    this._groups.clear();
    const parts = [];
    for (const [name, fields] of Object.entries(services)) {
      if (MOVES[name]) parts.push(this._move(name, ...MOVES[name]));
      else if (!PLAIN[name]) parts.push(this._form(name, fields));
    }
    parts.splice(2, 0, this._led(ledLimit), this._bus(), this._calibrate());
    this._body.replaceChildren(...parts);
  }

  _button(name, words, press) {
    const button = h('button', {type: 'button', onclick: press}, words);
    button.disabledUntil = 0;
    if (!this._groups.has(name)) this._groups.set(name, []);
    this._groups.get(name).push(button);
    return button;
  }

  _move(name, title, amount, unit, preset, directions) {
    const input = h('input', {type: 'number', min: '1', max: '255', step: '1', value: String(preset),
      inputmode: 'numeric', 'aria-label': `${title}: ${amount} in ${unit === '°' ? 'degrees' : unit}`});
    const buttons = directions.map(([words, direction]) => this._button(name, words, (event) => {
      if (!input.reportValidity()) return;
      const value = Number(input.value);
      this._request(event, name, {direction, [amount]: value}, `${title} ${words.slice(2)} ${value} ${unit}`);
    }));
    return h('fieldset', {'data-service': name}, h('legend', {}, title),
      h('div', {class: 'controls'}, h('label', {class: 'amount'}, input, h('span', {}, unit)), ...buttons));
  }

  _bus() {
    return h('fieldset', {}, h('legend', {}, 'bus'), h('div', {class: 'controls'},
      ...Object.entries(BUS).map(([name, words]) =>
        this._button(name, words, (event) => this._request(event, name, {}, words)))));
  }

  _led(limit) {
    const input = h('input', {type: 'text', maxlength: String(limit), placeholder: 'other', size: '8',
      'aria-label': 'other text for the LED'});
    const show = (text) => {
      const key = `${Date.now()}.${presses++}`;
      if (!this._connection.send({led: {key, text}})) {
        this._addAnswer(`LED ${text}`, 'refused', 'nothing was sent: no connection to the panel');
        return;
      }
      this._pending.set(key, {name: '', words: `LED ${text}`});
      setTimeout(() => this._pending.delete(key), 1000);    // a refusal is received earlier
    };
    const form = h('form', {class: 'controls', onsubmit: (event) => {
      event.preventDefault();
      if (input.value) show(input.value);
    }}, ...LEDS.map((text) => h('button', {type: 'button', onclick: () => show(text)}, text)),
    input, h('button', {type: 'submit'}, 'show'));
    return h('fieldset', {'data-service': '~led'}, h('legend', {}, 'LED'), form);
  }

  _calibrate() {
    const yes = this._button('~calibrate_imu', 'Calibrate now', (event) => {
      dialog.close();
      this._request(event, '~calibrate_imu', {}, PLAIN['~calibrate_imu']);
    });
    const dialog = h('dialog', {'aria-labelledby': 'calibrate-title'},
      h('h2', {id: 'calibrate-title'}, 'Calibrate the IMU?'),
      h('p', {}, 'The car must not move for over five minutes. During that time it takes no commands '
        + 'and sends no IMU data.'),
      h('div', {class: 'controls'}, yes, h('button', {type: 'button', onclick: () => dialog.close()}, 'Cancel')));
    const open = this._button('~calibrate_imu', 'calibrate …', () => dialog.showModal());
    return h('fieldset', {'data-service': '~calibrate_imu'}, h('legend', {}, 'IMU'),
      h('div', {class: 'controls'}, open, this._calibrateNote), dialog);
  }

  /** The form of a custom function, with an input for each field of its request. */
  _form(name, fields) {
    const inputs = fields.map(([field, type]) => [field, type, type === 'bool'
      ? h('input', {type: 'checkbox'})
      : h('input', {type: type === 'string' ? 'text' : 'number', value: type === 'string' ? '' : '0',
        step: INTEGER.test(type) ? '1' : 'any', required: type !== 'string', size: '6'})]);
    const title = name.replace('~', '');
    const call = this._button(name, 'call', (event) => {
      if (!inputs.every(([, , input]) => input.reportValidity())) return;
      const args = Object.fromEntries(inputs.map(([field, type, input]) => [field,
        type === 'bool' ? input.checked : type === 'string' ? input.value : Number(input.value)]));
      this._request(event, name, args, `${title} ${Object.values(args).join(' ')}`.trim());
    });
    return h('fieldset', {'data-service': name}, h('legend', {}, title), h('div', {class: 'controls'},
      ...inputs.map(([field, , input]) => h('label', {class: 'amount'}, `${field} `, input)), call));
  }

  // -- answers ---------------------------------------------------------------------------------

  _calibrating(model, now) {
    const last = model.topic('~imu/calibrating').last;
    if (last?.[1] !== true) {
      updateText(this._calibrateNote, '');
      return;
    }
    updateText(this._calibrateNote, `calibrating for ${formatAge(Math.max(0, now - last[0]))} `
      + 'of over 5 min; do not move the car');
  }

  _list(model, now) {
    const calls = [...model.calls.values()].map((call) => ({
      what: describe(call), outcome: call.outcome, at: call.began, number: call.number,
      words: call.outcome ? `${answerText(call)} (${call.took.toFixed(2)} s)`.trim()
        : `under way for ${formatAge(now - call.began)}`}));
    const waiting = [...this._pending.values()].filter((each) => each.name && ![...model.calls.values()]
      .some((call) => this._pending.get(call.key) === each)).map((each) =>
      ({what: each.words, at: each.at, words: 'sending …'}));
    const all = [...calls, ...this._ownAnswers, ...waiting].sort((one, other) => other.at - one.at).slice(0, SHOWN);
    const drawn = JSON.stringify(all.map(({what, outcome, words, at}) => [what, outcome, words, at]));
    if (drawn === this._drawnAnswers) return;
    this._drawnAnswers = drawn;
    this._answers.replaceChildren(...all.map(({what, outcome, words}) =>
      h('li', {'data-outcome': outcome ?? 'pending'}, h('b', {}, what), ' ',
        h('span', {class: 'outcome'}, outcome ? WORDS[outcome] : '…'), ' ',
        h('span', {class: 'words'}, words))));
  }
}

/** The text of an answer; empty if it only repeats the command. */
const answerText = ({outcome, words}) => outcome === 'done' && words.startsWith('done') ? '' : words;

/** A call as text; it may be one of another page. */
function describe({name, arguments: args}) {
  const move = MOVES[name];
  if (PLAIN[name]) return PLAIN[name];
  if (!move) return `${name.replace('~', '')} ${Object.values(args).join(' ')}`.trim();
  const [title, amount, unit, , directions] = move;
  return `${title} ${directions[args.direction]?.[0].slice(2) ?? args.direction} ${args[amount]} ${unit}`;
}
