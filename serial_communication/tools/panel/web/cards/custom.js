/** Own messages of the configuration, and whatever else a bridge publishes: a card each. */
import {card, h, say} from '../dom.js';
import {Plot} from '../plot.js';
import {Reading} from '../reading.js';

const COLOURS = ['--line-1', '--line-2', '--line-3', '--line-4', '--line-5'];
const MOST_LINES = COLOURS.length;    // of one plot
const SLOW = 0.7;                     // s of a stale limit above which ten minutes are shown

class OwnCard {
  constructor(name, type) {
    this.name = name;
    this._shape = null;
    this._parts = [];
    this._body = h('div', {class: 'own'}, h('p', {class: 'words'}, 'nothing yet'));
    this.element = card(name, type, this._body);
    this.element.dataset.own = name;
  }

  draw(model, now) {
    const topic = model.topic(this.name);
    const slow = topic.limit === null || topic.limit > SLOW;
    const shape = topic.fields.map((field) => field.name).join() + slow;
    if (topic.last && shape !== this._shape) {
      this._shape = shape;
      this._build(topic, slow);
    }
    this._parts.forEach((part) => part.draw(model, now));
    if (!this._parts.length && topic.words) say(this._body.firstChild, topic.words);
  }

  _build(topic, slow) {
    const numbers = topic.fields.filter((field) => typeof topic.last[field.at] !== 'string');
    const readings = topic.fields.map((field) => new Reading(field.name, this.name, field.name));
    this._parts = [...readings];
    const lines = numbers.slice(0, MOST_LINES).map((field, index) =>
      ({topic: this.name, field: field.name, colour: COLOURS[index], name: field.name}));
    this._body.replaceChildren(
      h('div', {class: 'readings'}, ...readings.map((reading) => reading.element)));
    if (lines.length) {
      const plot = new Plot(lines.length > 1 ? '' : lines[0].name, lines,
        {span: slow ? 600 : 20, least: 1e-3, digits: null, high: 84});
      this._parts.push(plot);
      this._body.prepend(plot.element);
    }
  }
}

export class CustomMessages {
  constructor() {
    this.element = h('div', {class: 'owns'});
    this._cards = new Map();
  }

  /** Those that are known now: what to watch. */
  get topics() { return [...this._cards.keys()]; }

  /** The bridge publishes these; whether that is news. */
  learn(known) {
    const names = Object.keys(known).filter((name) => known[name].own);
    const before = this.topics.join();
    for (const name of this.topics) {
      if (!names.includes(name)) {
        this._cards.get(name).element.remove();
        this._cards.delete(name);
      }
    }
    for (const name of names) {
      if (!this._cards.has(name)) {
        const made = new OwnCard(name, known[name].type);
        this._cards.set(name, made);
        this.element.append(made.element);
      }
    }
    return this.topics.join() !== before;
  }

  draw(model, now) { this._cards.forEach((each) => each.draw(model, now)); }
}
