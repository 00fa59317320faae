/** A card for each topic, by its fields: numbers, plots, and bars where a field has limits. */
import {card, formatAge, formatNumber, h, setAttribute, setText, unitOf} from '../dom.js';
import {MOST_CURVES, Plot, wholeOf} from '../plot.js';

const MOST_PLOTS = 3;       // of a topic

/** Fields with this in common share a plot: a unit, or being parts of one vector or array. */
function axisOf(field) {
  return wholeOf(field) ? `of ${wholeOf(field)}` : field.unit ? `unit ${field.unit}` : field.name;
}

const hasLimits = ({low, high}) => low !== null && high !== null && low < high;

/** A value with its name and unit, and a bar where it has limits. */
class Reading {
  constructor(field) {
    this.name = field.name;
    this._field = field;
    this._number = h('span', {class: 'number'}, '–');
    this._fill = h('span', {class: 'fill'});
    const bar = hasLimits(field) ? [h('div', {class: 'bar'}, this._fill)] : [];
    this.element = h('div',
      {class: bar.length ? 'reading wide' : 'reading', 'data-reading': field.name},
      h('span', {class: 'label', title: field.name},
        field.name.split('.').slice(-2).join('.').replace(/_/g, '_\u200b')),
      h('span', {class: 'value'}, this._number, h('span', {class: 'unit'}, unitOf(field.unit))),
        ...bar);
  }

  draw(value) {
    const {digits, low, high} = this._field;
    setText(this._number, formatNumber(value, digits));
    setAttribute(this.element, 'data-text', typeof value === 'string');
    if (!hasLimits(this._field)) return;
    const part = Number.isNaN(value) ? 0 : Math.min(1, Math.max(0, (value - low) / (high - low)));
    const width = `${(part * 100).toFixed(0)}%`;
    if (this._fill.style.width !== width) this._fill.style.width = width;
  }
}

/** A topic, and the numbers of those whose names continue its: with ~imu also ~imu/temperature. */
class TopicCard {
  constructor(topic) {
    this.topic = topic;
    this._shape = null;
    this._readings = [];    // [topic, index of the field, Reading]
    this.plots = [];
    this._age = h('span', {class: 'age'});
    this._body = h('div', {class: 'topic'});
    this.element = card(topic.name, topic.type, this._body);
    this.element.dataset.topic = topic.name;
    this.element.querySelector('header').append(this._age);
  }

  draw(parts, now) {
    const {topic} = this, all = [topic, ...parts].filter((each) => each.values.length);
    this.element.hidden = !topic.values.length;
    const shape = JSON.stringify(all.map((each) => [each.name, each.fields]));
    if (topic.values.length && shape !== this._shape) {
      this._shape = shape;
      this._build(all);
    }
    const state = topic.state(now);
    setAttribute(this.element, 'data-state', state);
    setText(this._age, state === 'stale' ? `${formatAge(topic.age(now))} old` : '');
    for (const [from, index, reading] of this._readings) reading.draw(from.values[index]);
  }

  _build(all) {
    const axes = new Map(), {topic} = this, names = new Set();
    topic.fields.forEach((field, index) => {
      if (typeof topic.values[index] === 'string') return;
      let axis = axisOf(field);
      while (axes.get(axis)?.length === MOST_CURVES) axis += ' more';
      (axes.get(axis) ?? axes.set(axis, []).get(axis)).push({...field, at: index + 1});
    });
    this._readings = all.flatMap((from) => from.fields.map((field, index) => {
      const name = from === topic || field.name !== 'data' ? field.name
        : from.name.split('/').pop();
      return [from, index, new Reading({...field, name})];
    })).filter(([, , {name}]) => !names.has(name) && names.add(name));
    this.plots = [...axes.values()].slice(0, MOST_PLOTS).map((fields) => new Plot(topic, fields));
    this._body.replaceChildren(h('div', {class: 'readings'},
      ...this._readings.map(([, , each]) => each.element)),
      ...this.plots.map((each) => each.element));
  }
}

/** The cards of all topics of the bridge, and the names of those without a message. */
export class Topics {
  constructor(place) {
    this._place = place;
    this._silent = h('p', {class: 'note'});
    place.after(this._silent);
    this._cards = new Map();
    this.held = false;      // whether the plots stand
  }

  get _plots() { return [...this._cards.values()].flatMap((each) => each.plots); }

  draw(model, now) {
    const parts = new Map([...model.topics.keys()].map((name) => [name, []]));
    for (const [name, topic] of model.topics) {
      const whole = name.slice(0, Math.max(0, name.lastIndexOf('/')));
      if (parts.has(whole)) {
        parts.get(whole).push(topic);
        parts.delete(name);
      }
    }
    for (const name of parts.keys()) {
      const topic = model.topics.get(name);
      if (this._cards.get(name)?.topic === topic) continue;
      const made = new TopicCard(topic), old = this._cards.get(name);
      if (old) old.element.replaceWith(made.element);
      else this._place.append(made.element);
      this._cards.set(name, made);
    }
    for (const [name, each] of this._cards) {
      if (parts.has(name)) {
        each.draw(parts.get(name), now);
      } else {
        each.element.remove();
        this._cards.delete(name);
      }
    }
    const silent = [...parts.keys()].filter((name) => this._cards.get(name).element.hidden);
    setText(this._silent, silent.length ? `no message yet: ${silent.join(', ')}` : '');
  }

  /** Draw the plots until `end`, a time of the day in s. */
  drawPlots(end) { this._plots.forEach((each) => each.draw(end)); }

  /** Let all plots stand, or move again. */
  hold(held) {
    this.held = held;
    this._plots.forEach((each) => each.hold(held));
  }
}
