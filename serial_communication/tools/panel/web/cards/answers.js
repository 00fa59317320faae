/** The answers to the commands of every page, the latest first. */
import {formatAge, h} from '../dom.js';

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
      what: describe(call), outcome: call.outcome, at: call.began, reply: call.reply,
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

/** The moves with a preset amount: title, amount, unit, preset, directions. */
export const MOVES = {
  '~lift': ['lift', 'distance', 'mm', 20, [['▲ up', 0], ['▼ down', 1]]],
  '~gimbal': ['gimbal', 'angle', '°', 10, [['◀ left', 0], ['▶ right', 1], ['▲ up', 2], ['▼ down', 3]]],
};
export const BUS = {'~bus/echo': 'echo', '~bus/sync': 'sync'};
export const PLAIN = {...BUS, '~calibrate_imu': 'calibrate the IMU', '~speed': 'STOP'};

/** A command as text; it may be one of another page. */
function describe({name, arguments: args}) {
  const move = MOVES[name];
  if (PLAIN[name]) return PLAIN[name];
  if (name === '~led') return `LED ${args.text}`;
  if (!move) return `${name.replace('~', '')} ${Object.values(args).join(' ')}`.trim();
  const [title, amount, unit, , directions] = move;
  return `${title} ${directions[args.direction]?.[0].slice(2) ?? args.direction} ${args[amount]} ${unit}`;
}
