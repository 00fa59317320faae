/**
 * Commands: service calls and messages to the boards. A control is disabled until its command is
 * answered, and while it cannot be carried out, with the reason beside it. If the connection is lost
 * during a call, its outcome is shown as not known.
 */
import {APPEARED, appear, hasJustAppeared} from '../appeared.js';
import {card, formatAge, h, updateAttribute, updateText} from '../dom.js';
import {whyNoCall, whyNot} from '../reasons.js';
import {Answers, describe} from './answers.js';
import {makeInputs} from './forms.js';

const LEAST_DISABLED = 700;    // ms; the second click of a double click follows within 500
const LEDS = ['left', 'right', 'brake', 'disable'];
const READ_ONLY = [
  'This page only looks: it sends nothing to the robot. A page with commands is served by '
  + '“rosrun serial_communication panel --control”, “bridge.launch control:=true” and “scripts/demo --panel --control”.',
  'Who reaches its address sees this page: on the panel’s machine every user, and through an ssh tunnel every '
  + 'user of the machine where the tunnel begins.'];

const CALIBRATE = '~calibrate_imu';

const STOP_ANSWER = 0.5;       // s that the bridge has to answer a STOP
const STOP_SHOWN = 10;         // s for which a STOP that was not confirmed is shown
let presses = 0;

export class Commands {
  constructor(connection, announce) {
    this.topics = ['~imu/calibrating'];
    this._connection = connection;
    this._announce = announce;
    this._pending = new Map();      // key -> {name, words, at} of what was requested and not answered
    this._release = document.getElementById('release');
    this._release.addEventListener('click', (event) => this._request(event, '~stop',
      {call: {name: '~stop', arguments: {data: false}}}, 'release STOP'));
    this._groups = new Map([['~stop', [this._release]]]);   // name of a service or topic -> its buttons
    this._reasons = [];             // [{name, link, isCall, place}]: where the reasons are shown
    this._forms = new Map();        // key -> {shape, element}
    // [setting, link, place, inputs]: where the board's value is shown, and begins to be entered
    this._settings = [];
    this._body = h('div', {class: 'commands'});
    this._answers = new Answers();
    this._calibrateNote = h('p', {class: 'words beside-button'});
    this.element = card('Commands', '', this._body, this._answers.element);
    this.element.hidden = true;
    this._shape = null;
    this._stop = {at: -Infinity};   // the latest STOP of this page: its key, and when it was pressed
    connection.addEventListener('lost', () => this._lost());
  }

  draw(model, now) {
    this.element.hidden = !model.node;
    this._release.hidden = !model.controls || !model.stopped(now);
    this._release.disabled = !this._connection.alive || hasJustAppeared()
      || this._release.disabledUntil > performance.now();
    const shape = JSON.stringify(model.controls);
    if (shape !== this._shape) {
      this._shape = shape;
      this._answers.element.hidden = !model.controls;
      if (model.controls) this._build(model.controls);
      else this._explainReadOnly();
    }
    if (!model.controls) return;
    this._settle(model);
    const busy = new Set([...this._pending.values()].map((each) => each.name));
    for (const call of model.calls.values()) if (!call.outcome) busy.add(call.name);
    for (const {name, link, isCall, place} of this._reasons) {
      const moves = !isCall && name !== '~led';     // a call is answered with the reason
      const reason = (isCall ? whyNoCall : whyNot)(model, this._connection, now, link, moves);
      updateText(place, reason);
      updateAttribute(place, 'title', reason || null);
      this._groups.get(name).forEach((button) => {
        updateAttribute(button, 'disabled', Boolean(reason) || busy.has(name)
          || button.disabledUntil > performance.now());
        updateAttribute(button, 'title', reason || null);
      });
    }
    this._calibrating(model, now);
    for (const [setting, link, place, inputs] of this._settings) {
      const value = boardValue(model.links.get(link), setting);
      updateText(place, value);
      // The form begins with the board's value.
      if (value !== '?') inputs.splice(0).forEach((input) => begin(input, value));
    }
    this._answers.draw(model, now, [...this._pending.entries()].filter(([key]) =>
      ![...model.calls.values()].some((call) => call.key === key)).map(([, each]) => each));
  }

  /** The panel refused the command with this key. */
  refused({key, words}) {
    const request = this._pending.get(key);
    if (!request) return;
    this._pending.delete(key);
    this._addAnswer(request.words, 'refused', words);
  }

  /** Stop all that moves, whatever the page shows. */
  stop() {
    this._stop = {at: this._connection.now(), key: this._send('~stop', {stop: {}}, 'STOP')};
  }

  /** Why the latest STOP of this page may not hold; '' if it is confirmed or long ago. */
  stopTrouble(model, now) {
    const age = now - this._stop.at;
    const call = [...model.calls.values()].find(({key}) => key === this._stop.key);
    if (call?.outcome === 'done' || age < STOP_ANSWER && !call?.outcome) return '';
    if (call && !call.outcome) return `STOP: no answer from the bridge for ${formatAge(age)}`;
    return age > STOP_SHOWN ? '' : `STOP: ${call?.words ?? 'no answer from the panel'}`;
  }

  _settle(model) {
    for (const call of model.calls.values()) {
      const request = this._pending.get(call.key);
      if (!request || !call.outcome) continue;
      this._pending.delete(call.key);
      this._announce(`${request.words}: ${call.outcome}, ${call.words}`);
    }
  }

  _lost() {
    for (const [key, request] of this._pending) {
      this._pending.delete(key);
      this._addAnswer(request.words, 'not known', 'the connection was lost before the answer was received; '
        + 'check the robot before you repeat it');
    }
  }

  _addAnswer(what, outcome, words) {
    this._answers.add({what, outcome, words, at: this._connection.now()});
    this._announce(`${what}: ${outcome}, ${words}`);
  }

  /** Send a command once; `message` has one key, and its value gets the key of the command. */
  _request(event, name, message, words) {
    // The second click of a double click must not move anything again.
    if (event.detail > 1) return;
    if (hasJustAppeared()) {
      this._addAnswer(words, 'refused', `nothing was sent: ${APPEARED}; press again`);
      return;
    }
    for (const button of this._groups.get(name)) {
      button.disabledUntil = performance.now() + LEAST_DISABLED;
      updateAttribute(button, 'disabled', true);
    }
    this._send(name, message, words);
  }

  /** Send a command; return the key of its answer. */
  _send(name, message, words) {
    const key = `${Date.now()}.${presses++}`, at = this._connection.now();
    const [[kind, values]] = Object.entries(message);
    // STOP may help also where no update is received: the panel may take it nevertheless, or later.
    if ((kind === 'stop' || this._connection.alive) && this._connection.send({[kind]: {key, ...values}})) {
      this._pending.set(key, {name, words, at});
    } else {
      this._addAnswer(words, 'refused', 'nothing was sent: no connection to the panel');
    }
    return key;
  }

  // -- building ------------------------------------------------------------------------------

  _explainReadOnly() {
    for (const [key, {element}] of this._forms) this._remove(key, element);
    this._body.replaceChildren(...READ_ONLY.map((words) => h('p', {class: 'words'}, words)));
  }

  /** Show a form for each command. One that has not changed keeps its place, and what was entered. */
  _build({services, messages, led_limit: ledLimit}) {
    const wanted = new Map(), plain = new Map();
    for (const [name, each] of Object.entries(services)) {
      if (name === '~stop') continue;       // its buttons are in the page's head
      if (each.title && !each.fields.length && !each.confirm) {
        if (!plain.has(each.link)) plain.set(each.link, []);
        plain.get(each.link).push([name, each.title]);
      } else {
        wanted.set(`service ${name}`, [each, () => this._service(name, each)]);
      }
    }
    for (const [link, calls] of plain) wanted.set(`link ${link}`, [calls, () => this._plain(link, calls)]);
    wanted.set('led', [ledLimit, () => this._led(ledLimit)]);
    for (const [name, each] of Object.entries(messages)) {
      wanted.set(`message ${name}`, [each, () => this._form(name, each, false)]);
    }
    if (!this._forms.size) this._body.replaceChildren();
    for (const [key, {shape, element}] of this._forms) {
      if (JSON.stringify(wanted.get(key)?.[0]) !== shape) this._remove(key, element);
    }
    for (const [key, [description, make]] of wanted) {
      if (this._forms.has(key)) continue;
      const element = make();
      this._forms.set(key, {shape: JSON.stringify(description), element});
      this._body.append(element);
      appear();     // others may have moved under the pointer
    }
  }

  _remove(key, element) {
    this._forms.delete(key);
    for (const {name, place} of this._reasons) if (element.contains(place)) this._groups.delete(name);
    this._reasons = this._reasons.filter(({place}) => !element.contains(place));
    this._settings = this._settings.filter(([,, place]) => !element.contains(place));
    element.remove();
    appear();
  }

  /** A group of controls, whose legend has the reason why they cannot be used. */
  _fieldset(title, names, link, isCall, ...children) {
    const place = h('span', {class: 'reason'});
    for (const name of names) this._reasons.push({name, link, isCall, place});
    return h('fieldset', {'data-service': names[0]}, h('legend', {}, title, ' ', place), ...children);
  }

  _button(name, words, press) {
    const button = h('button', {type: 'button', onclick: press}, words);
    button.disabledUntil = 0;
    if (!this._groups.has(name)) this._groups.set(name, []);
    this._groups.get(name).push(button);
    return button;
  }

  /** The form of a service. */
  _service(name, each) {
    return each.confirm ? this._confirmed(name, each) : this._form(name, each, true);
  }

  /** The services of a link that take nothing. */
  _plain(link, calls) {
    return this._fieldset(link, calls.map(([name]) => name), link, true, h('div', {class: 'controls'},
      ...calls.map(([name, words]) =>
        this._button(name, words, (event) => this._request(event, name, {call: {name, arguments: {}}}, words)))));
  }

  _led(limit) {
    const input = h('input', {type: 'text', maxlength: String(limit), placeholder: 'other', size: '8', required: true,
      'aria-label': 'other text for the LED'});
    const show = (event, text) => this._request(event, '~led', {led: {text}}, `LED ${text}`);
    return this._fieldset('LED', ['~led'], 'arduino', false, h('div', {class: 'controls'},
      ...LEDS.map((text) => this._button('~led', text, (event) => show(event, text))),
      input, this._button('~led', 'show', (event) => { if (input.reportValidity()) show(event, input.value); })));
  }

  /** A service that takes nothing, and is called after a confirmation only. */
  _confirmed(name, {link, title, confirm}) {
    const yes = this._button(name, 'Start now', (event) => {
      dialog.close();
      this._request(event, name, {call: {name, arguments: {}}}, title);
    });
    const id = `confirm-${name.replace(/\W/g, '-')}`;
    // Not modal: STOP must work beside it.
    const dialog = h('dialog', {'aria-labelledby': id},
      h('h2', {id}, `${title[0].toUpperCase()}${title.slice(1)}?`), h('p', {}, confirm),
      h('div', {class: 'controls'}, yes, h('button', {type: 'button', onclick: () => dialog.close()}, 'Cancel')));
    return this._fieldset(title, [name], link, true, h('div', {class: 'controls'},
      this._button(name, 'start …', () => dialog.show()),
      ...name === CALIBRATE ? [this._calibrateNote] : []), dialog);
  }

  /** The form of a service or of a custom command; a field with choices has a button for each. */
  _form(name, {link, fields, title, setting, about}, isCall) {
    const heading = title || name.replace('~', '');
    if (fields.some((field) => field.kind === 'other')) {
      return h('fieldset', {}, h('legend', {}, heading), h('p', {class: 'words'},
        'its request has fields within fields; call it with rosservice'));
    }
    const choice = fields.find((field) => field.choices?.length);
    const inputs = makeInputs(fields.filter((field) => field !== choice));
    const request = (event, chosen) => {
      const entered = inputs.read();
      if (!entered) return;
      const values = {...entered, ...chosen};
      this._request(event, name, isCall ? {call: {name, arguments: values}} : {send: {name, values}},
        describe({name, arguments: values}, {[name]: {title, fields}}));
    };
    const buttons = choice
      ? choice.choices.map(([label, value]) =>
        this._button(name, label, (event) => request(event, {[choice.name]: value})))
      : [this._button(name, setting ? 'set' : isCall ? 'call' : 'send', (event) => request(event, {}))];
    const more = [];
    if (setting) {
      const board = h('b', {class: 'board-value'});
      const number = inputs.elements[0].querySelector('input'), sliders = slider(setting, fields[0], number, request);
      this._settings.push([setting, link, board, [number, ...sliders]]);
      more.push(h('span', {class: 'note'}, 'board: ', board), ...sliders);
      if (about) more.push(h('p', {class: 'words'}, about));
    }
    return this._fieldset(heading, [name], link, isCall,
      h('div', {class: 'controls'}, ...inputs.elements, ...buttons, ...more));
  }

  _calibrating(model, now) {
    const last = model.topic('~imu/calibrating').last;
    updateText(this._calibrateNote, last?.[1] !== true ? ''
      : `calibrating for ${formatAge(Math.max(0, now - last[0]))} of over 5 min; do not move the car`);
  }
}

/** The board's own value of a setting, from the values of /diagnostics: kp=2, ramp=? */
function boardValue(link, setting) {
  const found = (link?.values?.['settings'] ?? '').split(', ').find((each) => each.startsWith(`${setting}=`));
  return found ? found.slice(setting.length + 1) : '?';
}

/** Enter the board's value of a setting, unless something is entered already. */
function begin(input, value) {
  if (input.type === 'checkbox') input.checked = value === 'true';
  else if (!input.value || input.type === 'range') input.value = value;
}

/** A slider for a number with limits, which is sent when it is let go. */
function slider(setting, {kind, low, high, whole}, number, request) {
  if (kind !== 'number' || low === null || high === null) return [];
  const made = h('input', {type: 'range', min: low, max: high, step: whole ? '1' : String((high - low) / 500),
    'aria-label': `${setting}, slider`});
  made.addEventListener('input', () => { number.value = made.value; });
  made.addEventListener('change', (event) => request(event, {}));
  number.addEventListener('input', () => { made.value = number.value; });
  return [made];
}
