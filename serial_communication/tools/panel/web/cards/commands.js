/**
 * The commands, with --control: a form for each service, setting and command of the bridge, their
 * answers, and STOP. The one guard against accidental clicks: a button that was pressed is disabled
 * until its command is answered, and for as long as the second click of a double click may follow.
 */
import {card, formatAge, formatNumber, h, setText, unitOf} from '../dom.js';
import {isOfPad} from './drive.js';

const GUARD = 0.7;             // s
const STOP_ANSWER = 0.5;       // s that the bridge has to answer a STOP
const STOP_SHOWN = 10;         // s for which a STOP that was not confirmed is shown
const CLICK_OF_PRESS = 1000;   // ms after a press in which a click is the same press
const SHOWN = 8;               // answers
const READ_ONLY = 'This page only looks. One with commands is served by '
  + '“rosrun serial_communication panel --control” and by “bridge.launch control:=true”.';

export class Commands {
  constructor(connection, model) {
    this._connection = connection;
    this._model = model;
    this._presses = 0;
    this._pending = new Map();      // key -> {button, at, name, done}
    this._forms = new Map();        // name -> Form
    this._stop = {at: -Infinity};   // the latest STOP of this page
    this._body = h('div', {class: 'forms'});
    this._answers = h('ol',
      {class: 'answers', 'aria-label': 'answers, the latest first', 'aria-live': 'polite'});
    this.element = card('Commands', '', this._body, this._answers);
    this._go = document.getElementById('go');
    this._go.addEventListener('click', () => this.send(this._go, '~stop', {go: {}}));
    this._listen(document.getElementById('stop'));
    connection.addEventListener('refused', ({detail}) => this._refused(detail));
    connection.addEventListener('lost', () => this._lost());
  }

  /**
   * STOP is sent as soon as it is pressed. A touch may bring no click at all: a second finger, one
   * that slips or one that stays. Only a key brings a click alone.
   */
  _listen(button) {
    let pressedAt = -Infinity;
    button.addEventListener('pointerdown', (event) => {
      if (event.button !== 0) return;
      pressedAt = performance.now();
      this._sendStop();
    });
    button.addEventListener('click', () => {
      if (performance.now() - pressedAt > CLICK_OF_PRESS) this._sendStop();
    });
  }

  _sendStop() {
    const key = this._newKey();
    this._stop = {key, at: this._connection.now(), sent: this._connection.send({stop: {key}})};
  }

  /** Why the latest STOP of this page may not hold; '' if it is confirmed or long ago. */
  stopTrouble(now) {
    const age = now - this._stop.at;
    const call = [...this._model.calls.values()].find(({key}) => key === this._stop.key);
    if (call?.outcome === 'done' || age > STOP_SHOWN && (!call || call.outcome)) return '';
    if (call?.outcome) return `STOP: ${call.words}`;
    if (!this._stop.sent && age < STOP_SHOWN) return 'STOP was not sent: no connection';
    return age < STOP_ANSWER ? ''
      : `STOP: no answer from the bridge for ${formatAge(age)}; zeros are sent`;
  }

  _newKey() { return `${Date.now()}.${this._presses++}`; }

  /** Send a command; its button is disabled meanwhile. `message` has one key. */
  send(button, name, message, done = null) {
    const key = this._newKey(), [[kind, values]] = Object.entries(message);
    if (!this._connection.alive || !this._connection.send({[kind]: {key, ...values}})) {
      this._tell(name, 'refused', 'nothing was sent: no connection to the panel');
      return;
    }
    button.disabled = true;
    this._pending.set(key, {button, at: this._connection.now(), name, done});
  }

  /** Show an answer that the panel does not have. */
  _tell(name, outcome, words) {
    this._model.calls.set(this._newKey(), {name, values: {}, outcome, words,
      began: this._connection.now()});
  }

  _refused({key, words}) {
    const request = this._pending.get(key);
    if (!request) return;
    this._tell(request.name, 'refused', words);
    request.refused = true;
  }

  _lost() {
    for (const [key, {button, name, done}] of this._pending) {
      this._pending.delete(key);
      button.disabled = false;
      done?.();
      this._tell(name, 'not known', 'the connection was lost before the answer; check the robot');
    }
  }

  draw(model, now) {
    this._go.hidden = !model.control || !model.stopped(now);
    for (const [key, request] of this._pending) {
      const answered = request.refused
        || [...model.calls.values()].some((call) => call.key === key && call.outcome);
      if (!answered || now - request.at < GUARD) continue;
      this._pending.delete(key);
      request.button.disabled = false;
      request.done?.();
    }
    if (!model.control) {
      if (this._body.textContent !== READ_ONLY) this._body.replaceChildren(READ_ONLY);
      return;
    }
    this._build(model.forms);
    for (const form of this._forms.values()) form.draw(model, now);
    this._list(model, now);
  }

  /** Make the forms. One that has not changed keeps its place, and what was entered. */
  _build(wanted) {
    if (wanted === this._built) return;
    this._built = wanted;
    const shapes = new Map(Object.entries(wanted).filter(([, form]) => !isOfPad(form))
      .map(([name, form]) => [name, JSON.stringify(form)]));
    if (!this._forms.size) this._body.replaceChildren();
    for (const [name, form] of this._forms) {
      if (shapes.get(name) === form.shape) continue;
      form.element.remove();
      this._forms.delete(name);
    }
    for (const name of shapes.keys()) {
      if (this._forms.has(name)) continue;
      this._forms.set(name, new Form(this, name, wanted[name]));
      this._body.append(this._forms.get(name).element);
    }
  }

  _list(model, now) {
    const all = [...model.calls.values()].sort((one, other) => other.began - one.began);
    const lines = all.slice(0, SHOWN).map((call) => {
      const reply = (call.reply ?? []).map(([name, value]) => `${name}: ${value}`).join(', ');
      return [call.outcome ?? 'under way', describe(call, model.forms),
        call.outcome ? `${call.words} ${reply}` : `for ${formatAge(now - call.began)}`];
    });
    const shape = JSON.stringify(lines);
    if (shape === this._shown) return;
    this._shown = shape;
    this._answers.replaceChildren(...lines.map(([outcome, what, words]) =>
      h('li', {'data-outcome': outcome}, h('b', {}, what), words.startsWith(outcome)
        ? ` ${words}` : ` ${outcome}: ${words}`)));
  }
}

/** A command as text: its title and its values. */
function describe({name, values}, forms) {
  if (name === '~stop') return values.data === false ? 'release' : 'STOP';
  const {title, fields} = forms[name] ?? {title: '', fields: []};
  return [title || name.replace('~', ''), ...Object.entries(values).map(([key, value]) => {
    const field = fields.find((each) => each.name === key);
    const choice = field?.choices?.find(([, each]) => each === value);
    return choice ? choice[0] : `${value} ${unitOf(field?.unit ?? '')}`.trim();
  })].join(' ');
}

/** One form: its fields, and a button; a button for each choice of a field that has some. */
class Form {
  constructor(commands, name, described) {
    const {link, title, fields, confirm, setting, about, isCall} = described;
    this.shape = JSON.stringify(described);
    this._link = link;
    this._reason = h('span', {class: 'reason'});
    this._inputs = [];      // [field, input]
    const heading = title || name.replace('~', '');
    const choice = fields.find((field) => field.choices?.length);
    const send = (button, more = {}, done = null) => {
      if (!this._inputs.every(([field, input]) => check(field, input))) return;
      const values = Object.fromEntries(this._inputs.map(([field, input]) =>
        [field.name, valueOf(field, input)]));
      commands.send(button, name, {send: {name, values: {...values, ...more}}}, done);
    };
    const button = (words, more) => {
      const made = h('button', {type: 'button', onclick: () => send(made, more)}, words);
      return made;
    };
    const set = h('button', {type: 'button'}, 'set');
    const parts = fields.filter((field) => field !== choice).map((field) => {
      const input = makeInput(field);
      this._inputs.push([field, input]);
      const beside = typeof field.preset === 'number' ? unitOf(field.unit) : limits(field);
      const name = fields.length > 1 && field.preset === null ? `${field.name} ` : '';
      return h('label', {}, name, input, h('span', {class: 'note'}, ` ${beside}`));
    });
    if (setting) {
      parts.push(set, ...this._setting(setting, fields[0], send, set));
    } else if (choice) {
      parts.push(...choice.choices.map(([words, value]) => button(words, {[choice.name]: value})));
    } else {
      parts.push(button(fields.length ? isCall ? 'call' : 'send' : heading));
    }
    const head = fields.length ? [h('h3', {title: about || null}, heading, ' ', this._reason)] : [];
    this.element = confirm
      ? h('details', {class: 'form'}, h('summary', {}, `${heading} …`),
        h('p', {class: 'note'}, confirm), ...parts)
      : h('div', {class: fields.length ? 'form' : 'form plain'}, ...head,
        h('div', {class: 'row'}, ...parts));
    this.element.dataset.form = name;
  }

  /**
   * The board's own value, and a slider between the limits. Its last value is sent, always: what is
   * chosen while another is under way is sent when that is answered.
   */
  _setting(setting, field, send, button) {
    const [[, number]] = this._inputs;
    this._name = setting;
    this._board = h('b', {class: 'board-value'}, '?');
    let again = false;
    const sendLast = () => {
      again = button.disabled;
      if (!again) send(button, {}, () => { if (again) sendLast(); });
    };
    button.addEventListener('click', sendLast);
    const parts = [h('span', {class: 'note'}, 'board: ', this._board)];
    const {low, high, whole} = field;
    if (field.kind !== 'number' || low === null || high === null) return parts;
    const slide = h('input', {type: 'range', min: low, max: high, 'aria-label': setting,
      step: whole ? '1' : String((high - low) / 500), onchange: sendLast});
    slide.addEventListener('input', () => { number.value = Number(slide.value).toPrecision(4); });
    number.addEventListener('input', () => { slide.value = number.value; });
    this._inputs[0].push(slide);
    return [...parts, slide];
  }

  draw(model, now) {
    this.element.hidden = !model.links.has(this._link);
    setText(this._reason, model.whyNot(this._link, now));
    if (!this._board) return;
    // From the values of /diagnostics: kp=2, ramp=?
    const known = (model.links.get(this._link)?.values.settings ?? '').split(', ')
      .find((each) => each.startsWith(`${this._name}=`))?.slice(this._name.length + 1) ?? '?';
    setText(this._board, known);
    if (known === '?' || this._begun) return;
    this._begun = true;         // the form begins with the board's value
    const [, number, slide] = this._inputs[0];
    if (number.type === 'checkbox') number.checked = known === 'true';
    else if (!number.value) number.value = known;
    if (slide) slide.value = known;
  }
}

function makeInput({name, kind, whole, low, high, preset}) {
  if (kind === 'bool') return h('input', {type: 'checkbox', 'aria-label': name});
  if (kind !== 'number') return h('input', {type: 'text', 'aria-label': name});
  return h('input', {type: 'number', 'aria-label': name, value: preset ?? null, min: low, max: high,
    step: whole ? '1' : 'any', inputmode: 'decimal', required: true});
}

/** The unit and the limits of a field as text. */
function limits({kind, low, high, unit}) {
  if (kind === 'bool') return '';
  const range = low === null && high === null ? '' : low === null ? `≤ ${formatNumber(high)}`
    : high === null ? `≥ ${formatNumber(low)}` : `${formatNumber(low)} … ${formatNumber(high)}`;
  const list = kind === 'array' ? 'numbers with spaces' : '';
  return [unitOf(unit), range, list].filter(Boolean).join(', ');
}

/** Whether the input is valid; otherwise the browser shows why. An empty field is not 0. */
function check(field, input) {
  if (field.kind === 'array') {
    const right = valueOf(field, input).every(Number.isFinite);
    input.setCustomValidity(right ? '' : `Enter numbers: ${limits(field)}`);
  }
  return input.reportValidity();
}

function valueOf({kind}, input) {
  if (kind === 'bool') return input.checked;
  if (kind === 'array') return input.value.trim().split(/[\s,;]+/).filter(Boolean).map(Number);
  return kind === 'number' ? Number(input.value) : input.value;
}
