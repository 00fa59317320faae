/** Cards of topics, by the boards' descriptions: several topics in a card with a title, or one each. */
import {card, formatAge, formatNumber, h, unit, updateAttribute, updateText} from '../dom.js';
import {Plot} from '../plot.js';
import {Reading} from '../reading.js';

const COLOURS = ['--line-1', '--line-2', '--line-3', '--line-4', '--line-5'];
const MAX_CURVES = COLOURS.length;    // curves of one topic

/** Fields with this in common share an axis: a unit, or being parts of one vector or array. */
function axisOf({name, unit}) {
  if (unit) return `unit ${unit}`;
  return /(^|\.)[xyzw]$|\[\d+\]$/.test(name) ? name.replace(/\w$|\[\d+\]$/, '') + '*' : name;
}

/** A field with limits, as a bar between them. */
class Bar {
  constructor(topic, field) {
    this._topic = topic.name;
    this._field = field.name;
    const name = topic.fields.length > 1 ? field.name : topic.name.split('/').pop().replaceAll('_', ' ');
    this._fill = h('span', {class: 'fill'});
    this._bar = h('div', {class: 'bar', role: 'meter', 'aria-label': name}, this._fill);
    this._low = h('span', {class: 'limit'});
    this._high = h('span', {class: 'limit'});
    this._words = h('span', {class: 'number'}, '–');
    this._age = h('span', {class: 'age'});
    this.element = h('div', {class: 'range', 'data-range': `${topic.name}:${field.name}`},
      h('div', {class: 'range-head'}, h('span', {class: 'label'}, name),
        h('span', {class: 'value'}, this._words), this._age),
      this._bar, h('div', {class: 'limits'}, this._low, this._high));
  }

  draw(model, now) {
    const topic = model.topic(this._topic), field = topic.field(this._field);
    const value = topic.value(this._field), stale = topic.stale(now);
    updateAttribute(this.element, 'data-state', stale ? 'stale' : 'fresh');
    updateText(this._age, stale ? `${formatAge(topic.age(now))} old` : '');
    const text = (number, digits) => `${formatNumber(number, digits)} ${unit(field.unit)}`.trim();
    const words = topic.fields.length > 1 ? text(value, field.digits) : topic.words;
    updateText(this._words, words);
    updateText(this._low, text(field.low, field.digits ? 2 : 0));
    updateText(this._high, text(field.high, field.digits ? 2 : 0));
    const part = Number.isNaN(value) ? 0
      : Math.min(1, Math.max(0, (value - field.low) / (field.high - field.low)));
    this._fill.style.width = `${(part * 100).toFixed(1)}%`;
    updateAttribute(this.element, 'data-beyond', Number.isNaN(value) ? 'none' : value === Infinity ? 'far'
      : value === -Infinity ? 'near' : null);
    updateAttribute(this._bar, 'aria-valuemin', field.low);
    updateAttribute(this._bar, 'aria-valuemax', field.high);
    updateAttribute(this._bar, 'aria-valuenow', (field.low + part * (field.high - field.low)).toFixed(3));
    updateAttribute(this._bar, 'aria-valuetext', words);
  }
}

const hasLimits = ({low, high}) => low !== null && high !== null && low < high;

/** One topic in a card: bars, plots and numbers. */
class Section {
  constructor(name, withPlots) {
    this.name = name;
    this._withPlots = withPlots;
    this._shape = null;
    this._parts = [];
    this._words = h('p', {class: 'words status-line'}, withPlots ? 'no message received yet' : '');
    this.element = h('div', {class: 'custom'}, this._words);
  }

  draw(model, now) {
    const topic = model.topic(this.name);
    const shape = topic.fields.map((field) => `${field.name} ${hasLimits(field)}`).join();
    if (topic.last && shape !== this._shape) {
      this._shape = shape;
      this._build(topic);
    }
    this._parts.forEach((part) => part.draw(model, now));
    if (topic.words) updateText(this._words, topic.words);
  }

  _build(topic) {
    const bars = topic.fields.filter(hasLimits), others = topic.fields.filter((field) => !hasLimits(field));
    const numbers = topic.fields.filter((field) => typeof topic.last[field.at] !== 'string');
    const readings = others.map((field) => new Reading(field.name, this.name, field.name));
    const drawn = bars.map((field) => new Bar(topic, field));
    const plots = this._withPlots ? this._plots(numbers) : [];
    this._parts = [...drawn, ...plots, ...readings];
    // The text of a message says more than its numbers only in a card of several topics.
    const words = !this._withPlots && others.length > 1 || !topic.fields.length ? [this._words] : [];
    this.element.replaceChildren(...drawn.map((each) => each.element), ...plots.map((each) => each.element),
      ...readings.length ? [h('div', {class: 'readings'}, ...readings.map((each) => each.element))] : [],
      ...words);
  }

  _plots(numbers) {
    const axes = new Map();
    for (const field of numbers.slice(0, MAX_CURVES)) {
      const axis = axisOf(field);
      if (!axes.has(axis)) axes.set(axis, []);
      axes.get(axis).push(field);
    }
    return [...axes.values()].map((fields) => new Plot(
      fields.length > 1 ? unit(fields[0].unit) : `${fields[0].name} ${unit(fields[0].unit)}`.trim(),
      fields.map((field, index) => ({topic: this.name, field: field.name, colour: COLOURS[index], name: field.name})),
      {least: 1e-3, digits: null, high: 84}));
  }
}

class TopicCard {
  /** @param entries [[name of a topic, {type, card}]] */
  constructor(title, entries) {
    const [[name, {type}]] = entries;
    this._sections = entries.map(([topic]) => new Section(topic, !title));
    this._isOwn = !title;
    this.element = card(title || name, title ? entries.map(([topic]) => topic).join(', ') : type,
      ...this._sections.map((each) => each.element));
    this.element.dataset.custom = title || name;
    this.element.dataset.tab = 'Sensors';
    this.element.hidden = !this._isOwn;
  }

  get topics() { return this._sections.map((each) => each.name); }

  draw(model, now) {
    // Not every board sends the topics that its description has.
    this.element.hidden = !this._isOwn && !this.topics.some((name) => model.topic(name).last);
    this._sections.forEach((each) => each.draw(model, now));
  }
}

export class TopicCards {
  constructor() { this._cards = new Map(); }      // key -> {shape, card}

  /** The topics that have a card. */
  get topics() { return [...this._cards.values()].flatMap((each) => each.card.topics); }

  get elements() { return [...this._cards.values()].map((each) => each.card.element); }

  /** Add and remove cards for what the bridge publishes; return whether any changed. */
  learn(known) {
    const wanted = new Map();
    for (const entry of Object.entries(known)) {
      const [name, {card: title}] = entry;
      if (title === null) continue;
      const key = title ? `card ${title}` : `topic ${name}`;
      if (!wanted.has(key)) wanted.set(key, {title, entries: []});
      wanted.get(key).entries.push(entry);
    }
    let changed = false;
    for (const [key, {shape, card: made}] of this._cards) {
      if (JSON.stringify(wanted.get(key)) === shape) continue;
      made.element.remove();
      this._cards.delete(key);
      changed = true;
    }
    for (const [key, each] of wanted) {
      if (this._cards.has(key)) continue;
      this._cards.set(key, {shape: JSON.stringify(each), card: new TopicCard(each.title, each.entries)});
      changed = true;
    }
    return changed;
  }

  draw(model, now) { this._cards.forEach((each) => each.card.draw(model, now)); }
}
