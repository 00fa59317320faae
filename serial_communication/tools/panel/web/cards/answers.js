/** The answers to the commands of every page, the latest first. */
import {formatAge, h, unit} from '../dom.js';

const SHOWN = 12;

export class Answers {
  constructor() {
    this._own = [];       // answers of this page, beside those of the panel
    this._list = h('ol', {class: 'answers', tabindex: '0', 'aria-label': 'answers, the latest first'});
    this.element = h('div', {class: 'answers-of'}, h('h3', {}, 'Answers'), this._list);
    this._drawn = '';
  }

  /** Add an answer that the panel does not have. */
  add(answer) {
    this._own.push(answer);
    this._own.splice(0, this._own.length - SHOWN);
  }

  /** @param waiting [{words, at}] of what was requested and is not yet known to the panel */
  draw(model, now, waiting) {
    const calls = [...model.calls.values()].map((call) => ({
      what: describe(call, model.controls.services), outcome: call.outcome, at: call.began, reply: call.reply,
      words: call.outcome === 'sent' ? call.words
        : call.outcome ? `${answerText(call)} (${call.took.toFixed(2)} s)`.trim()
          : `under way for ${formatAge(now - call.began)}`}));
    const all = [...calls, ...this._own, ...waiting.map(({words, at}) => ({what: words, at, words: 'sending …'}))]
      .sort((one, other) => other.at - one.at).slice(0, SHOWN);
    const drawn = JSON.stringify(all);
    if (drawn === this._drawn) return;
    this._drawn = drawn;
    this._list.replaceChildren(...all.map(({what, outcome, words, reply}) =>
      h('li', {'data-outcome': outcome ?? 'pending'}, h('b', {}, what), ' ',
        h('span', {class: 'outcome'}, outcome ?? '…'), ' ', h('span', {class: 'words'}, words),
        ...reply?.length ? [h('dl', {class: 'reply'}, ...reply.map(([name, value]) =>
          h('div', {}, h('dt', {}, name), h('dd', {}, value))))] : [])));
  }
}

/** The text of an answer; empty if it only repeats the command. */
const answerText = ({outcome, words}) => outcome === 'done' && words.startsWith('done') ? '' : words;

const ARROW = /^[^\p{L}\p{N}]+/u;       // before the word of a button

/**
 * A command as text; it may be one of another page.
 *
 * @param services as in the controls
 */
export function describe({name, arguments: values}, services) {
  if (name === '~stop') return values.data ? 'STOP' : 'release STOP';
  if (name === '~led') return `LED ${values.text}`;
  const {title, fields} = services[name] ?? {fields: []};
  const known = new Map(fields.map((field) => [field.name, field]));
  // First what was chosen: lift up 20 mm.
  const words = Object.entries(values).map(([key, value]) => {
    const {choices = [], preset, unit: name} = known.get(key) ?? {};
    const [label] = choices.find(([, each]) => each === value) ?? [];
    return label !== undefined ? {order: 0, text: label.replace(ARROW, '')}
      : {order: 1, text: typeof preset === 'number' ? `${value} ${unit(name)}` : String(value)};
  }).sort((one, other) => one.order - other.order);
  return [title || name.replace('~', ''), ...words.map((each) => each.text)].join(' ').trim();
}
