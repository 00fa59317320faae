/** A value with its label and unit. A stale value is grey and shows its age. */
import {formatAge, formatNumber, h, unit, updateAttribute, updateText} from './dom.js';

export class Reading {
  /**
   * @param label shown above the value
   * @param topic, field that have the value
   * @param format turns the value into text; null: by the field's digits
   * @param units shown after the value; null: the field's unit
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
      updateText(this._number, this._format ? this._format(value, field)
        : formatNumber(value, field.digits));
      if (this._units === null) updateText(this._unit, Number.isNaN(value) ? '' : unit(field.unit));
    }
    updateAttribute(this.element, 'data-state', value === undefined ? 'none' : stale ? 'stale' : 'fresh');
    updateText(this._age, stale ? `${formatAge(topic.age(now))} old` : '');
  }
}
