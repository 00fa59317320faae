/**
 * Calls. A control is disabled until its answer is there, and the answer stays to be read. What
 * was under way as the connection went is told as what it is: not known.
 */
import {ago, card, h, mark, say} from '../dom.js';

const LEAST_DISABLED = 700;    // ms; the second click of a double click comes within 500
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
    this._pending = new Map();      // key -> {name, words, at}: asked for, not answered
    this._groups = new Map();       // service -> its buttons
    this._told = [];                // what this page itself has to say, beside the calls
    this._body = h('div', {class: 'commands'});
    this._answers = h('ol', {class: 'answers', 'aria-label': 'answers, the newest first'});
    this._calibrateNote = h('p', {class: 'words'});
    this._calibratingSince = null;
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
        mark(button, 'disabled', busy || button.restsUntil > performance.now());
      });
    }
    this._calibrating(model, now);
    this._list(model, now);
  }

  /** The server refused what was asked with this key. */
  refused({key, words}) {
    const asked = this._pending.get(key);
    if (!asked) return;
    this._pending.delete(key);
    this._tell(asked.words, 'refused', words);
  }

  _settle(model) {
    for (const call of model.calls.values()) {
      const asked = this._pending.get(call.key);
      if (!asked || !call.outcome) continue;
      this._pending.delete(call.key);
      this._announce(`${asked.words}: ${WORDS[call.outcome]}, ${call.words}`);
    }
  }

  _lost() {
    for (const [key, asked] of this._pending) {
      this._pending.delete(key);
      this._tell(asked.words, 'not known', 'the connection went before the answer came; '
        + 'look before you repeat it');
    }
  }

  _tell(what, outcome, words) {
    this._told.push({what, outcome, words, at: this._connection.now()});
    this._told.splice(0, this._told.length - SHOWN);
    this._announce(`${what}: ${WORDS[outcome]}, ${words}`);
  }

  _ask(event, name, args, words) {
    // The second click of a double click is no second wish.
    if (event.detail > 1) return;
    const key = `${Date.now()}.${presses++}`;
    for (const button of this._groups.get(name)) {
      button.restsUntil = performance.now() + LEAST_DISABLED;
      mark(button, 'disabled', true);
    }
    const at = this._connection.now();
    if (this._connection.alive && this._connection.send({call: {key, name, arguments: args}})) {
      this._pending.set(key, {name, words, at});
    } else {
      this._tell(words, 'refused', 'nothing was sent: no connection to the panel');
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
    button.restsUntil = 0;
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
      this._ask(event, name, {direction, [amount]: value}, `${title} ${words.slice(2)} ${value} ${unit}`);
    }));
    return h('fieldset', {'data-service': name}, h('legend', {}, title),
      h('div', {class: 'row'}, h('label', {class: 'amount'}, input, h('span', {}, unit)), ...buttons));
  }

  _bus() {
    return h('fieldset', {}, h('legend', {}, 'bus'), h('div', {class: 'row'},
      ...Object.entries(BUS).map(([name, words]) =>
        this._button(name, words, (event) => this._ask(event, name, {}, words)))));
  }

  _led(limit) {
    const input = h('input', {type: 'text', maxlength: String(limit), placeholder: 'other', size: '8',
      'aria-label': 'other text for the LED'});
    const show = (text) => {
      const key = `${Date.now()}.${presses++}`;
      if (!this._connection.send({led: {key, text}})) {
        this._tell(`LED ${text}`, 'refused', 'nothing was sent: no connection to the panel');
        return;
      }
      this._pending.set(key, {name: '', words: `LED ${text}`});
      setTimeout(() => this._pending.delete(key), 1000);    // a refusal would have come by then
    };
    const form = h('form', {class: 'row', onsubmit: (event) => {
      event.preventDefault();
      if (input.value) show(input.value);
    }}, ...LEDS.map((text) => h('button', {type: 'button', onclick: () => show(text)}, text)),
    input, h('button', {type: 'submit'}, 'show'));
    return h('fieldset', {'data-service': '~led'}, h('legend', {}, 'LED'), form);
  }

  _calibrate() {
    const yes = this._button('~calibrate_imu', 'Calibrate now', (event) => {
      dialog.close();
      this._ask(event, '~calibrate_imu', {}, PLAIN['~calibrate_imu']);
    });
    const dialog = h('dialog', {'aria-labelledby': 'calibrate-title'},
      h('h2', {id: 'calibrate-title'}, 'Calibrate the IMU?'),
      h('p', {}, 'The car must stand still for over five minutes. It takes no commands meanwhile, '
        + 'and no IMU data comes.'),
      h('div', {class: 'row'}, yes, h('button', {type: 'button', onclick: () => dialog.close()}, 'Cancel')));
    const open = this._button('~calibrate_imu', 'calibrate …', () => dialog.showModal());
    return h('fieldset', {'data-service': '~calibrate_imu'}, h('legend', {}, 'IMU'),
      h('div', {class: 'row'}, open, this._calibrateNote), dialog);
  }

  /** A function of the configuration: a field for each part of its request. */
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
      this._ask(event, name, args, `${title} ${Object.values(args).join(' ')}`.trim());
    });
    return h('fieldset', {'data-service': name}, h('legend', {}, title), h('div', {class: 'row'},
      ...inputs.map(([field, , input]) => h('label', {class: 'amount'}, `${field} `, input)), call));
  }

  // -- what became of it -----------------------------------------------------------------------

  _calibrating(model, now) {
    const last = model.topic('~imu/calibrating').last;
    if (last?.[1] !== true) {
      say(this._calibrateNote, '');
      return;
    }
    say(this._calibrateNote, `being calibrated for ${ago(Math.max(0, now - last[0]))}, `
      + 'of over 5 min; keep still');
  }

  _list(model, now) {
    const calls = [...model.calls.values()].map((call) => ({
      what: describe(call), outcome: call.outcome, at: call.began, number: call.number,
      words: call.outcome ? `${said(call)} (${call.took.toFixed(2)} s)`.trim()
        : `under way for ${ago(now - call.began)}`}));
    const waiting = [...this._pending.values()].filter((each) => each.name && ![...model.calls.values()]
      .some((call) => this._pending.get(call.key) === each)).map((each) =>
      ({what: each.words, at: each.at, words: 'asking …'}));
    const all = [...calls, ...this._told, ...waiting].sort((one, other) => other.at - one.at).slice(0, SHOWN);
    const drawn = JSON.stringify(all.map(({what, outcome, words, at}) => [what, outcome, words, at]));
    if (drawn === this._drawnAnswers) return;
    this._drawnAnswers = drawn;
    this._answers.replaceChildren(...all.map(({what, outcome, words}) =>
      h('li', {'data-outcome': outcome ?? 'pending'}, h('b', {}, what), ' ',
        h('span', {class: 'outcome'}, outcome ? WORDS[outcome] : '…'), ' ',
        h('span', {class: 'words'}, words))));
  }
}

/** The answer's words, but for those that only repeat what was asked. */
const said = ({outcome, words}) => outcome === 'done' && words.startsWith('done') ? '' : words;

/** A call in words, whichever page made it. */
function describe({name, arguments: args}) {
  const move = MOVES[name];
  if (PLAIN[name]) return PLAIN[name];
  if (!move) return `${name.replace('~', '')} ${Object.values(args).join(' ')}`.trim();
  const [title, amount, unit, , directions] = move;
  return `${title} ${directions[args.direction]?.[0].slice(2) ?? args.direction} ${args[amount]} ${unit}`;
}
