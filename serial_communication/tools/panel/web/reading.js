/** A number with its label, unit and age: grey, and how old, once it is no longer renewed. */
import {ago, h, mark, number, say, unit} from './dom.js';

export class Reading {
  /**
   * @param label what a person calls it
   * @param topic, field where it comes from
   * @param format turns the value into text, where its own digits are not what is wanted
   */
  constructor(label, topic, field, {format = null, units = null} = {}) {
    this._topic = topic;
    this._field = field;
    this._format = format;
    this._units = units;
    this._number = h('span', {class: 'number'}, '–');
    this._unit = h('span', {class: 'unit'}, units ?? '');
    this._age = h('span', {class: 'age'});
    this.element = h('div', {class: 'reading', 'data-reading': `${topic}:${field}`},
      h('span', {class: 'label'}, label),
      h('span', {class: 'value'}, this._number, this._unit), this._age);
  }

  draw(model, now) {
    const topic = model.topic(this._topic), field = topic.field(this._field);
    const value = topic.value(this._field);
    const stale = topic.stale(now);
    if (value !== undefined) {
      say(this._number, this._format ? this._format(value, field)
        : number(value, field.digits));
      if (this._units === null) say(this._unit, Number.isNaN(value) ? '' : unit(field.unit));
    }
    mark(this.element, 'data-state', value === undefined ? 'none' : stale ? 'stale' : 'fresh');
    say(this._age, stale ? `${ago(topic.age(now))} old` : '');
  }
}
