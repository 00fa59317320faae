/** A card for each topic that is not built in, such as those of custom messages. */
import {card, h, unit, updateText} from '../dom.js';
import {Plot} from '../plot.js';
import {Reading} from '../reading.js';

const COLOURS = ['--line-1', '--line-2', '--line-3', '--line-4', '--line-5'];
const MAX_CURVES = COLOURS.length;    // curves of one topic

/** Fields with this in common share an axis: a unit, or being parts of one vector or array. */
function axisOf({name, unit}) {
  if (unit) return `unit ${unit}`;
  return /(^|\.)[xyzw]$|\[\d+\]$/.test(name) ? name.replace(/\w$|\[\d+\]$/, '') + '*' : name;
}

class CustomCard {
  constructor(name, type) {
    this.name = name;
    this._shape = null;
    this._parts = [];
    this._body = h('div', {class: 'custom'}, h('p', {class: 'words'}, 'no message received yet'));
    this.element = card(name, type, this._body);
    this.element.dataset.custom = name;
  }

  draw(model, now) {
    const topic = model.topic(this.name);
    const shape = topic.fields.map((field) => field.name).join();
    if (topic.last && shape !== this._shape) {
      this._shape = shape;
      this._build(topic);
    }
    this._parts.forEach((part) => part.draw(model, now));
    if (!this._parts.length && topic.words) updateText(this._body.firstChild, topic.words);
  }

  _build(topic) {
    const numbers = topic.fields.filter((field) => typeof topic.last[field.at] !== 'string');
    const readings = topic.fields.map((field) => new Reading(field.name, this.name, field.name));
    this._parts = [...readings];
    const axes = new Map();
    for (const field of numbers.slice(0, MAX_CURVES)) {
      const axis = axisOf(field);
      if (!axes.has(axis)) axes.set(axis, []);
      axes.get(axis).push(field);
    }
    const plots = [...axes.values()].map((fields) => new Plot(
      fields.length > 1 ? unit(fields[0].unit) : `${fields[0].name} ${unit(fields[0].unit)}`.trim(),
      fields.map((field, index) => ({topic: this.name, field: field.name, colour: COLOURS[index], name: field.name})),
      {least: 1e-3, digits: null, high: 84}));
    this._parts.push(...plots);
    this._body.replaceChildren(...plots.map((plot) => plot.element),
      h('div', {class: 'readings'}, ...readings.map((reading) => reading.element)));
  }
}

export class CustomMessages {
  constructor() {
    this.element = h('div', {class: 'customs'});
    this._cards = new Map();
  }

  /** The topics that have a card. */
  get topics() { return [...this._cards.keys()]; }

  /** Add and remove cards for what the bridge publishes; return whether any changed. */
  learn(known) {
    const names = Object.keys(known).filter((name) => known[name].custom);
    const before = this.topics.join();
    for (const name of this.topics) {
      if (!names.includes(name)) {
        this._cards.get(name).element.remove();
        this._cards.delete(name);
      }
    }
    for (const name of names) {
      if (!this._cards.has(name)) {
        const made = new CustomCard(name, known[name].type);
        this._cards.set(name, made);
        this.element.append(made.element);
      }
    }
    return this.topics.join() !== before;
  }

  draw(model, now) { this._cards.forEach((each) => each.draw(model, now)); }
}
